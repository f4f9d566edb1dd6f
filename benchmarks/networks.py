"""Ablations of the network at equal steps: validation error against training time.

Every variant sees the same captures in the same order, from the same seed. ``--data`` and
``--valid`` are folders of `nets.training.dataset` (docs/guide/training.md); without, and with
--quick, a few procedural captures are made first. Training goes on where an earlier run stopped.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import torch

from benchmarks.baselines.ablations import VARIANTS
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import bar, benchmark_parser, table, write_results
from nets.model import MAPS
from nets.store import CONFIGS, channels_last
from nets.training.dataset import write_shard
from nets.training.draw import Options
from nets.training.train import baseline, train
from nets.training.train import parser as train_parser

FULL, NONE = "+ lobes (ours)", "no clues (LPL+)"


def make_data(out: Path) -> None:
    """A few small procedural captures, for --quick."""
    for split in ("train", "holdout"):
        folder = out / split
        folder.mkdir(parents=True, exist_ok=True)
        write_shard(folder, 0, Options(size=32, samples=8, split=split), 16)


def train_variant(name: str, args: argparse.Namespace) -> list[dict[str, float]]:
    """Train a variant and return its log."""
    out = args.out / "runs" / name.replace(" ", "-").strip("+-").replace("(", "").replace(")", "")
    variant, loss = VARIANTS[name]
    options = train_parser().parse_args([
        "--data", str(args.data), "--out", str(out), "--valid", *args.valid,
        "--steps", str(args.steps), "--every", str(args.every),
        "--crop", str(args.crop), "--batch", str(args.batch), "--valid-count", "96",
        "--threads", str(args.threads), "--device", args.device,
    ])  # fmt: skip
    torch.manual_seed(options.seed)
    train(options, channels_last(variant(CONFIGS[args.preset][1])), loss)
    with open(out / "log.csv", newline="") as f:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(f)]


def parser() -> argparse.ArgumentParser:
    p = benchmark_parser(__doc__, "a few steps on a few captures")
    p.add_argument("--data", type=Path)
    p.add_argument("--valid", nargs="*", default=[], metavar="NAME=DIR")
    p.add_argument("--preset", default="tiny")
    p.add_argument("--variant", choices=tuple(VARIANTS), action="append", help="only this one")
    p.add_argument("--steps", type=int, default=3000)
    p.add_argument("--crop", type=int, default=64)
    p.add_argument("--batch", type=int, default=8)
    p.add_argument("--threads", type=int, default=1)
    p.add_argument("--device", default="cpu")
    return p


def main(args: argparse.Namespace) -> None:
    args.every = max(args.steps // 10, 1)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.quick or args.data is None:
        make_data(args.out)
        args.data, args.valid = args.out / "train", [f"made={args.out / 'holdout'}"]
        args.steps, args.every, args.crop = 4, 2, 32

    logs = {name: train_variant(name, args) for name in args.variant or VARIANTS}
    sets = dict(v.split("=", 1) for v in args.valid)
    rows: list[list[Any]] = []
    bars = []
    for valid, folder in sets.items():
        constant = baseline(Path(folder), 96)
        rows.append([valid, "a constant guess", None, *(constant[k] for k in (*MAPS, "average"))])
        for name, log in logs.items():
            last = log[-1]
            errors = [last[f"{valid}_{k}"] for k in (*MAPS, "average")]
            rows.append([valid, name, round(last["seconds"]), *errors])
        if FULL in logs and NONE in logs:
            ratio = logs[FULL][-1][f"{valid}_average"] / logs[NONE][-1][f"{valid}_average"]
            name = f"average map RMSE, ours over no clues, {valid}"
            bars.append(bar(name, ratio, 0.84, at_least=False))
    header = ["set", "variant", "seconds", *MAPS, "average"]
    panels = {
        valid: {
            name: ([r["seconds"] for r in log], [r[f"{valid}_average"] for r in log])
            for name, log in logs.items()
        }
        for valid in sets
    }
    plot_error_over_time(
        args.out / "networks.png", panels, x="seconds of training", y="average map RMSE"
    )
    result = {"logs": logs, "steps": args.steps, "preset": args.preset, "bars": bars}
    write_results(args.out, result, {"errors": table(header, rows)})
