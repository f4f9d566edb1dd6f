"""How the maps suffer where display and rig are not as told: colours and curve, screen, camera.

The same samples in the same rooms are photographed four times (path-traced, as in
`benchmarks.common.captures`): with pattern and rig as told; with each channel of the pattern times
0.8 to 1.25 and an exponent of 1/2.2 to 2.2 on it; with the screen shifted by up to a tenth of the
sample's size and tilted by up to 10 degrees; and with the camera held 2 mm and 1.2 degrees off
(standard deviations). Everything is drawn anew for each capture; the refinement is told the nominal
pattern and rig. Captures are kept in DIR/captures: a rerun only refines.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.captures import CaptureSet, arguments, make_capture, sample_and_room
from benchmarks.common.results import bar, table, write_results
from benchmarks.refine import measure, pooled
from invrender.maps import NAMES
from invrender.pattern.default import default_pattern
from invrender.rig import Rig

DRAWN = CaptureSet("holdout", 95_000)
GAIN, GAMMA = 1.25, 2.2  # at most, or one over it
SHIFT, TILT = 0.1, 10.0  # at most, of the sample's size and degrees
HELD = 2e-3, 1.2  # standard deviations, metres and degrees; at most two and a half of them
ALLOWED = {"display": 1.1, "pose": 1.15, "camera": 1.15}


def make_captures(
    out: Path, k: int, size: int, width: int, spp: int, materials: Path | None, envs: Path | None
) -> dict[str, Path]:
    """The k-th sample under each condition; simulates what is not there yet."""
    maps, room, rng = sample_and_room(k, DRAWN, size, materials, envs)
    pattern = default_pattern()
    gain = np.exp(rng.uniform(-1, 1, 3) * np.log(GAIN)).astype(np.float32)
    shown = gain * pattern ** np.float32(np.exp(rng.uniform(-1, 1) * np.log(GAMMA)))
    shift, tilt = (d / np.linalg.norm(d) * rng.uniform() for d in rng.normal(size=(2, 3)))
    shift, tilt = shift * SHIFT * Rig().sample_size, tilt * TILT
    moved = Rig(screen_shift=tuple(shift.tolist()), screen_tilt=tuple(tilt.tolist()))
    quality = int(rng.integers(85, 97)) if k % 2 else None
    place, turn = (s * np.clip(rng.normal(size=3), -2.5, 2.5) for s in HELD)
    held = Rig(camera_shift=tuple(place.tolist()), camera_tilt=tuple(turn.tolist()))
    folders = {}
    for name, rig, screen in (
        ("clean", Rig(), pattern), ("display", Rig(), shown), ("pose", moved, pattern),
        ("camera", held, pattern),
    ):  # fmt: skip
        folder = folders[name] = out / f"{k:03d}-{name}"
        if not folder.exists():
            make_capture(folder, maps, room, rig, screen, width, spp, k, quality)
    return folders


def parser() -> argparse.ArgumentParser:
    return arguments(__doc__, "one small sample", 8)


def main(args: argparse.Namespace) -> None:
    count, size, width, spp = (1, 96, 640, 16) if args.quick else (args.count, 256, 960, 32)
    rows: dict[str, list[dict[str, Any]]] = {}
    for k in range(count):
        folders = make_captures(
            args.out / "captures", k, size, width, spp, args.materials, args.envs
        )
        for name, folder in folders.items():
            row = measure(folder, size, "network")
            rows.setdefault(name, []).append(row)
            print(f"{folder.name}: {row['average_initial']:.4f} → {row['average_refined']:.4f}")
    names = (*NAMES, "average", "rerender")
    errors = {c: {n: pooled(r, f"{n}_refined") for n in names} for c, r in rows.items()}
    clean = errors["clean"]["average"]
    lines = [[c, *e.values(), e["average"] / clean] for c, e in errors.items()]
    tables = {"errors": table(["RMSE, refined", *names, "average over clean"], lines)}
    lines = [
        [r["clean"]["capture"][:3], *(r[c]["average_refined"] for c in errors)]
        for r in (dict(zip(rows, pair, strict=True)) for pair in zip(*rows.values(), strict=True))
    ]
    tables["samples"] = table(["sample, average RMSE", *errors], lines)
    bars = [
        bar(f"average map RMSE, {c} over clean", errors[c]["average"] / clean, most, at_least=False)
        for c, most in ALLOWED.items()
    ]
    write_results(args.out, {"rows": rows, "errors": errors, "bars": bars}, tables)
