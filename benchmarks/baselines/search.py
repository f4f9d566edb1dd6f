"""Choose each method's learning rate by short trainings, judged on captures that these do not see.

    python -m benchmarks.baselines.search --data DIR --valid DIR --out DIR --minutes 1

Every method is trained for the same processor time at each of `CANDIDATES`; the loss is that of its
running mean of weights. Writes DIR/search.csv, a line a training, and skips what is in it already.
`benchmarks.baselines.train.RATES` holds what it chose.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import torch

from benchmarks.baselines.methods import METHODS
from benchmarks.baselines.train import parser as training_parser
from benchmarks.baselines.train import train
from nets.training.loader import read_batch, shards
from nets.training.train import Trainer, keep_memory

CANDIDATES = (1e-3, 2e-3, 4e-3)
BATCH = 16  # captures judged together


@torch.no_grad()
def held_out_loss(trainer: Trainer, folder: Path) -> float:
    """The mean loss of a folder's captures, whole, under the running mean of the weights."""
    torch.manual_seed(0)  # of the noise that a diffusion's loss draws
    network = trainer.mean.module.train()  # a diffusion's answer in evaluation is a drawn sample
    found = [
        float(trainer.loss(network(batch), batch)[0])
        for path in shards(folder)
        for batch in read_batch(path, BATCH)
    ]
    return sum(found) / len(found)


def main() -> None:
    p = argparse.ArgumentParser(prog="python -m benchmarks.baselines.search", description=__doc__)
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--valid", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=tuple(METHODS))
    p.add_argument("--minutes", type=float, default=1.0, help="of processor time, each")
    args = p.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    table = args.out / "search.csv"
    rows = list(csv.DictReader(table.open())) if table.exists() else []
    done = {(r["method"], float(r["rate"])) for r in rows}
    for rate in CANDIDATES:
        for method in args.methods:
            if (method, rate) in done:
                continue
            out = args.out / f"{method}-{rate:g}"
            options = [method, "--data", str(args.data), "--out", str(out)]
            options += ["--minutes", str(args.minutes), "--rate", str(rate)]
            trainer = train(training_parser().parse_args(options))
            loss = held_out_loss(trainer, args.valid)
            with table.open("a", newline="") as f:
                writer = csv.writer(f)
                if f.tell() == 0:
                    writer.writerow(("method", "rate", "steps", "loss"))
                writer.writerow((method, rate, trainer.step, f"{loss:.6g}"))
            print(f"{method} {rate:g}: {loss:.4f} after {trainer.step} steps", flush=True)


if __name__ == "__main__":
    keep_memory()
    main()
