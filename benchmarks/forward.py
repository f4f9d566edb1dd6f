"""The forward model against general renderers: error, and error of gradients, over time.

    python benchmarks/forward.py --out DIR [--quick]

Writes forward.md (tables), forward.png (RMS error against seconds, a panel a scene) and
results.json, whose ``bars`` hold {name, value, bar, ok}. All times are warm medians of one run on
one machine; compilation and `prepare` are reported beside them. Where a Monte Carlo method would
take minutes, its time is extrapolated from its last two measurements' mean by 1/√N.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from common import bar, machine, markdown, timed, write_results
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from invrender import photograph, render
from invrender.backend import Float, dr, vector
from invrender.environments import procedural_environment
from invrender.maps import Maps
from invrender.photograph import mi
from invrender.rig import Rig
from invrender.scene import make_scene, make_view
from invrender.tables import Tables

Array = NDArray[Any]
# The sample's pixels are whole pixels of a film 2.5 samples wide: δ = 3/32 l.
RIG = Rig(camera_offset=0.18 * 3 / 32)
GAIN = 5.0
MAPS = ("diffuse", "specular", "roughness", "normal")

#                          roughness   metal  tilt  environment
SCENES: dict[str, tuple[float, float, float, float, str]] = {
    "rough, diffuse": (0.6, 1.0, 0.0, 0.10, "sun"),
    "glossy": (0.2, 0.5, 0.0, 0.15, "sun"),
    "tilted, half metal": (0.3, 0.8, 0.5, 0.5, "sun"),
    "metal": (0.15, 0.45, 1.0, 0.15, "sun"),
    "near-mirror": (0.05, 0.12, 0.5, 0.05, "sun"),
    "in a room": (0.15, 0.8, 0.4, 0.15, "room"),
}


def make_maps(n: int, low: float, high: float, metal: float, tilt: float) -> Maps:
    """Smoothly varying maps of one kind."""
    rng = np.random.default_rng(0)

    def noise(channels: int) -> Array:
        x = gaussian_filter(rng.standard_normal((n, n, channels)), (n / 12, n / 12, 0), mode="wrap")
        return x / x.std()

    roughness = low + (high - low) * np.clip(0.5 + 0.3 * noise(1)[..., 0], 0, 1)
    base = np.clip(0.45 + 0.2 * noise(3), 0.02, 0.95)
    normal = np.concatenate([tilt * noise(2), np.ones((n, n, 1))], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    images = (base * (1 - metal), 0.04 * (1 - metal) + base * metal, roughness, normal)
    return Maps(*(x.astype(np.float32) for x in images))


def make_environment(kind: str, h: int = 128) -> Array:
    """A smooth sky with three small lamps and a sun of one texel, or a made-up room."""
    if kind == "room":
        room = procedural_environment(3, h, "room")
        return room * (0.5 / room[: h // 2].mean())
    rng = np.random.default_rng(0)
    smooth = gaussian_filter(rng.standard_normal((h, 2 * h, 3)), (h / 16, h / 8, 0), mode="wrap")
    env = 0.3 * np.exp(smooth / smooth.std() / 2)
    for _ in range(3):
        i, j = int(rng.uniform(0.05, 0.4) * h), rng.integers(2 * h)
        env[i : i + h // 32, j : j + h // 32] += 30
    env[int(0.22 * h), int(0.8 * h)] += 2 / (np.pi / h) ** 2
    return env.astype(np.float32)


class Case:
    """A scene, its reference and all that is measured on it."""

    def __init__(self, name: str, n: int) -> None:
        *material, kind = SCENES[name]
        self.name, self.n = name, n
        self.maps = make_maps(n, *material)
        self.environment = make_environment(kind)
        blocks = np.random.default_rng(1).uniform(0, 1, (4, 4, 3))
        self.pattern = np.kron(blocks, np.ones((16, 16, 1))).astype(np.float32)
        self.scene = make_scene(RIG, self.pattern, self.environment, GAIN)
        self.material = render.material_from_maps(self.maps)
        self.prepared = {e: self.prepare(e) for e in ("fast", "mis")}
        self.mitsuba = {
            kind: photograph.sample_scene(
                RIG, self.maps, self.pattern, self.environment, GAIN, integrator=kind
            )
            for kind in ("path", "direct")
        }

    def prepare(self, estimator: str) -> Any:
        prepared: Any = render.prepare(self.scene, estimator)
        if isinstance(prepared, Tables):
            for pyramid in (prepared.sky, prepared.screen):
                dr.eval(pyramid.texels if pyramid else 0)
            dr.eval(prepared.sky_irradiance, prepared.vector_irradiance)
            dr.sync_thread()
        return prepared

    def ours(self, estimator: str, samples: int, seed: int) -> Array:
        view = make_view(self.scene, self.n, self.n, seed)
        color = render.radiance(self.prepared[estimator], view, self.material, samples)
        return np.asarray(color).T.reshape(self.n, self.n, 3)

    def mitsubas(self, kind: str, spp: int, seed: int) -> Array:
        return photograph.path_traced(self.mitsuba[kind], RIG, self.n, self.n, spp, seed)

    def jacobian(self, estimator: str, samples: int, seed: int, adjoint: Any) -> list[Array]:
        """Gradients of Σ adjoint·I with respect to the four maps."""
        view = make_view(self.scene, self.n, self.n, seed)
        j = render.pixel_jacobian(self.prepared[estimator], view, self.material, samples)
        normal = j.s * dr.dot(adjoint, j.tangent_s) + j.t * dr.dot(adjoint, j.tangent_t)
        roughness = dr.dot(adjoint, j.roughness)
        out = (adjoint * j.diffuse, adjoint * j.specular, roughness, normal)
        dr.eval(out)
        return [np.asarray(g) for g in out]


def averaged(f: Callable[[int], Any], runs: int) -> tuple[Any, Any, Any]:
    """(mean, first half's mean, second half's) of f(seed)."""
    halves = []
    for k in range(2):
        total: Any = None
        for seed in range(runs // 2):
            x = f(1000 * (k + 1) + seed)
            x = x if isinstance(x, list) else [x]
            total = x if total is None else [a + b for a, b in zip(total, x, strict=True)]
        halves.append([np.asarray(t, np.float64) / (runs // 2) for t in total])
    mean = [(a + b) / 2 for a, b in zip(*halves, strict=True)]
    return mean, halves[0], halves[1]


def time_to(error: float, times: list[float], errors: list[float], statistical: bool) -> float:
    """Seconds to reach an error: log-log interpolation, or 1/√N beyond the last measurement.

    inf where a method with a bias stops above it.
    """
    t, e = np.log(times), np.log(np.maximum(errors, 1e-9))
    if e[0] <= np.log(error):
        return float(times[0])
    for i in range(1, len(t)):
        if e[i] <= np.log(error) < e[i - 1]:
            f = (e[i - 1] - np.log(error)) / (e[i - 1] - e[i])
            return float(np.exp(t[i - 1] + f * (t[i] - t[i - 1])))
    if not statistical:
        return float("inf")
    constant = np.mean([np.log(errors[i]) + 0.5 * np.log(times[i]) for i in (-1, -2)])
    return float(np.exp(2 * (constant - np.log(error))))


def curve(
    f: Callable[[int, int], Any], counts: list[int], error: Callable[[Any], float], repeats: int
) -> dict[str, Any]:
    """Samples, seconds, errors (mean over the runs' squares) and the first call's seconds."""
    out: dict[str, Any] = {"samples": counts, "seconds": [], "errors": []}
    for count in counts:
        results: list[Any] = []
        cold, warm = timed(lambda c=count, r=results: r.append(f(c, len(r))), repeats)  # type: ignore[misc]
        out.setdefault("cold", cold)
        out["seconds"].append(warm)
        out["errors"].append(float(np.sqrt(np.mean([error(r) ** 2 for r in results]))))
    return out


def measure_values(case: Case, quick: bool) -> dict[str, Any]:
    """Error over time of every method on one scene."""
    (reference,), (a,), (b,) = averaged(
        lambda seed: case.ours("mis", 32 if quick else 256, seed), 4 if quick else 8
    )
    mean = reference.mean()
    noise2 = np.mean((a - b) ** 2) / 4

    def error(image: Array) -> float:
        return float(np.sqrt(max(np.mean((image - reference) ** 2) - noise2, 1e-12)) / mean)

    top = 3 if quick else 6
    repeats = 1 if quick else 3
    counts = [2**k for k in range(1, top + 1)]
    few = [1, 4] if quick else [4, 16, 64]
    out = {
        "fast": curve(lambda s, k: case.ours("fast", s, k), counts, error, repeats),
        "mis": curve(lambda s, k: case.ours("mis", s, k), counts, error, repeats),
        "path": curve(lambda s, k: case.mitsubas("path", s, k), few, error, 1),
        "direct": curve(lambda s, k: case.mitsubas("direct", s, k), few, error, 1),
    }
    try:
        import torch
        from torch_forward import TorchScene

        torch.set_num_threads(dr.thread_count())
        scene = TorchScene(RIG, case.maps, case.pattern, case.environment, GAIN)

        def run(samples: int, k: int) -> Array:
            with torch.no_grad():
                image = scene.radiance(samples, torch.Generator().manual_seed(k))
            return image.numpy().reshape(case.n, case.n, 3)

        out["torch"] = curve(run, [1, 2] if quick else [2, 8], error, 1)
    except ImportError:
        print("torch is not installed: its curve is left out")
    prepare = {e: timed(lambda e=e: case.prepare(e), 2)[1] for e in ("fast", "mis")}  # type: ignore[misc]
    return {"methods": out, "reference_noise": float(np.sqrt(noise2) / mean), "prepare": prepare}


def prb_gradients(case: Case, adjoint: Array) -> Callable[[int, int], list[Array]]:
    """Mitsuba's path replay backpropagation of the same adjoint image, one sensor pixel a texel."""
    n, size = case.n, RIG.screen_size
    scene = case.mitsuba["path"]
    params = mi.traverse(scene)
    keys = {name: next(k for k, _ in params if k.endswith(f".{name}")) for name in MAPS}
    half = 0.625 * size
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(half / RIG.screen_height))),
            "fov_axis": "x",
            "near_clip": 1e-3 * size,
            "far_clip": 1e3 * size,
            "to_world": photograph._transform(
                [-RIG.camera_axes[0], RIG.camera_axes[1], -RIG.camera_axes[2], RIG.camera]
            ),
            "film": {
                "type": "hdrfilm",
                "width": 5 * n // 2,
                "height": n,
                "crop_offset_x": n // 16,
                "crop_offset_y": 0,
                "crop_width": n,
                "crop_height": n,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
        }
    )
    integrator = mi.load_dict({"type": "prb", "max_depth": 2})
    grad_in = mi.TensorXf(np.ascontiguousarray(adjoint, np.float32))

    def run(spp: int, seed: int) -> list[Array]:
        for key in keys.values():
            dr.enable_grad(params[key])
            dr.set_grad(params[key], 0)
        integrator.render_backward(scene, params, grad_in, sensor=sensor, seed=seed, spp=spp)
        grads = []
        for name, key in keys.items():
            g = np.array(dr.grad(params[key])).reshape(n * n, -1).T
            grads.append(g[0] if name == "roughness" else g)
            dr.disable_grad(params[key])
        return grads

    return run


def measure_gradients(case: Case, quick: bool) -> dict[str, Any]:
    """Error of the four maps' gradients of Σ (I - I*)², over time.

    The adjoint 2(I - I*) is that of the converged image against a photo of other maps, so that all
    methods estimate the same gradient, without the variance of I in it.
    """
    (image,), _, _ = averaged(lambda s: case.ours("mis", 32 if quick else 128, s), 4)
    photo = image * (1 + 0.3 * np.sin(np.arange(case.n) / 5))[None, :, None]
    adjoint = 2 * (image - photo)
    ours = vector(Float, 3)(adjoint.reshape(-1, 3).T.astype(np.float32))
    reference, a, b = averaged(
        lambda seed: case.jacobian("mis", 32 if quick else 256, seed, ours), 4 if quick else 8
    )
    norm2 = [float(np.sum(g**2)) for g in reference]
    noise2 = [float(np.sum((x - y) ** 2) / 4) / z for x, y, z in zip(a, b, norm2, strict=True)]

    def relative(found: list[Array]) -> list[float]:
        return [
            float(np.sqrt(max(np.sum((g - r) ** 2) / z - e, 1e-12)))
            for g, r, z, e in zip(found, reference, norm2, noise2, strict=True)
        ]

    def cosines(found: list[Array]) -> list[float]:
        return [
            float(np.sum(g * r) / np.sqrt(np.sum(g * g) * z))
            for g, r, z in zip(found, reference, norm2, strict=True)
        ]

    counts = [4, 16] if quick else [2, 4, 8, 16, 32, 64]
    few = [2, 8] if quick else [8, 64]
    prb = prb_gradients(case, adjoint)
    methods = {
        "fast": (lambda s, k: case.jacobian("fast", s, k, ours), counts, False),
        "mis": (lambda s, k: case.jacobian("mis", s, k, ours), counts, True),
        "prb": (prb, few, True),
    }
    out: dict[str, Any] = {}
    for name, (f, c, _) in methods.items():
        last: list[list[Array]] = []

        def keep(s: int, k: int, f: Any = f, last: Any = last) -> list[Array]:
            last[:] = [f(s, k)]
            return list(last[0])

        out[name] = curve(keep, c, lambda g: float(np.mean(relative(g))), 1 if quick else 2)
        out[name] |= {"maps": relative(last[0]), "cosines": cosines(last[0])}
    return {"methods": out, "reference_noise": float(np.sqrt(np.mean(noise2)))}


def specialisation(n: int, samples: int) -> list[list[Any]]:
    """Kernel size and time of the fast estimator, by what the scene has."""
    case = Case("glossy", n)
    plain = make_environment("sun")
    plain[plain > 5] = 0.3
    flat = Maps(*(np.broadcast_to(x[:1, :1], x.shape) for x in (
        case.maps.diffuse, case.maps.specular, case.maps.roughness, case.maps.normal)))  # fmt: skip
    pattern, lit = case.pattern, case.environment
    rows: list[list[Any]] = []
    for name, maps, p, e, jacobian in (
        ("screen, environment, lamps", case.maps, pattern, lit, False),
        ("the same with gradients", case.maps, pattern, lit, True),
        ("no lamps", case.maps, pattern, plain, False),
        ("no lamps, with gradients", case.maps, pattern, plain, True),
        ("no lamps, one material", flat, pattern, plain, False),
        ("screen alone (dark room)", case.maps, pattern, None, False),
        ("environment alone, no lamps", case.maps, None, plain, False),
        ("no light", case.maps, None, None, False),
    ):
        scene = make_scene(RIG, p, e, GAIN)
        prepared = render.prepare(scene)
        material, view = render.material_from_maps(maps), make_view(scene, n, n)
        f = render.pixel_jacobian if jacobian else render.radiance

        def run(f: Any = f, args: Any = (prepared, view, material, samples)) -> None:
            out = f(*args)
            dr.eval(out if not hasattr(out, "__dict__") else list(out.__dict__.values()))
            dr.sync_thread()

        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            run()
            dr.kernel_history_clear()
            run()
            kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        lines = sum(k["operation_count"] for k in kernels)
        rows.append([name, lines, timed(run, 5)[1]])
    return rows


def work(n: int, samples: int) -> dict[str, Any]:
    """Samples a second and floating-point operations a sample of the specular loop.

    Operations: those of the kernel of N samples that the loop's body holds, counted from its LLVM
    code (a fused multiply-add is two).
    """
    case = Case("glossy", n)
    scene = make_scene(RIG, case.pattern, np.full((64, 128, 3), 0.3, np.float32), GAIN)
    prepared, view = render.prepare(scene), make_view(scene, n, n)

    def run(count: int) -> None:
        dr.eval(render.radiance(prepared, view, case.material, count))
        dr.sync_thread()

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        run(1)
        dr.kernel_history_clear()
        run(samples)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    source = max((k["ir"].getvalue() for k in kernels), key=len)
    operations, gathers, inside = 0, 0, False
    for line in source.splitlines():
        if "; Symbolic loop: " in line:
            inside = line.endswith("specular")
        elif line.endswith("_end:"):
            inside = False
        if not inside:
            continue
        if any(op in line for op in (" fadd ", " fsub ", " fmul ", " fdiv ", "@llvm.sqrt")):
            operations += 1
        elif "@llvm.fma" in line:
            operations += 2
        elif "gather" in line:
            gathers += 1
    slope = timed(lambda: run(2 * samples), 5)[1] - timed(lambda: run(samples), 5)[1]
    rate = n * n * samples / max(slope, 1e-9)
    m = machine()
    peak = m["cores"] * m["mhz"] * 1e6 * m["simd_floats"] * 4
    return {
        "samples_per_second": rate,
        "flops_per_sample": operations,
        "gathers_per_sample": gathers,
        "flops_per_second": rate * operations,
        "peak_flops": peak,
        "share_of_peak": rate * operations / peak,
    }


def forward_backward(case: Case, samples: int, repeats: int) -> dict[str, float]:
    """Seconds of the image alone, and of the image with the gradients of a loss."""
    view = make_view(case.scene, case.n, case.n)
    out: dict[str, float] = {}
    for estimator in ("fast", "mis"):

        def forward(e: str = estimator) -> None:
            dr.eval(render.radiance(case.prepared[e], view, case.material, samples))
            dr.sync_thread()

        def both(e: str = estimator) -> None:
            m = render.Material(*(
                type(v)(v) for v in (case.material.diffuse, case.material.specular,
                                     case.material.roughness, case.material.normal)))  # fmt: skip
            leaves = [m.diffuse, m.specular, m.roughness, m.normal]
            dr.enable_grad(leaves)
            color = render.radiance(case.prepared[e], view, m, samples)
            dr.backward(dr.sum(dr.squared_norm(color - 0.5)))
            dr.eval([dr.grad(v) for v in leaves])
            dr.sync_thread()

        # Interleaved, so that other work on the machine slows both alike.
        forward()
        both()
        pairs = []
        for _ in range(repeats):
            start = time.perf_counter()
            forward()
            middle = time.perf_counter()
            both()
            pairs.append((middle - start, time.perf_counter() - middle))
        out[estimator] = statistics.median(b / a for a, b in pairs)
        out[estimator + " forward"] = statistics.median(a for a, _ in pairs)
    return out


def plot(results: dict[str, Any], path: Path) -> None:
    """A panel a scene, a curve a method; both axes logarithmic."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 8), squeeze=False)
    for axis, (name, r) in zip(axes.ravel(), results.items(), strict=False):
        for method, c in r["methods"].items():
            axis.loglog(c["seconds"], c["errors"], "o-", ms=3, label=method)
        axis.axhline(0.02, color="0.7", lw=0.8)
        axis.axhline(0.01, color="0.7", lw=0.8, ls=":")
        axis.set_title(name)
        axis.set_xlabel("seconds")
        axis.set_ylabel("RMS error / mean")
        axis.grid(alpha=0.2)
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


STATISTICAL = {"fast": False, "mis": True, "path": True, "direct": True, "torch": True}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="small, few: ends within a minute")
    args = parser.parse_args()
    quick = args.quick
    n = 64 if quick else 256
    names = ["glossy"] if quick else list(SCENES)
    args.out.mkdir(parents=True, exist_ok=True)
    values: dict[str, Any] = {}
    gradients: dict[str, Any] = {}
    rows: list[list[Any]] = []
    gradient_rows: list[list[Any]] = []
    for name in names:
        case = Case(name, n)
        r = measure_values(case, quick)
        values[name] = r
        seconds = {
            f"{m} {e:.0%}": time_to(e, c["seconds"], c["errors"], STATISTICAL[m])
            for m, c in r["methods"].items()
            for e in (0.02, 0.01)
        }
        r["seconds_to"] = seconds
        rows.append(
            [name, *(seconds[k] for k in ("fast 2%", "path 2%", "direct 2%", "mis 1%", "path 1%")),
             seconds.get("torch 2%", float("nan")), r["prepare"]["fast"], r["prepare"]["mis"],
             r["methods"]["fast"]["cold"], r["reference_noise"]]
        )  # fmt: skip
        small = Case(name, 32 if quick else 128)
        g = measure_gradients(small, quick)
        gradients[name] = g
        curves = g["methods"]
        target = 0.1
        g["seconds_to"] = {
            m: time_to(target, c["seconds"], c["errors"], m != "fast") for m, c in curves.items()
        }
        gradient_rows.append(
            [name, *(g["seconds_to"][m] for m in ("fast", "mis", "prb")),
             curves["fast"]["errors"][-1], min(curves["fast"]["cosines"]),
             min(curves["prb"]["cosines"]), g["reference_noise"]]
        )  # fmt: skip
        print(*rows[-1], "| gradients", *gradient_rows[-1][1:], flush=True)
    plot(values, args.out / "forward.png")

    def ratio(a: str, b: str) -> float:
        return statistics.median(r["seconds_to"][a] / r["seconds_to"][b] for r in values.values())

    both = forward_backward(Case("glossy", n), 64 if not quick else 16, 3 if quick else 7)
    special = specialisation(n, 16 if quick else 64)
    effort = work(n, 16 if quick else 64)
    gradient_ratio = statistics.median(
        g["seconds_to"]["prb"] / g["seconds_to"]["fast"] for g in gradients.values()
    )
    with_prepare = statistics.median(
        r["seconds_to"]["path 2%"] / (r["seconds_to"]["fast 2%"] + r["prepare"]["fast"])
        for r in values.values()
    )
    bars = [
        bar("fast over path at 2%", ratio("path 2%", "fast 2%"), 200, True),
        bar("the same with prepare", with_prepare, 200, True),
        bar("mis over path at 1%", ratio("path 1%", "mis 1%"), 8, True),
        bar("gradients: fast over prb at 10%", gradient_ratio, 50, True),
        bar("forward + backward over forward, fast", both["fast"], 3, False),
        bar("forward + backward over forward, mis", both["mis"], 3, False),
        bar(f"seconds of {n}² at 2%, fast",
            statistics.median(r["seconds_to"]["fast 2%"] for r in values.values()), 0.1, False),
    ]  # fmt: skip
    m = machine()
    text = f"# Forward model\n\n{m['cpu']}, {m['cores']} cores, {m['versions']}; {n}² pixels.\n\n"
    text += "Seconds to an RMS error, of the mean radiance:\n\n" + markdown(
        ["scene", "fast 2%", "path 2%", "direct 2%", "mis 1%", "path 1%", "torch 2%",
         "prepare fast", "prepare mis", "fast cold", "reference's noise"], rows)  # fmt: skip
    text += "\nSeconds to 10% error of the maps' gradients (mean relative norm of the four):\n\n"
    text += markdown(
        ["scene", "fast", "mis", "prb", "fast at most samples", "its least cosine",
         "prb's least cosine", "reference's noise"], gradient_rows)  # fmt: skip
    text += "\nWhat a scene lacks costs nothing:\n\n"
    text += markdown(["case", "operations in the kernel", "seconds"], special)
    text += "\n" + markdown(["work", "value"], [[k, float(v)] for k, v in effort.items()])
    text += "\n" + markdown(["bar", "value", "target", "ok"], [list(b.values()) for b in bars])
    (args.out / "forward.md").write_text(text)
    results = {"values": values, "gradients": gradients, "specialisation": special}
    write_results(args.out, {**results, "work": effort, "forward_backward": both, "bars": bars})


if __name__ == "__main__":
    main()
