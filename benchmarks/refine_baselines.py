"""The refinement's optimisers against others: map error against run time, from the same start.

All start at the network's maps, on the same photo and lights. Most minimise one objective,
Σ (photo - I)²/R + (θ - θ₀)ᵀΣ⁻¹(θ - θ₀), with the network's prior, its deviations times the
share of its step that each parameter takes: per-pixel Gauss–Newton, Adam and L-BFGS with this
package's estimator and Jacobian; Adam with Mitsuba's path replay (`prb`, two renders with seeds of
their own a step); Adam
with plain PyTorch's autograd through the same integral. Adam's step is relative to the prior's
deviations. Beside them what `invrender refine` does, the learned correction and the posterior step,
and the network's own weights adapted to the photo by Adam, without a prior. Each has the one of its
rates that makes its own objective lowest; the truth chooses nothing. Times are the process's own
seconds, without compilation and without measuring.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize

from benchmarks.baselines.torch_forward import TorchScene
from benchmarks.common.captures import PHOTOGRAPHS, arguments, make_captures
from benchmarks.common.gradients import sample_sensor
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import Table, bar, table, write_results
from invrender.capture.lights import find_lights
from invrender.capture.sample import Sample
from invrender.files.capture import load_capture
from invrender.lights import Lights
from invrender.maps import Maps, map_errors, resize_maps
from invrender.refine.estimate import observe
from invrender.refine.gauss_newton import PHOTO_NOISE, linearise, refine
from invrender.refine.posterior import SETTINGS, explain
from invrender.refine.priors import Prior, network_prior
from invrender.refine.theta import project, to_maps, to_theta
from invrender.render import brdf  # noqa: F401  (Dr.Jit's back end before Mitsuba)
from invrender.render.backend import dr
from invrender.render.path_traced import mi, sample_scene
from nets.batch import batch_of
from nets.clues import light_inputs
from nets.predict import Corrector, Reconstructor

Array = Any
Gradient = Callable[[Array, int], tuple[float, Array]]
RATES = (0.1, 0.3)
WEIGHT_RATES = (1e-5, 1e-4)  # of Adam on the network's weights
LEAST = 0.02  # of a parameter's share: none has a prior of no width
SAME = 1.001  # what counts as having reached an error
SPP = 16  # of Mitsuba and PyTorch, a step


class Problem:
    """A capture at n × n with its prior; θ = θ₀ + σ·z, the data term by some renderer."""

    def __init__(self, folder: Path, n: int) -> None:
        found = find_lights(load_capture(folder))
        assert found.capture.truth is not None
        self.lights: Lights = found.lights
        sample = Sample.of(found, n)
        self.shot = observe(sample.photo, sample.lights, sample.clipped)
        self.n, self.photo = n, self.shot.photo
        self.truth: Maps = resize_maps(found.capture.truth, n, n)
        self.network = Reconstructor()
        self.estimate = self.network(self.photo, self.lights)
        full = network_prior(self.estimate.maps, self.estimate.sigma)
        cautious = (full.sigma * np.maximum(SETTINGS.take, LEAST)).astype(np.float32)
        self.prior = Prior(full.mean, cautious, full.correlation)
        mean = float(self.photo.mean())
        self.noise = (PHOTO_NOISE[0] * self.photo) ** 2 + (PHOTO_NOISE[1] * mean) ** 2
        if self.shot.clipped is not None:
            self.noise = np.where(self.shot.clipped[..., None], 1e12 * mean**2, self.noise)
        self.noise = self.noise.astype(np.float32)
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
        image, jacobian = linearise(problem.shot.renderer, problem.theta(z), 64)
        residual = problem.photo - image
        weighted = residual / problem.noise
        gradient = -2 * np.einsum("hwcp,hwc->hwp", jacobian, weighted)
        return problem.with_prior(z, float((residual * weighted).sum()), gradient)

    return run


def prb(problem: Problem) -> Gradient:
    """Value and gradient by Mitsuba: one render for the adjoint, another for the gradient."""
    lights, n = problem.lights, problem.n
    scene = sample_scene(
        lights.rig, to_maps(problem.prior.mean), lights.pattern, lights.environment, lights.gain
    )
    params = mi.traverse(scene)
    names = ("diffuse", "specular", "roughness", "normal")
    keys = {name: next(k for k, _ in params if k.endswith(f".{name}")) for name in names}
    sensor = sample_sensor(n, lights.rig)
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
    lights = problem.lights
    pattern = (lights.pattern * lights.gain).astype(np.float32)
    scene = TorchScene(lights.rig, problem.truth, pattern, lights.environment, 1.0)
    photo, noise = (torch.as_tensor(x).reshape(-1, 3) for x in (problem.photo, problem.noise))

    def run(z: Array, seed: int) -> tuple[float, Array]:
        theta = torch.from_numpy(problem.theta(z).reshape(-1, 9)).requires_grad_()
        normal = torch.cat([theta[:, 7:], torch.ones_like(theta[:, :1])], -1)
        scene.set_material(theta[:, :3], theta[:, 3:6], theta[:, 6:7], normal)
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
        last = i == limit or spent > seconds
        if last or i & (i - 1) == 0 or i % 16 == 0:
            curve.append(point(problem, z, spent))
        if last:
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


def chain(problem: Problem) -> Curve:
    """The learned correction, then the posterior step."""
    improve = Corrector()
    curve = [point(problem, np.zeros_like(problem.prior.mean), 0.0)]
    for _ in range(2):  # the first compiles
        began = time.process_time()
        e = improve(problem.photo, problem.shot.renderer, problem.estimate, problem.shot.clipped)
        prior = network_prior(e.maps, e.sigma)
        times = [time.process_time() - began]
        result = explain([problem.shot], prior)
        times.append(time.process_time() - began)
    for theta, t in zip((prior.mean, to_theta(result.maps)), times, strict=True):
        curve.append(point(problem, (theta - problem.prior.mean) / problem.prior.sigma, t))
    return curve


def adapt(problem: Problem, rate: float, seconds: float, limit: int) -> tuple[float, Curve]:
    """Adam on the network's weights, for what its maps leave of the photo: the least, the curve."""
    lights = problem.lights
    inputs = light_inputs(
        lights.rig, lights.pattern, lights.gain, lights.environment, lights.pattern_captured
    )
    assert problem.estimate.lobes is not None  # a fresh estimate's
    batch = batch_of(problem.photo, inputs, problem.estimate.lobes)
    network = copy.deepcopy(problem.network.network).requires_grad_()
    optimiser = torch.optim.Adam(network.parameters(), rate)
    spent, least, curve = 0.0, np.inf, []
    for i in range(limit + 1):
        began = time.process_time()
        out = network(batch)
        slopes = out["normal"][:, :2] / out["normal"][:, 2:].clamp(min=0.1)
        parts = [out["diffuse"], out["specular"], out["roughness"], slopes]
        theta = torch.cat(parts, 1)[0].permute(1, 2, 0)
        value = theta.detach().numpy()
        image, jacobian = linearise(problem.shot.renderer, project(value.copy()), 64)
        residual = problem.photo - image
        least = min(least, float((residual**2 / problem.noise).sum()))
        last = i == limit or spent > seconds
        if last or i & (i - 1) == 0 or i % 8 == 0:
            z = (value - problem.prior.mean) / problem.prior.sigma
            curve.append(point(problem, z, spent))
        if last:
            break
        gradient = -2 * np.einsum("hwcp,hwc->hwp", jacobian, residual / problem.noise)
        optimiser.zero_grad()
        theta.backward(torch.from_numpy((gradient / problem.n**2).astype(np.float32)))
        optimiser.step()
        spent += time.process_time() - began
    return least, curve


def reached(curve: Curve, column: int, level: float) -> float | None:
    """Seconds at which a curve first comes down to a level; None if it does not."""
    return next((p[0] for p in curve if p[column] <= level), None)


def measure(folder: Path, n: int, seconds: float, limit: int) -> dict[str, Curve]:
    """Curves of all methods on a capture."""
    problem = Problem(folder, n)
    curves = {
        "Gauss–Newton": gauss_newton(problem),
        "correction, posterior step": chain(problem),
        "L-BFGS": lbfgs(problem, limit),
    }
    adapted = [adapt(problem, rate, seconds, limit) for rate in WEIGHT_RATES]
    curves["network's weights"] = min(adapted, key=lambda a: a[0])[1]
    for name, gradient in (
        ("Adam, ours", ours(problem)),
        ("Adam, Mitsuba prb", prb(problem)),
        ("Adam, PyTorch", autograd(problem)),
    ):
        tried = [adam(problem, gradient, rate, seconds, limit) for rate in RATES]
        curves[name] = min(tried, key=lambda c: min(p[2] for p in c))
    return curves


def faster(curves: dict[str, Curve], method: str, baseline: str) -> float:
    """By how much sooner a method is at the baseline's best map error; 0 if it never is."""
    best = min(p[1] for p in curves[baseline])
    theirs, ours = (reached(curves[k], 1, SAME * best) for k in (baseline, method))
    assert theirs is not None
    return 0.0 if ours is None else theirs / max(ours, 1e-9)


def medians(results: dict[str, dict[str, Curve]]) -> Table:
    """Each method's medians over the captures."""
    rows = []
    for method in next(iter(results.values())):
        curves = [c[method] for c in results.values()]
        best = [min(p[1] for p in c) for c in curves]
        seconds = [reached(c, 1, SAME * b) or 0.0 for c, b in zip(curves, best, strict=True)]
        errors = [b / c[0][1] for c, b in zip(curves, best, strict=True)]
        costs = [min(p[2] for p in c) / c[0][2] for c in curves]
        rows.append([method, *(float(np.median(v)) for v in (errors, seconds, costs))])
    header = ["", "map error over the start's, best", "processor seconds to it"]
    return table([*header, "cost over the start's, lowest"], rows)


def parser() -> argparse.ArgumentParser:
    parser = arguments(__doc__, "one capture at 16 × 16", 4)
    parser.add_argument("--captures", type=Path, help="made by `refine` before, else by this")
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--steps", type=int, default=32, help="at most, of the iterative methods")
    parser.add_argument("--seconds", type=float, default=10.0, help="at most, a method and rate")
    return parser


def main(args: argparse.Namespace) -> None:
    if args.quick:
        args.count, args.size, args.steps, args.seconds = 1, 16, 4, 1.0
    torch.set_num_threads(1)
    width, spp = (720, 24) if args.quick else (960, 32)
    made, real = args.captures or args.out / "captures", (args.materials, args.envs)
    folders = make_captures(made, PHOTOGRAPHS, args.count, 256, width, spp, *real)
    results: dict[str, dict[str, Curve]] = {}
    for folder in folders:
        curves = results[folder.name] = measure(folder, args.size, args.seconds, args.steps)
        for name, curve in curves.items():
            best = min(p[1] for p in curve)
            print(f"{folder.name} {name}: {curve[0][1]:.4f} → {best:.4f}", flush=True)
    bars = []
    for baseline, least in (("Adam, Mitsuba prb", 50.0), ("Adam, PyTorch", 5.0)):
        for method in ("Gauss–Newton", "correction, posterior step"):
            ratio = float(np.median([faster(c, method, baseline) for c in results.values()]))
            name = f"{method}: times faster than {baseline} to its best map error, median"
            bars.append(bar(name, ratio, least, at_least=True))
    panels = {
        f"{capture}, {what}": {m: ([p[0] for p in c], [p[k] for p in c]) for m, c in curves.items()}
        for k, what in ((1, "average map RMSE"), (2, "cost a pixel"))
        for capture, curves in results.items()
    }
    plot_error_over_time(
        args.out / "refine_baselines.png", panels, x="processor seconds", y="",
        columns=len(results),
    )  # fmt: skip
    write_results(args.out, {"curves": results, "bars": bars}, {"medians": medians(results)})
