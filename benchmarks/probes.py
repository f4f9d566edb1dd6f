"""Real photographs that are no captures: none may be taken for one.

`--folder` holds `index.csv` with a column `file`, and for
photographs of mirror balls `ball_cx, ball_cy, ball_rx, ball_ry` in pixels. Such balls are whole,
held before a room without table or screen, so that there is nothing right to find; they are tried
with the default rig, and with one in which a ball would look as large as theirs.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.results import bar, benchmark_parser, table, write_results
from invrender.capture.ball import find_ball
from invrender.capture.lights import find_lights
from invrender.files.capture import MIN_PHOTO, Capture
from invrender.files.images import Photo, read_photo
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.types import InputError

WIDTH = 800  # pixels to which larger photos are averaged, about
FOV = 20.0  # degrees, of the rig that looks for the photo's own ball


def tries(folder: Path, row: dict[str, str]) -> Iterator[tuple[str, Photo, Rig]]:
    """The photo with each rig that it is tried with."""
    photo = read_photo(folder / row["file"])
    step = max(1, photo.width // WIDTH)
    h, w = photo.height // step, photo.width // step
    image = photo.image[: h * step, : w * step].reshape(h, step, w, step, 3).mean((1, 3))
    if min(h, w) < MIN_PHOTO:
        return
    yield "default", Photo(image, photo.clip_level), Rig(fov=photo.fov or Rig().fov)
    if row["ball_rx"]:
        border = w // 4  # the photos end at the ball
        wide = np.pad(image, ((border, border), (border, border), (0, 0)), "edge")
        rig = Rig(fov=FOV)
        radius = np.sqrt(float(row["ball_rx"]) * float(row["ball_ry"])) / step
        size = float(radius) / rig.focal(wide.shape[1]) * rig.screen_height
        yield "its own", Photo(wide, photo.clip_level), replace(rig, ball_radius=size)


def measure(photo: Photo, rig: Rig) -> dict[str, Any]:
    """The ball's confidence, and whether `inspect` would accept it; ``refused`` tells why not."""
    row: dict[str, Any] = {"accepted": False}
    try:
        row["confidence"] = find_ball(photo, rig).confidence
        find_lights(Capture(photo, rig, default_pattern()))
        row["accepted"] = True
    except InputError as error:
        row["refused"] = str(error)
    return row


def parser() -> argparse.ArgumentParser:
    p = benchmark_parser(__doc__, "the first three photographs")
    p.add_argument("--folder", type=Path, required=True)
    return p


def main(args: argparse.Namespace) -> None:
    rows: list[dict[str, Any]] = []
    with open(args.folder / "index.csv", newline="", encoding="utf-8") as file:
        for entry in [*csv.DictReader(file)][: 3 if args.quick else None]:
            for name, photo, rig in tries(args.folder, entry):
                rows.append({"photo": entry["file"], "rig": name, **measure(photo, rig)})
                print({k: round(v, 2) if isinstance(v, float) else v for k, v in rows[-1].items()})
    accepted = sum(r["accepted"] for r in rows)
    header = ["photo", "rig", "confidence", "accepted"]
    tried = table(header, [[r.get(k, "refused") for k in header] for r in rows])
    results = {"bars": [bar("accepted", accepted, 0, False)], "photos": rows}
    write_results(args.out, results, {"photos": tried})
