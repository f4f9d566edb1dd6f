"""Train for some minutes on a GPU that is lent for that long: draw and train at the same time.

    python -m nets.training.gpu --minutes 10 --out DIR --valid NAME=DIR ...
        [--data DIR] [--materials DIR --envs DIR] [--weights FILE] [--batch 48]

One thread draws captures (`nets.training.dataset`), by Dr.Jit's CUDA back end where there is a GPU;
the other trains on random batches of the newest `POOL`, which stay in the device's memory. The
pool begins with the shards of ``--data``, drawn beforehand on a CPU. Learning rates follow the
share of the minutes spent: constant, and over the last quarter down to nothing, so whatever the
machine manages is a finished training. Writes what `nets.training.train` writes: weights, log.csv
with the validation errors of begin and end, curve.png, and the state to go on from.

On a CPU the same command runs with LLVM (that is how it is tested). The CUDA path of this script
has not been run. A capture is drawn on the device but goes through the host's memory once: its
lobes are fitted there, by SciPy.
"""

from __future__ import annotations

import argparse
import itertools
import threading
import time
from collections import deque
from pathlib import Path

import numpy as np
import torch

from nets.batch import Batch, positions
from nets.predict import WEIGHTS
from nets.store import build, load_weights
from nets.training.dataset import Sample, captures, check_options
from nets.training.draw import Options
from nets.training.loader import load_shards, shards
from nets.training.train import (
    Trainer,
    append_log,
    errors_of,
    keep_memory,
    learning_rate,
    plot_log,
    take_up,
)

POOL = 8192  # captures on the device: 13 GB at 128², all that a GPU draws in some minutes
FIRST = 64  # captures to draw before the first step, where no shards are given


class Pool:
    """The newest captures, as tensors on a device; filled by a thread of its own."""

    def __init__(self, device: torch.device, size: int = POOL) -> None:
        self.device = device
        self.samples: deque[Batch] = deque(maxlen=size)
        self.drawn = 0
        self.stop = threading.Event()
        self.failed: list[Exception] = []

    def add(self, sample: Sample) -> None:
        self.samples.append({k: torch.from_numpy(v).to(self.device) for k, v in sample.items()})

    def draw(self, options: Options) -> None:
        """Draw until told to stop; the work of the thread."""
        try:
            for sample in captures(options, 0):
                self.add(sample)
                self.drawn += 1
                if self.stop.is_set():
                    return
        except Exception as e:  # raised again by the thread that waits for captures
            self.failed.append(e)

    def batch(self, rng: np.random.Generator, count: int) -> Batch:
        """Random captures, whole."""
        if self.failed:
            raise self.failed[0]
        chosen = [self.samples[int(i)] for i in rng.integers(len(self.samples), size=count)]
        out = {k: torch.stack([c[k] for c in chosen]) for k in chosen[0]}
        out = {k: v if k == "maps" else v.float() for k, v in out.items()}
        size = out["photo"].shape[-1]
        grid = positions(size, size).to(self.device)
        return {**out, "position": grid.expand(count, -1, -1, -1)}


def train(args: argparse.Namespace) -> Trainer:
    """Run the training that the command line describes."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    options = Options(
        size=args.size, materials=args.materials, envs=args.envs, procedural=args.procedural,
        seed=args.seed,
    )  # fmt: skip
    check_options(options)
    args.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(args.seed)
    network = build(args.preset)
    if args.weights:
        take_up(network, load_weights(args.weights)[0])
    trainer = Trainer(network, args.out, device, args.decay)
    pool = Pool(device)
    for path in shards(args.data) if args.data else []:
        stored = load_shards([path], torch.device("cpu"))
        for i in range(len(stored["photo"])):
            pool.add({k: v[i].numpy() for k, v in stored.items()})
    valid = {k: Path(v) for k, v in (v.split("=", 1) for v in args.valid)}
    thread = threading.Thread(target=pool.draw, args=(options,), daemon=True)
    thread.start()
    try:
        while len(pool.samples) < min(FIRST, args.batch) and not pool.failed:
            time.sleep(0.1)
        log(trainer, valid, args, pool)
        rng = np.random.default_rng(args.seed)
        start = time.perf_counter()
        for step in itertools.count():
            share = (time.perf_counter() - start) / (60 * args.minutes)
            if share >= 1 and step > 0:
                break
            rate = args.rate * learning_rate(round(1000 * min(share, 1)), 1000, 1.0, 0.0, 0)
            trainer.update(pool.batch(rng, args.batch), rate * min(1, (step + 1) / args.warm))
    finally:
        pool.stop.set()
        thread.join()
    trainer.seconds = time.perf_counter() - start
    log(trainer, valid, args, pool)
    return trainer


def log(trainer: Trainer, valid: dict[str, Path], args: argparse.Namespace, pool: Pool) -> None:
    """Validate, and write a line, the curve and the weights."""
    row = {"step": trainer.step, "seconds": trainer.seconds, "drawn": pool.drawn}
    row |= errors_of(trainer, valid, args.valid_count)
    append_log(args.out / "log.csv", row)
    plot_log(args.out / "log.csv", args.out / "curve.png")
    trainer.save({"hours": trainer.seconds / 3600, **row})
    print(" ".join(f"{k} {v:.4g}" for k, v in row.items() if "coverage_" not in k), flush=True)


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m nets.training.gpu", description=__doc__)
    p.add_argument("--minutes", type=float, default=10.0)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--data", type=Path, help="shards to begin with")
    p.add_argument("--valid", nargs="*", default=[], metavar="NAME=DIR")
    p.add_argument("--valid-count", type=int, default=256, help="captures of each")
    p.add_argument("--weights", type=Path, default=WEIGHTS / "small.safetensors")
    p.add_argument("--preset", default="small")
    p.add_argument("--materials", default="")
    p.add_argument("--envs", default="")
    p.add_argument("--procedural", type=float, default=0.4)
    p.add_argument("--size", type=int, default=128)
    p.add_argument("--batch", type=int, default=48)
    p.add_argument("--rate", type=float, default=5e-4)
    p.add_argument("--warm", type=int, default=100, help="steps until the full rate")
    p.add_argument("--decay", type=float, default=1e-3, help="weight decay")
    p.add_argument("--seed", type=int, default=0)
    return p


if __name__ == "__main__":
    keep_memory()
    train(parser().parse_args())
