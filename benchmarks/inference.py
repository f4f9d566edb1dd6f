"""Error of the initial maps against the time they take, for ours, a tiny one and the paper's.

Seconds of one sample of 256 × 256 pixels, lights and clues included, median of several; each
network's error on folders of `nets.training.dataset` (docs/guide/training.md), without and with
--quick on a few small procedural captures. Networks without weights are timed alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.baselines.ablations import Paper
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import bar, benchmark_parser, table, write_results
from benchmarks.common.timing import timed
from invrender.data.environments import procedural_environment
from invrender.lights import Lights
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from nets.model import MAPS
from nets.predict import WEIGHTS, Reconstructor
from nets.store import build, channels_last
from nets.training.dataset import write_shard
from nets.training.draw import Options
from nets.training.train import baseline, validate

SIZE = 256
BARS = {"real": 0.041, "families": 0.043, "made": 0.050}  # average RMSE of the shipped network


def seconds(network: Reconstructor, repeats: int) -> float:
    """Median time of a sample's maps, one sample done before."""
    photo = np.random.default_rng(0).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    pattern, room = default_pattern(128), procedural_environment(0, 64)
    return timed(lambda: network(photo, Lights(Rig(), pattern, room)), repeats)[1]


def millions(network: torch.nn.Module) -> float:
    return sum(x.numel() for x in network.parameters()) / 1e6


def parser() -> argparse.ArgumentParser:
    p = benchmark_parser(__doc__, "a few captures, a few repetitions")
    p.add_argument("--weights", type=Path, nargs="*", default=[WEIGHTS / "small.safetensors"])
    p.add_argument("--valid", nargs="*", default=[], metavar="NAME=DIR")
    return p


def main(args: argparse.Namespace) -> None:
    args.out.mkdir(parents=True, exist_ok=True)
    if args.quick or not args.valid:
        write_shard(args.out, 0, Options(size=32, samples=8, split="holdout"), 16)
        args.valid = [f"made={args.out}"]
    sets = {k: Path(v) for k, v in (item.split("=", 1) for item in args.valid)}
    repeats = 3 if args.quick else 15

    rows: list[list[Any]] = []
    points = []
    for path in args.weights:
        known = Reconstructor(path)
        errors = {k: validate(known.network, v, torch.device("cpu")) for k, v in sets.items()}
        points.append((path.stem, seconds(known, repeats), errors))
        start = [path.stem, millions(known.network), points[-1][1]]
        rows += [[*start, k, *(e[m] for m in (*MAPS, "average"))] for k, e in errors.items()]
    untrained = Reconstructor(args.weights[0])
    for name, network in (("tiny", build("tiny")), ("paper", channels_last(Paper()))):
        untrained.network = network.eval()
        rows.append(
            [name, millions(network), seconds(untrained, repeats), "untrained", *[None] * 5]
        )
    for k, folder in sets.items():
        guess = baseline(folder, 128)
        rows.append(["a constant guess", None, None, k, *(guess[m] for m in (*MAPS, "average"))])
    header = ["network", "million parameters", "seconds", "set", *MAPS, "average"]
    panel = {k: {name: ([s], [e[k]["average"]]) for name, s, e in points} for k in sets}
    plot_error_over_time(
        args.out / "inference.png", panel, x=f"seconds for {SIZE}²", y="average map RMSE"
    )
    name, _, errors = points[0]
    bars = [bar(f"average map RMSE of {name}, {k}", errors[k]["average"], BARS[k], False)
            for k in sets if k in BARS]  # fmt: skip
    write_results(args.out, {"bars": bars}, {"networks": table(header, rows)})
