"""Train one of the methods that are compared for some minutes of processor time.

    python -m benchmarks.baselines.train METHOD --data DIR --out DIR --minutes 10

``--data`` is what `benchmarks.baselines.flash` made. Writes what `nets.training.train` writes:
last.safetensors to go on from, and METHOD.safetensors, the running mean of the weights in half
precision with the minutes spent, the steps and the options in its header. Learning rates follow the
share of the minutes spent: constant, and over the last quarter down to nothing. Started again with
the same --out it goes on where it stopped.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch

from benchmarks.baselines.methods import METHODS, fresh
from nets.store import save_weights
from nets.training.loader import batches, count, shards
from nets.training.train import Trainer, append_log, keep_memory, learning_rate

# Rates that `benchmarks.baselines.search` chose of ours, LPL+ and these, where not the usual one.
RATE = 2e-3
RATES = {"deepbasis+": 4e-3, "matfusion": 4e-3}
WARM = 50  # steps until the full rate
SAVE_EVERY = 30.0  # seconds of processor time


def train(args: argparse.Namespace) -> Trainer:
    """Run the training that the command line describes."""
    torch.set_num_threads(args.threads)
    torch.manual_seed(args.seed)
    args.out.mkdir(parents=True, exist_ok=True)
    method, peak = args.method, args.rate or RATES.get(args.method, RATE)
    trainer = Trainer(fresh(method), args.out, torch.device("cpu"), args.decay, METHODS[method][1])
    trainer.resume()
    stream = batches(args.data, args.batch, args.crop, args.seed, trainer.step)
    budget, sums, taken = 60 * args.minutes, 0.0, 0
    began, saved = time.process_time() - trainer.seconds, trainer.seconds
    while trainer.seconds < budget:
        share = trainer.seconds / budget
        rate = peak * learning_rate(round(1000 * share), 1000, 1.0, 0.0, 0)
        parts = trainer.update(next(stream), rate * min(1, (trainer.step + 1) / WARM))
        sums, taken = sums + float(parts.get("loss", 0)), taken + bool(parts)
        trainer.seconds = time.process_time() - began
        if trainer.seconds - saved < SAVE_EVERY and trainer.seconds < budget:
            continue
        row = {"step": trainer.step, "seconds": trainer.seconds, "skipped": trainer.skipped}
        row["loss"] = sums / max(taken, 1)
        append_log(args.out / "log.csv", row)
        print(" ".join(f"{k} {v:.4g}" for k, v in row.items()), flush=True)
        notes = {
            "method": method, "minutes": trainer.seconds / 60, "rate": peak, "batch": args.batch,
            "crop": args.crop, "seed": args.seed, "captures": captures(args.data), **row,
        }  # fmt: skip
        trainer.save(notes)
        path = args.out / f"{method}.safetensors"
        save_weights(path, trainer.mean.module, notes, half=True)
        sums, taken, saved = 0.0, 0, trainer.seconds
    return trainer


def captures(folder: Path) -> int:
    """How many captures a folder holds."""
    return sum(map(count, shards(folder)))


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        prog="python -m benchmarks.baselines.train",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("method", choices=tuple(METHODS))
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--minutes", type=float, default=10.0, help="of processor time")
    p.add_argument("--rate", type=float, default=0.0, help="instead of the method's own")
    p.add_argument("--batch", type=int, default=8)
    p.add_argument("--crop", type=int, default=32)
    p.add_argument("--decay", type=float, default=1e-3, help="weight decay")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--threads", type=int, default=1)
    return p


if __name__ == "__main__":
    keep_memory()
    train(parser().parse_args())
