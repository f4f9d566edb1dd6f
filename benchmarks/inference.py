"""Error of the initial maps against the time they take, for the networks' presets.

    python benchmarks/inference.py --out DIR [--quick] [--weights FILE ...] [--valid NAME=DIR ...]

Seconds of one sample of 256 × 256 pixels, lights and clues included, median of several; each
network's error on folders of `nets.training.dataset` (see docs/networks.md), without them and with
--quick on a few small procedural captures. Presets without weights are timed alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import markdown, timed, write_results
from matplotlib import pyplot as plt

from invrender.data.environments import procedural_environment
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from nets.model import MAPS
from nets.predict import WEIGHTS, Reconstructor
from nets.store import PRESETS, build, save_weights
from nets.training.dataset import write_shard
from nets.training.draw import Options
from nets.training.train import baseline, validate

SIZE = 256


def seconds(network: Reconstructor, repeats: int) -> float:
    """Median time of a sample's maps, one sample done before."""
    photo = np.random.default_rng(0).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    pattern, room = default_pattern(128), procedural_environment(0, 64)
    return timed(lambda: network(photo, Rig(), pattern, np.ones(3), room), repeats)[1]


def millions(network: torch.nn.Module) -> float:
    return sum(x.numel() for x in network.parameters()) / 1e6


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--quick", action="store_true", help="a few captures, a few repetitions")
    p.add_argument("--weights", type=Path, nargs="*", default=[WEIGHTS / "small.safetensors"])
    p.add_argument("--valid", nargs="*", default=[], metavar="NAME=DIR")
    args = p.parse_args()
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
    for name, config in PRESETS.items():
        if config.correction or name in [path.stem for path in args.weights]:
            continue
        fresh, file = build(name), args.out / f"untrained_{name}.safetensors"
        save_weights(file, fresh, {})
        time = seconds(Reconstructor(file), repeats)
        rows.append([name, millions(fresh), time, "untrained", *[""] * 5])
        file.unlink()
    for k, folder in sets.items():
        guess = baseline(folder, 128)
        rows.append(["a constant guess", "", "", k, *(guess[m] for m in (*MAPS, "average"))])
    header = ["network", "million parameters", "seconds", "set", *MAPS, "average"]
    (args.out / "inference.md").write_text(markdown(header, rows))

    figure, axis = plt.subplots(figsize=(6, 4))
    for k in sets:
        axis.plot([s for _, s, _ in points], [e[k]["average"] for *_, e in points], "o", label=k)
    for name, s, errors in points:
        axis.annotate(name, (s, max(e["average"] for e in errors.values())), xytext=(4, 4),
                      textcoords="offset points")  # fmt: skip
    for name, _, s, kind, *_ in rows:
        if kind == "untrained":
            axis.axvline(s, color="grey", ls=":", label=f"{name} (no weights)")
    top = 1.2 * max(e["average"] for *_, errors in points for e in errors.values())
    axis.set(xscale="log", ylim=(0, top), xlabel=f"seconds for {SIZE}²", ylabel="average RMSE")
    axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(args.out / "inference.png", dpi=120)
    write_results(args.out, {"rows": rows, "bars": []})


if __name__ == "__main__":
    main()
