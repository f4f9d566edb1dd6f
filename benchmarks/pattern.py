"""The light pattern: expected map errors under several patterns, and the optimiser's convergence.

With ``--networks`` also the errors of one small network trained under white and under the default
pattern. Everything is measured on a population of pixels and rooms that no search has seen.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import bar, benchmark_parser, table, write_results
from invrender.colour import linear_to_srgb
from invrender.files.images import read_image
from invrender.files.write import write_exr
from invrender.pattern.default import block_pattern, default_pattern
from invrender.pattern.design import (
    DARKEST,
    NAMES,
    PATTERN_CELLS,
    Criterion,
    draw_population,
    measure_responses,
    optimise,
    wheel,
)
from invrender.rig import Rig
from invrender.sampling import resize_pattern

Array = NDArray[np.floating[Any]]
TRAIN, HELD_OUT = 101, 102  # populations; the shipped pattern comes from 1 and 2
EARLIER = 0.8  # of white's map error, that a network under the pattern may have at most


def candidates(extra: list[Path]) -> dict[str, Array]:
    """Patterns (PATTERN_CELLS, PATTERN_CELLS, 3) to compare, and files."""
    u = (np.arange(PATTERN_CELLS) + 0.5) / PATTERN_CELLS
    x, y = np.meshgrid(u, u[::-1])
    one = np.ones_like(x)
    shapes = {
        "white": np.stack([one] * 3, -1),
        "gradient": np.stack([x, y, (1 - x + 1 - y) / 2], -1),
        "stripes": np.stack([0.5 + 0.5 * np.sin(8 * np.pi * x + 2.1 * k) for k in range(3)], -1),
        "step edge": np.stack([one * (x < 0.5), one * (y < 0.5), one * (x >= 0.5)], -1),
        "random colours": np.random.default_rng(0).uniform(size=(PATTERN_CELLS, PATTERN_CELLS, 3)),
        "colour blocks": resize_pattern(block_pattern(), PATTERN_CELLS),
        "hue wheel": wheel(),
        "default": resize_pattern(default_pattern(), PATTERN_CELLS),
    }
    shapes |= {
        p.parent.name + "/" + p.stem: resize_pattern(read_image(p), PATTERN_CELLS) for p in extra
    }
    return {k: np.clip(p, DARKEST, 1) for k, p in shapes.items()}


def convergence(
    train: Criterion, held_out: Criterion, starts: dict[str, Array], iterations: int
) -> dict[str, list[tuple[float, float]]]:
    """(seconds, criterion on the held-out population) of searches from several starts."""
    curves = {}
    for name, start in starts.items():
        marks: list[tuple[float, Array]] = []
        begin = time.perf_counter()

        def cost(p: Array, marks: Any = marks, begin: float = begin) -> tuple[float, Array]:
            marks.append((time.perf_counter() - begin, p.copy()))
            return train(p)

        optimise(cost, start, iterations)
        picked = marks[:: max(len(marks) // 12, 1)]
        curves[name] = [(t, held_out.errors(p)["criterion"]) for t, p in picked]
    return curves


def networks(args: argparse.Namespace, patterns: dict[str, Array]) -> dict[str, dict[str, float]]:
    """Map errors of the same network after the same steps on the same captures but the pattern."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([".", os.environ.get("PYTHONPATH", "")])}

    def python(*command: object) -> None:
        subprocess.run([sys.executable, *map(str, command)], env=env, check=True)

    folders = [f"--{k}={v}" for k in ("materials", "envs") if (v := getattr(args, k))]
    result = {}
    for name, pattern in patterns.items():
        root = args.out / "networks" / name.replace(" ", "-")
        root.mkdir(parents=True, exist_ok=True)
        file = root / "pattern.exr"
        write_exr(file, resize_pattern(pattern, 256))
        data = ["-m", "nets.training.dataset", "--size", 96, "--pattern", file, *folders]
        python(*data, "--out", root / "train", "--count", args.captures)
        python(
            *data, "--out", root / "valid", "--count", 128, "--first", 9000,
            *(["--split", "holdout"] if folders else []),
        )  # fmt: skip
        for seed in range(args.seeds):
            out = root / f"seed{seed}"
            python(
                "-m", "nets.training.train", "--data", root / "train",
                "--valid", f"v={root / 'valid'}",
                "--out", out, "--steps", args.steps, "--every", args.steps // 4, "--crop", 64,
                "--seed", seed,
            )  # fmt: skip
        logs = []
        for seed in range(args.seeds):
            with open(root / f"seed{seed}" / "log.csv", newline="") as f:
                logs.append(list(csv.DictReader(f))[-1])
        result[name] = {
            k: float(np.mean([float(row[f"v_{k}"]) for row in logs])) for k in (*NAMES, "average")
        }
    return result


def plot(
    out: Path, patterns: dict[str, Array], errors: dict[str, Any], curves: dict[str, Any]
) -> None:
    """pattern.png: each pattern over its criterion; pattern_convergence.png."""
    figure, axes = plt.subplots(1, len(patterns), figsize=(2.1 * len(patterns), 2.7))
    for ax, (name, pattern) in zip(axes, patterns.items(), strict=True):
        ax.imshow(linear_to_srgb(resize_pattern(pattern, 128)))
        ax.set_title(f"{name}\n{errors[name]['criterion']:.3f}", fontsize=10)
        ax.axis("off")
    figure.tight_layout()
    figure.savefig(out / "pattern.png", dpi=60)
    plt.close(figure)
    panel: Any = {name: tuple(zip(*curve, strict=True)) for name, curve in curves.items()}
    plot_error_over_time(
        out / "pattern_convergence.png", {"held-out population": panel}, y="criterion"
    )


def parser() -> argparse.ArgumentParser:
    parser = benchmark_parser(__doc__, "small populations, few iterations")
    parser.add_argument("--pattern", type=Path, nargs="*", default=[], help="more to compare")
    parser.add_argument("--networks", action="store_true", help="train networks too (an hour)")
    parser.add_argument("--materials", default="", help="folder of materials for the networks")
    parser.add_argument("--envs", default="", help="folder of environments for the networks")
    parser.add_argument("--captures", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--seeds", type=int, default=1)
    return parser


def main(args: argparse.Namespace) -> None:
    args.out.mkdir(parents=True, exist_ok=True)

    rig, groups = Rig(), 64 if args.quick else 480
    begin = time.perf_counter()
    train = Criterion(measure_responses(rig, draw_population(rig, groups, TRAIN), samples=128))
    held_out = Criterion(measure_responses(rig, draw_population(rig, groups, HELD_OUT)))
    seconds = time.perf_counter() - begin
    patterns = candidates(args.pattern)
    errors = {k: held_out.errors(p) for k, p in patterns.items()}
    lines = [[k, *(e[m] for m in (*NAMES, "criterion"))] for k, e in errors.items()]
    lines.append(["(prior)", *np.sqrt(held_out.prior_mse).tolist(), 1.0])
    tables = {"expected errors": table(["pattern", *NAMES, "criterion"], lines)}
    starts = {k: patterns[k] for k in ("hue wheel", "random colours", "white")}
    curves = convergence(train, held_out, starts, 5 if args.quick else 60)
    plot(args.out, patterns, errors, curves)

    white, ours = errors["white"], errors["default"]
    bits = {m: float(np.log2(white[m] / ours[m])) for m in NAMES}
    print("bits over white:", ", ".join(f"{m} {b:.2f}" for m, b in bits.items()))
    others = min(errors[k]["criterion"] for k in list(patterns)[:6])
    bars = [
        bar("criterion, default over white", ours["criterion"] / white["criterion"], 1.0, False),
        bar("criterion, default over best hand-made", ours["criterion"] / others, 1.0, False),
    ]
    results: dict[str, Any] = {
        "errors": errors, "bits_over_white": bits, "responses_seconds": seconds, "curves": curves,
    }  # fmt: skip
    if args.networks:
        trained = networks(args, {k: patterns[k] for k in ("white", "colour blocks", "default")})
        tables["networks"] = table(
            ["network under", *NAMES, "average"],
            [[k, *(e[m] for m in (*NAMES, "average"))] for k, e in trained.items()],
        )
        ratio = trained["default"]["average"] / trained["white"]["average"]
        bars.append(bar("network's map error, default over white", ratio, EARLIER, False))
        results["networks"] = trained
    write_results(args.out, {"bars": bars, **results}, tables)
