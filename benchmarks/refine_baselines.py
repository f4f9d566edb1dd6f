"""The refinement's optimiser against others: map error against run time, from the same start.

    python benchmarks/refine_baselines.py [--quick] --captures DIR --out DIR

All minimise the same objective, Σ (photo - I)²/R + (θ - θ₀)ᵀΣ⁻¹(θ - θ₀) with the lobes' maps and
prior as start, on the same photo and lights: per-pixel Gauss–Newton, Adam and L-BFGS with this
package's estimator and Jacobian; Adam with Mitsuba's path replay (`prb`, two renders with seeds of
their own a step); Adam with plain PyTorch's autograd through the same integral. Adam's step is
relative to the prior's deviations, the `RATES` with the lowest cost for each. Times are the
process's own seconds, without compilation and without measuring.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import markdown, write_results
from forward_gradients import sample_sensor
from matplotlib import pyplot as plt
from scipy.optimize import minimize
from torch_forward import TorchScene

from invrender import brdf  # noqa: F401  (Dr.Jit's back end before Mitsuba)
from invrender.backend import dr
from invrender.lobes import fit_lobes
from invrender.maps import Maps, map_errors
from invrender.materials import resize_maps
from invrender.photograph import mi, sample_scene
from invrender.pipeline import Seen, Stages, see
from invrender.prior import Prior, lobe_prior, project, to_maps, to_theta
from invrender.refine import PHOTO_NOISE, Shot, linearise, refine

Array = Any
Gradient = Callable[[Array, int], tuple[float, Array]]
RATES = (0.03, 0.1, 0.3)
NEAR = 1.1
SPP = 16  # of Mitsuba and PyTorch, a step


class Problem:
    """A capture at n × n with its prior; θ = θ₀ + σ·z, the data term by some renderer."""

    def __init__(self, folder: Path, n: int) -> None:
        self.seen: Seen = see(folder, n, Stages())
        assert self.seen.capture.truth is not None
        self.n, self.photo = n, self.seen.photo
        self.truth: Maps = resize_maps(self.seen.capture.truth, n, n)
        self.shot = Shot(self.photo, self.seen.prepare())
        self.prior: Prior = lobe_prior(fit_lobes(self.photo, self.shot.prepared))
        mean = float(self.photo.mean())
        self.noise = (PHOTO_NOISE[0] * self.photo) ** 2 + (PHOTO_NOISE[1] * mean) ** 2
        self.precision = np.linalg.inv(self.prior.correlation)

    def theta(self, z: Array) -> Array:
        """θ (n, n, 9), within its range."""
        z = z.reshape(self.n, self.n, 9)
        return project((self.prior.mean + self.prior.sigma * z).astype(np.float32))

    def error(self, theta: Array) -> float:
        """Average map RMSE."""
        return map_errors(to_maps(theta), self.truth)["average"]

    def with_prior(self, z: Array, value: float, gradient: Array) -> tuple[float, Array]:
        """Adds the prior to the data term's value and gradient by θ; the sum's are by z."""
        z = z.reshape(self.n, self.n, 9)
        pull = z @ self.precision
        return value + float((z * pull).sum()), gradient * self.prior.sigma + 2 * pull


def ours(problem: Problem) -> Gradient:
    """Value and gradient by the fast estimator's Jacobian."""

    def run(z: Array, seed: int) -> tuple[float, Array]:
        image, jacobian = linearise(problem.shot.prepared, problem.theta(z), 64)
        residual = problem.photo - image
        weighted = residual / problem.noise
        gradient = -2 * np.einsum("hwcp,hwc->hwp", jacobian, weighted)
        return problem.with_prior(z, float((residual * weighted).sum()), gradient)

    return run


def prb(problem: Problem) -> Gradient:
    """Value and gradient by Mitsuba: one render for the adjoint, another for the gradient."""
    lights, n = problem.seen.lights, problem.n
    scene = sample_scene(
        lights.rig, to_maps(problem.prior.mean), lights.pattern, lights.environment, lights.gain
    )
    params = mi.traverse(scene)
    names = ("diffuse", "specular", "roughness", "normal")
    keys = {name: next(k for k, _ in params if k.endswith(f".{name}")) for name in names}
    sensor = sample_sensor(n)
    integrator = mi.load_dict({"type": "prb", "max_depth": 2})

    def run(z: Array, seed: int) -> tuple[float, Array]:
        theta = problem.theta(z)
        parts = (theta[..., :3], theta[..., 3:6], theta[..., 6:7])
        slopes = np.concatenate([theta[..., 7:], np.ones((n, n, 1), np.float32)], -1)
        for name, part in zip(names, (*parts, slopes), strict=True):
            params[keys[name]] = mi.TensorXf(np.ascontiguousarray(part))
            dr.enable_grad(params[keys[name]])
        params.update()
        image = np.array(
            mi.render(scene, sensor=sensor, integrator=integrator, spp=SPP, seed=2 * seed)
        )
        residual = problem.photo - image
        adjoint = mi.TensorXf(np.ascontiguousarray(-2 * residual / problem.noise, np.float32))
        integrator.render_backward(
            scene, params, adjoint, sensor=sensor, seed=2 * seed + 1, spp=SPP
        )
        g = [np.array(dr.grad(params[k])).reshape(n, n, -1) for k in keys.values()]
        gradient = np.concatenate([*g[:3], g[3][..., :2]], -1)
        value = float((residual**2 / problem.noise).sum())
        return problem.with_prior(z, value, np.nan_to_num(gradient))

    return run


def autograd(problem: Problem) -> Gradient:
    """Value and gradient by PyTorch through the integral in plain tensor operations."""
    lights = problem.seen.lights
    pattern = (lights.pattern * lights.gain).astype(np.float32)
    scene = TorchScene(lights.rig, problem.truth, pattern, lights.environment, 1.0)
    photo, noise = (torch.as_tensor(x).reshape(-1, 3) for x in (problem.photo, problem.noise))

    def run(z: Array, seed: int) -> tuple[float, Array]:
        theta = torch.from_numpy(problem.theta(z).reshape(-1, 9)).requires_grad_()
        scene.k_d, scene.k_s, rho = theta[:, :3], theta[:, 3:6], theta[:, 6:7]
        scene.alpha = rho**2
        slopes = torch.cat([theta[:, 7:], torch.ones_like(rho)], -1)
        n = scene.n = torch.nn.functional.normalize(slopes, dim=-1)
        a = -1 / (1 + n[:, 2:])
        b = n[:, :1] * n[:, 1:2] * a
        scene.s = torch.cat([1 + n[:, :1] ** 2 * a, b, -n[:, :1]], -1)
        scene.t = torch.cat([b, 1 + n[:, 1:2] ** 2 * a, -n[:, 1:2]], -1)
        scene.local_v = scene.local(scene.v)
        with torch.no_grad():  # the adjoint, from samples of its own
            generator = torch.Generator().manual_seed(2 * seed)
            residual = photo - scene.radiance(SPP, generator)
        image = scene.radiance(SPP, torch.Generator().manual_seed(2 * seed + 1))
        image.backward(-2 * residual / noise)
        assert theta.grad is not None
        gradient = torch.nan_to_num(theta.grad).numpy().reshape(problem.n, problem.n, 9)
        return problem.with_prior(z, float((residual**2 / noise).sum()), gradient)

    return run


Curve = list[tuple[float, float, float]]  # seconds, average map RMSE, mean cost a pixel


def point(problem: Problem, z: Array, seconds: float) -> tuple[float, float, float]:
    """Where an optimiser stands after some seconds; the cost is by the package's estimator."""
    cost = ours(problem)(z, 0)[0] / problem.n**2
    return seconds, problem.error(problem.theta(z)), cost


def adam(problem: Problem, gradient: Gradient, rate: float, seconds: float, limit: int) -> Curve:
    """Adam (0.9, 0.999) on z for a number of steps or seconds."""
    z = np.zeros((problem.n, problem.n, 9))
    m, v = np.zeros_like(z), np.zeros_like(z)
    gradient(z, 10_000)  # compiles
    curve, spent = [point(problem, z, 0.0)], 0.0
    for i in range(1, limit + 1):
        began = time.process_time()
        _, g = gradient(z, i)
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        z = z - rate * (m / (1 - 0.9**i)) / (np.sqrt(v / (1 - 0.999**i)) + 1e-8)
        spent += time.process_time() - began
        if i & (i - 1) == 0 or i % 16 == 0:
            curve.append(point(problem, z, spent))
        if spent > seconds:
            break
    return curve


def lbfgs(problem: Problem, limit: int) -> Curve:
    """SciPy's L-BFGS on z."""
    gradient = ours(problem)
    path = [np.zeros(problem.n**2 * 9)]
    gradient(path[0], 0)
    began, seconds = time.process_time(), [0.0]

    def value(z: Array) -> tuple[float, Array]:
        f, g = gradient(z, 0)
        return f, g.ravel().astype(np.float64)

    def note(z: Array) -> None:
        path.append(z.copy())
        seconds.append(time.process_time() - began)

    options = {"maxiter": limit}
    minimize(value, path[0], jac=True, method="L-BFGS-B", callback=note, options=options)
    return [point(problem, z, t) for z, t in zip(path, seconds, strict=True)]


def gauss_newton(problem: Problem) -> Curve:
    """The package's refinement, stopped after each number of steps."""
    refine([problem.shot], problem.prior, iterations=1)
    curve = [point(problem, np.zeros_like(problem.prior.mean), 0.0)]
    for steps in range(1, 11):
        began = time.process_time()
        result = refine([problem.shot], problem.prior, iterations=steps)
        spent = time.process_time() - began
        z = (to_theta(result.maps) - problem.prior.mean) / problem.prior.sigma
        curve.append(point(problem, z, spent))
        if result.converged:
            break
    return curve


def reached(curve: Curve, column: int, level: float) -> float | None:
    """Seconds at which a curve first comes down to a level; None if it does not."""
    return next((p[0] for p in curve if p[column] <= level), None)


def measure(folder: Path, n: int, seconds: float, limit: int) -> dict[str, Curve]:
    """Curves of all methods on a capture."""
    problem = Problem(folder, n)
    curves = {"Gauss–Newton": gauss_newton(problem), "L-BFGS": lbfgs(problem, limit)}
    for name, gradient in (
        ("Adam, ours", ours(problem)),
        ("Adam, Mitsuba prb", prb(problem)),
        ("Adam, PyTorch", autograd(problem)),
    ):
        tried = [adam(problem, gradient, rate, seconds, limit) for rate in RATES]
        curves[name] = min(tried, key=lambda c: min(p[2] for p in c))
    return curves


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--captures", type=Path, required=True, help="of benchmarks/refine.py")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="one capture at 16 × 16")
    parser.add_argument("--count", type=int, default=2)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--steps", type=int, default=128, help="at most, of the iterative methods")
    parser.add_argument("--seconds", type=float, default=60.0, help="at most, a method and rate")
    args = parser.parse_args()
    if args.quick:
        args.count, args.size, args.steps, args.seconds = 1, 16, 4, 3.0
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, dict[str, Curve]] = {}
    rows = []
    for folder in sorted(p for p in args.captures.iterdir() if p.is_dir())[: args.count]:
        curves = results[folder.name] = measure(folder, args.size, args.seconds, args.steps)
        target = curves["Gauss–Newton"][-1][2]
        for name, curve in curves.items():
            at = reached(curve, 2, NEAR * target)
            low = min(p[1] for p in curve)
            row = [folder.name, name, curve[0][1], low, reached(curve, 1, 1.001 * low)]
            row += [min(p[2] for p in curve) / target, at or f"not in {curve[-1][0]:.1f}"]
            rows.append(row)
            print(*row, flush=True)
    figure, axes = plt.subplots(1, len(results), figsize=(5 * len(results), 4), squeeze=False)
    for axis, (capture, curves) in zip(axes[0], results.items(), strict=True):
        for name, curve in curves.items():
            t, e, _ = np.array(curve).T
            axis.plot(np.maximum(t, 1e-3), e, marker=".", label=name)
        axis.set(xscale="log", yscale="log", xlabel="processor seconds", title=capture)
    axes[0, 0].set_ylabel("average map RMSE")
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(args.out / "refine_baselines.png", dpi=110)
    header = ["capture", "method", "error at the start", "best error", "processor seconds to it"]
    header += ["lowest cost over Gauss–Newton's last", f"seconds to {NEAR} times that"]
    (args.out / "refine_baselines.md").write_text(markdown(header, rows))
    write_results(args.out, {"curves": results})


if __name__ == "__main__":
    main()
