"""Refinement on simulated captures: photo and map errors before and after, and their cost.

    python benchmarks/refine.py [--quick] --out DIR [--materials DIR --envs DIR]

Whole photographs are path-traced (ball, table and inter-reflection included) and every capture is
refined from its photo alone, with estimated lights. Without folders, materials and rooms are
procedural, from seeds that nothing else uses.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from common import bar, markdown, write_results
from matplotlib import pyplot as plt

from invrender.environments import (
    find_environments,
    procedural_environment,
    read_environment,
    rotate_environment,
    scale_environment,
)
from invrender.maps import NAMES
from invrender.materials import find_materials, procedural_material, read_material, resize_maps
from invrender.pattern import default_pattern
from invrender.pipeline import refine_capture
from invrender.rig import Rig
from invrender.simulate import simulate

FIRST_SEED = 90_000


def make_captures(args: argparse.Namespace) -> list[Path]:
    """Simulate the captures that are not there yet."""
    materials = find_materials(args.materials) if args.materials else []
    rooms = find_environments(args.envs) if args.envs else []
    folders = []
    for k in range(args.count):
        rng = np.random.default_rng(FIRST_SEED + k)
        folder = args.out / "captures" / f"{k:03d}"
        folders.append(folder)
        if folder.exists():
            continue
        if materials:
            maps = read_material(materials[int(rng.integers(len(materials)))])
        else:
            maps = procedural_material(FIRST_SEED + k, args.size, args.size)
        if rooms:
            room = read_environment(rooms[int(rng.integers(len(rooms)))], 256)
            room = rotate_environment(room, float(rng.uniform(0, 2 * np.pi)))
        else:
            room = procedural_environment(FIRST_SEED + k, 256)
        simulate(
            folder,
            resize_maps(maps, args.size, args.size),
            scale_environment(room, float(rng.uniform(0.1, 1.0))),
            default_pattern(),
            Rig(),
            gain=2.0,
            width=args.width,
            spp=args.spp,
            noise=0.005,
            seed=k,
        )
    return folders


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--quick", action="store_true", help="two small captures, under a minute")
    parser.add_argument("--materials", type=Path, help="folder of materials")
    parser.add_argument("--envs", type=Path, help="folder of environments")
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--init", choices=["network", "flat"], default="network")
    args = parser.parse_args()
    args.count = 2 if args.quick else args.count
    args.size, args.width, args.spp = (96, 480, 8) if args.quick else (256, 960, 32)
    args.out.mkdir(parents=True, exist_ok=True)

    rows: list[dict[str, Any]] = []
    for folder in make_captures(args):
        report = refine_capture(
            folder, args.out / "results" / folder.name, size=args.size, init=args.init
        )
        assert report.map_error is not None
        rows.append(
            {
                "capture": folder.name,
                "seconds": sum(report.seconds.values()),
                "photo_initial": report.photo_error["initial"],
                "photo_refined": report.photo_error["refined"],
                **{f"{n}_initial": v for n, v in report.map_error["initial"].items()},
                **{f"{n}_refined": v for n, v in report.map_error["refined"].items()},
            }
        )
        print({k: round(v, 4) if isinstance(v, float) else v for k, v in rows[-1].items()})

    def total(name: str) -> float:
        return float(np.sqrt(np.mean([r[name] ** 2 for r in rows])))

    before, after = total("average_initial"), total("average_refined")
    better = float(np.mean([r["average_refined"] < r["average_initial"] for r in rows]))
    seconds = float(np.median([r["seconds"] for r in rows]))
    photo = total("photo_refined") / total("photo_initial")
    bars = [
        bar("average map error, refined over initial", after / before, 1.0, at_least=False),
        bar("share of captures with a lower average map error", better, 0.5, at_least=True),
        bar("seconds a capture, median", seconds, 60.0, at_least=False),
    ]

    figure, axis = plt.subplots(figsize=(6, 4))
    for row in rows:
        axis.plot(
            [0.1, row["seconds"]], [row["average_initial"], row["average_refined"]], "o-", ms=4
        )
    axis.set(xscale="log", yscale="log", xlabel="seconds", ylabel="average map RMSE")
    axis.set_title("from initial to refined maps, one line a capture")
    figure.tight_layout()
    figure.savefig(args.out / "refine.png", dpi=120)
    header = ["capture", "seconds", "photo error", *NAMES, "average"]
    table = [
        [
            row["capture"],
            row["seconds"],
            *(
                f"{row[f'{n}_initial']:.4f} → {row[f'{n}_refined']:.4f}"
                for n in ("photo", *NAMES, "average")
            ),
        ]
        for row in rows
    ]
    (args.out / "refine.md").write_text(markdown(header, table))
    write_results(
        args.out, {"rows": rows, "photo error, refined over initial": photo, "bars": bars}
    )


if __name__ == "__main__":
    main()
