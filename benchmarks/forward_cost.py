"""What the forward model costs and how far its fast estimator is off.

Kernel sizes and times by what a scene has; samples and floating-point operations a second, against
what this machine reaches; memory of a 4096² render; bias of the fast estimator over samples.
forward_cost.png has the bias over samples.
"""

from __future__ import annotations

import argparse
import re
import resource
import statistics
import subprocess
import sys
import time
from collections import Counter
from typing import Any

import numpy as np

from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import bar, benchmark_parser, table, write_results
from benchmarks.common.scenes import (
    GAIN,
    RIG,
    SCENES,
    Array,
    Case,
    averaged,
    make_environment,
    make_maps,
)
from invrender.maps import Maps
from invrender.render import Fast, Material
from invrender.render.backend import Float, UInt, dr
from invrender.render.renderer import tile_of
from invrender.render.scene import make_scene, make_view

LIMIT = 4.0  # GB that a 4096² render may take


# --- what a scene lacks ---------------------------------------------------------------------------


def specialisation(n: int, samples: int, rounds: int) -> list[list[Any]]:
    """[case, operations, seconds, and the two with gradients] by what a scene has; the cases take
    turns, so that other work on the machine slows all alike."""
    case = Case("glossy", n)
    plain = make_environment("sun")
    plain[plain > 5] = 0.3
    one = Maps(*(np.broadcast_to(x[:1, :1], x.shape) for x in (
        case.maps.diffuse, case.maps.specular, case.maps.roughness, case.maps.normal)))  # fmt: skip
    pattern, lit = case.pattern, case.environment
    cases = {
        "screen, environment, lamps": (case.maps, pattern, lit),
        "no lamps": (case.maps, pattern, plain),
        "no lamps, one material": (one, pattern, plain),
        "no environment (dark room)": (case.maps, pattern, None),
        "no screen, no lamps": (case.maps, None, plain),
        "no light": (case.maps, None, None),
    }
    runs = []
    for maps, p, e in cases.values():
        scene = make_scene(RIG, p, e, GAIN)
        renderer = Fast(scene)
        args = (make_view(scene, n, n), tile_of(maps, 0, n * n))
        for f in (renderer.radiance, renderer.pixel_jacobian):

            def run(f: Any = f, args: Any = (*args, samples)) -> None:
                out = f(*args)
                dr.eval(out if f.__name__ == "radiance" else list(out.__dict__.values()))
                dr.sync_thread()

            runs.append(run)
    kernels = []
    for run in runs:
        run()
        kernels.append(largest_kernel(run))
    times: list[list[float]] = [[] for _ in runs]
    for _ in range(rounds):
        for run, list_ in zip(runs, times, strict=True):
            start = time.perf_counter()
            run()
            list_.append(time.perf_counter() - start)
    rows: list[list[Any]] = []
    for i, name in enumerate(cases):
        row: list[Any] = [name]
        for k in (2 * i, 2 * i + 1):
            row += [kernels[k].get("operation_count", 0), statistics.median(times[k])]
        rows.append(row)
    return rows


def largest_kernel(run: Any) -> dict[str, Any]:
    """Dr.Jit's record of the largest kernel that a call launches, empty where it launches none."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        run()
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    return max(kernels, key=lambda k: k["operation_count"], default={})


# --- how far from the limit -----------------------------------------------------------------------

FLOPS = {"fma": 2, "fadd": 1, "fsub": 1, "fmul": 1, "fdiv": 1, "sqrt": 1, "rsqrt": 1}


def loop_instructions(source: str, label: str) -> Counter[str]:
    """Vector instructions in a loop of a kernel's LLVM code, by name."""
    counts: Counter[str] = Counter()
    inside = False
    for line in source.splitlines():
        if "; Symbolic loop: " in line:
            inside = line.rstrip().endswith(label)
        elif line.endswith("_end:"):
            inside = False
        call = re.search(r"= (?:tail )?call .*?@(?:llvm\.)?(?:x86\.\w+\.)?(\w+)", line)
        plain = re.search(r"= (\w+) .*<\d+ x ", line)
        if inside and (call or plain):
            counts[call[1] if call else plain[1]] += 1  # type: ignore[index]
    return counts


def multiply_adds() -> tuple[Any, float]:
    """(a kernel of independent multiply-adds, its floating-point operations): the peak."""
    lanes, chains, steps, unrolled = 1 << 17, 10, 4, 16

    def run() -> None:
        x = [Float(k + 1) + dr.arange(Float, lanes) for k in range(chains)]
        a = dr.opaque(Float, 0.999)

        def body(i: Any, *x: Any) -> tuple[Any, ...]:
            for _ in range(unrolled):
                x = tuple(dr.fma(v, a, a) for v in x)
            return (i + 1, *x)

        start = (dr.zeros(UInt, lanes), *x)
        limit = dr.opaque(UInt, steps)
        _, *out = dr.while_loop(start, lambda i, *_: i < limit, body, label="peak")
        dr.eval(out)

    return run, 2.0 * lanes * chains * steps * unrolled


def work(n: int, samples: int, rounds: int) -> dict[str, float]:
    """Samples a second and floating-point operations a sample of the specular loop.

    The time of 2N samples less that of N counts: what is done once a pixel cancels. Narrow lobes
    read a few cache lines, wide ones all over the tables: their ratio tells what memory costs.
    """
    pattern, environment = Case("glossy", 8).pattern, np.full((64, 128, 3), 0.3, np.float32)
    scene = make_scene(RIG, pattern, environment, GAIN)
    renderer, view = Fast(scene), make_view(scene, n, n)
    materials = {
        name: Material.from_maps(make_maps(n, rho, rho + 1e-4, 0.0, 0.15))
        for name, rho in (("narrow", 0.02), ("wide", 0.7))
    }

    def run(name: str, count: int) -> None:
        dr.eval(renderer.radiance(view, materials[name], count))

    run("wide", 1)
    kernel = largest_kernel(lambda: run("wide", samples))
    counts = loop_instructions(kernel["ir"].getvalue(), "specular")
    flops = sum(FLOPS.get(k, 0) * v for k, v in counts.items())
    fma, fma_flops = multiply_adds()
    # They take turns and the best of each counts: other work on the machine slows all alike.
    jobs = {
        (name, k): (lambda a=name, b=k * samples: run(a, b)) for name in materials for k in (1, 2)
    }
    jobs["peak", 0] = fma
    best = dict.fromkeys(jobs, float("inf"))
    for _ in range(rounds):
        for key, job in jobs.items():
            start = time.perf_counter()
            job()
            dr.sync_thread()
            best[key] = min(best[key], time.perf_counter() - start)
    rate = {k: n * n * samples / (best[k, 2] - best[k, 1]) for k in materials}
    peak = fma_flops / best["peak", 0]
    return {
        "samples a second": rate["wide"],
        "the same, narrow lobes (tables in cache)": rate["narrow"],
        "floating-point operations a sample": float(flops),
        "vector instructions a sample": float(sum(counts.values())),
        "of them arithmetic": float(sum(v for k, v in counts.items() if k in FLOPS)),
        "of them gathers of RGBA": float(sum(v for k, v in counts.items() if "gather" in k)),
        "floating-point operations a second": rate["wide"] * flops,
        "peak, a kernel of multiply-adds": peak,
        "share of peak": rate["wide"] * flops / peak,
    }


# --- memory ---------------------------------------------------------------------------------------


def memory(n: int, samples: int) -> dict[str, float]:
    """Peak memory (GB) and seconds of an n² render in a process of its own."""
    command = [
        sys.executable,
        "-m",
        "benchmarks",
        "forward_cost",
        "--out",
        ".",
        "--render",
        str(n),
        str(samples),
    ]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    before, peak, seconds = map(float, out)
    return {"pixels a side": n, "GB": peak, "of it maps and program": before, "seconds": seconds}


def render_once(n: int, samples: int) -> None:
    """Render n² maps and print peak memory (GB) before and after, and the seconds."""
    usage = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # noqa: E731
    small = make_maps(64, *SCENES["glossy"][:4])
    grow = lambda a: np.repeat(np.repeat(a, n // 64, 0), n // 64, 1)  # noqa: E731
    maps = Maps(*(grow(getattr(small, k)) for k in ("diffuse", "specular", "roughness", "normal")))
    pattern = np.random.default_rng(0).uniform(size=(64, 64, 3))
    before, start = usage(), time.perf_counter()
    image = Fast(make_scene(RIG, pattern, make_environment("sun"), GAIN)).render(maps, samples)
    assert np.all(np.isfinite(image))
    print(before, usage(), time.perf_counter() - start)


# --- bias -----------------------------------------------------------------------------------------


def bias(name: str, n: int, counts: list[int], quick: bool) -> dict[str, Any]:
    """RMS difference of `fast` from the converged `mis`, of the mean, by samples; and with tables
    of twice the size at the most samples."""
    case = Case(name, n)
    rounds, runs = (256, 4) if quick else (2048, 16)
    (reference,), (a,), (b,) = averaged(lambda seed: case.ours("mis", rounds, seed), runs)
    noise2 = np.mean((a - b) ** 2) / 4

    def error(image: Array) -> float:
        return float(np.sqrt(max(np.mean((image - reference) ** 2) - noise2, 0)) / reference.mean())

    errors = [error(case.ours("fast", k, 1)) for k in counts]
    case.renderers["fast"] = Fast(case.scene, 2)
    return {
        "samples": counts,
        "errors": errors,
        "detailed": error(case.ours("fast", counts[-1], 1)),
        "reference_noise": float(np.sqrt(noise2) / reference.mean()),
    }


def parser() -> argparse.ArgumentParser:
    p = benchmark_parser(__doc__, "small, few samples")
    p.add_argument("--render", type=int, nargs=2, help=argparse.SUPPRESS)
    return p


def main(args: argparse.Namespace) -> None:
    if args.render:
        render_once(*args.render)
        return
    quick, n = args.quick, 64 if args.quick else 256
    args.out.mkdir(parents=True, exist_ok=True)
    special = specialisation(n, 16 if quick else 64, 3 if quick else 9)
    effort = work(n, 16 if quick else 64, 3 if quick else 9)
    used = memory(1024 if quick else 4096, 16)
    counts = [16, 64] if quick else [4, 16, 64, 256, 1024, 4096]
    names = list(SCENES)[:2] if quick else list(SCENES)
    off = {k: bias(k, 32 if quick else 64, counts, quick) for k in names}
    curves = {k: (r["samples"], r["errors"]) for k, r in off.items()}
    curves |= {
        f"{k}, tables twice as large": (r["samples"][-1:], [r["detailed"]]) for k, r in off.items()
    }
    panel = {"difference of fast from mis": curves}
    plot_error_over_time(args.out / "forward_cost.png", panel, x="samples a pixel", y="RMS / mean")
    bars = [bar("GB of a 4096² render", used["GB"], LIMIT, False)] if not quick else []
    fixed = ["scene", *(f"{k} samples" for k in counts), "tables twice as large", "noise"]
    rows = [[k, *r["errors"], r["detailed"], r["reference_noise"]] for k, r in off.items()]
    tables = {
        "what a scene lacks": table(
            ["scene", "operations", "seconds", "operations with gradients", "their seconds"],
            special,
        ),
        "the specular loop": table(["", ""], [[k, v] for k, v in effort.items()]),
        "a large render": table(["", ""], [[k, v] for k, v in used.items()]),
        "difference of fast from mis": table(fixed, rows),
    }
    results = {"specialisation": special, "work": effort, "memory": used, "bias": off}
    write_results(args.out, {**results, "bars": bars}, tables)
