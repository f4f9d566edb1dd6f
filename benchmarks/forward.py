"""The forward model against general renderers: error, and error of gradients, over time.

All times are warm medians of one run on one machine; compilation and `prepare` are reported beside
them. forward.png has RMS error against seconds, a panel a scene. Where a Monte Carlo method would
take minutes, its time is extrapolated from its last two measurements' mean by 1/√N. What a kernel
costs, and the fast estimator's bias, are in `forward_cost`.
"""

from __future__ import annotations

import argparse
import statistics
from typing import Any

import numpy as np

from benchmarks.common.gradients import forward_backward, measure_gradients
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import bar, benchmark_parser, table, write_results
from benchmarks.common.scenes import GAIN, RIG, SCENES, Array, Case, averaged, curve, time_to
from benchmarks.common.timing import timed
from invrender.render.backend import dr


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

        from benchmarks.baselines.torch_forward import TorchScene

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


STATISTICAL = {"fast": False, "mis": True, "path": True, "direct": True, "torch": True}


def parser() -> argparse.ArgumentParser:
    return benchmark_parser(__doc__, "one small scene, few samples")


def main(args: argparse.Namespace) -> None:
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
    panels = {
        name: {m: (c["seconds"], c["errors"]) for m, c in r["methods"].items()}
        for name, r in values.items()
    }
    plot_error_over_time(args.out / "forward.png", panels, y="RMS / mean", levels=(0.02, 0.01))

    def ratio(a: str, b: str) -> float:
        return statistics.median(r["seconds_to"][a] / r["seconds_to"][b] for r in values.values())

    both = forward_backward(Case("glossy", n), 64 if not quick else 16, 3 if quick else 7)
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
    image = table(
        ["seconds to an RMS error of", "fast 2%", "path 2%", "direct 2%", "mis 1%", "path 1%",
         "torch 2%", "prepare fast", "prepare mis", "fast cold", "reference's noise"],
        rows,
    )  # fmt: skip
    ten_percent = table(
        ["seconds to 10% error of the gradients", "fast", "mis", "prb", "fast at most samples",
         "its least cosine", "prb's least cosine", "reference's noise"], gradient_rows)  # fmt: skip
    results = {"values": values, "gradients": gradients, "forward_backward": both, "bars": bars}
    write_results(args.out, results, {"image": image, "gradients": ten_percent})
