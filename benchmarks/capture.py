"""From simulated photographs to ball, lights and screen: how far off, how often, how fast.

Of three photos two are HDR, one is a clipped JPEG; hand-held rigs, displays of other gamma,
clutter, blur and noise as in `benchmarks.common.photos`. A quarter as many photos without a ball
follow.

Irradiance is that of the room on nine points of the sample, with the screen in its way. The sample
sees parts of the room that the screen hides from the ball; these can only be guessed, so that the
irradiance from what the ball sees is told as well. Poses are told relative to the camera.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import statistics
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common.photos import Shot, arguments, make_shot
from benchmarks.common.results import bar, table, write_results
from invrender.capture.camera import corners
from invrender.capture.lights import find_lights, measure_lights
from invrender.capture.mirror import make_ball
from invrender.capture.orientation import find_ball_and_orientation
from invrender.capture.table import room_irradiance
from invrender.files.capture import Capture
from invrender.rig import Rig
from invrender.sphere import resample_environment
from invrender.types import InputError

SEED = 3000  # photos from here on serve for nothing else
SURE = 0.9  # confidence from which a wrong ball counts
ERRORS = {
    "sample told": "sample's corners by rig.toml, share of a side",
    "sample": "sample's corners as found, share of a side",
    "centre": "ball's centre, in radii",
    "radius": "ball's radius",
    "irradiance": "irradiance",
    "irradiance seen": "irradiance, of what the ball sees",
    "gain": "screen's light",
    "shift, mm": "screen's shift, mm",
    "tilt, deg": "screen's tilt, degrees",
    "s": "processor seconds",
}


def measure(shot: Shot, kind: str) -> dict[str, Any]:
    """One photo's errors: of the sample's corners, as told and as found, in its sides; of the ball
    in radii; of irradiance and gain relative; of the screen's pose."""
    row: dict[str, Any] = {"photo": shot.name, "kind": kind}
    capture = Capture(shot.photo, shot.nominal, shot.pattern)
    start = time.process_time()
    try:
        capture, ball, _ = find_ball_and_orientation(capture)
        true = corners(shot.photo, shot.rig)
        side = np.linalg.norm(true[1] - true[0])
        for name, rig in (("sample told", shot.nominal), ("sample", capture.rig)):
            off = np.linalg.norm(corners(shot.photo, rig) - true, axis=-1)
            row[name] = float(off.mean() / side)
        row["s"] = time.process_time() - start
        row["confidence"] = ball.confidence
        if shot.ball is not None:
            truth = make_ball(shot.rig, shot.ball, shot.rig.ball_radius, ball.size)
            row["centre"] = float(np.hypot(*np.subtract(ball.centre, truth.centre)) / truth.radius)
            row["radius"] = abs(ball.radius / truth.radius - 1)
        lights = measure_lights(capture, ball)
        if shot.ball is None:
            return row
    except InputError as error:
        row["refused"] = str(error)
        return row
    room = resample_environment(shot.environment, len(lights.environment))
    room[len(room) // 2 :] = 0
    assert lights.coverage is not None
    seen = (lights.coverage > 0.5)[..., None]
    for name, part in (("irradiance", 1), ("irradiance seen", seen)):
        e, t = (
            room_irradiance(rig, rig.sample_points(3, 3).reshape(-1, 3), light * part)
            for rig, light in ((lights.rig, lights.environment), (shot.rig, room))
        )
        row[name] = float(np.abs(e - t).mean() / t.mean())
    # Where a gamma is fitted the pattern's mean tells the light, whatever the curve.
    light, shown = (
        (p * g).mean((0, 1)) for p, g in ((lights.shown, lights.gain), (shot.shown, shot.gain))
    )
    row["gain"] = float(np.abs(light / shown - 1).mean())
    found = screen_pose(lights.rig, np.asarray(ball.position))
    assert shot.ball is not None
    centre, turn = screen_pose(shot.rig, shot.ball)
    row["shift, mm"] = 1000 * float(np.linalg.norm(found[0] - centre))
    row["tilt, deg"] = math.degrees((found[1] * turn.inv()).magnitude())
    return row


def screen_pose(rig: Rig, ball: Any) -> tuple[Any, Rotation]:
    """Where the screen's centre is from the ball, and its rotation, both in the camera's axes.

    A photo cannot tell a turned camera from a turned rig.
    """
    e_x, e_y = rig.screen_edges
    centre = rig.screen_corner + e_x / 2 + e_y / 2 - ball
    turn = Rotation.from_rotvec(rig.screen_tilt, degrees=True)
    axes = rig.camera_axes
    return axes @ centre, Rotation.from_matrix(axes) * turn


def big_photo() -> float:
    """Processor seconds to find the lights in 12 megapixels."""
    shot = make_shot(SEED - 1, width=4000)
    start = time.process_time()
    with contextlib.suppress(InputError):
        find_lights(Capture(shot.photo, shot.nominal, shot.pattern))
    return time.process_time() - start


def parser() -> argparse.ArgumentParser:
    return arguments(__doc__, 60, "photos with a ball")


def main(args: argparse.Namespace) -> None:
    count = 6 if args.quick else args.count
    rows: list[dict[str, Any]] = []
    wrong: list[dict[str, Any]] = []
    for i in range(count + -(-count // 4)):
        kind = "jpeg" if i % 3 == 2 else "hdr"
        shot = make_shot(SEED + i, kind=kind, ball=i < count, rooms=args.rooms if i % 2 else None)
        (rows if i < count else wrong).append(measure(shot, kind))
        last = (rows if i < count else wrong)[-1]
        print(i, {k: round(v, 4) if isinstance(v, float) else v for k, v in last.items()})

    def median(name: str, kind: str | None = None) -> float:
        found = [r[name] for r in rows if name in r and kind in (None, r["kind"])]
        return statistics.median(found) if found else float("inf")

    good = [r.get("centre", 1) <= 0.01 and r.get("radius", 1) <= 0.01 for r in rows]
    sure = [r for r, g in zip(rows, good, strict=True) if not g] + wrong
    sure = [r for r in sure if "refused" not in r and r["confidence"] > SURE]
    bars = [
        bar("ball within 1% of its radius", float(np.mean(good)), 0.98, True),
        bar("wrong balls accepted surely", len(sure), 0, False),
        bar("irradiance, HDR", median("irradiance", "hdr"), 0.03, False),
        bar("the same, of what the ball sees", median("irradiance seen", "hdr"), 0.03, False),
        bar("irradiance, clipped JPEG", median("irradiance", "jpeg"), 0.15, False),
        bar("screen's tilt, degrees", median("tilt, deg"), 0.5, False),
        bar("screen's shift, mm", median("shift, mm"), 1.0, False),
        bar("screen's light", median("gain"), 0.03, False),
        bar("12 megapixels, processor seconds", big_photo(), 3.0, False),
    ]
    more = {
        "balls refused": sum("refused" in r for r in rows),
        "accepted without a ball": sum("refused" not in r for r in wrong),
        "sample's corners as told, share of a side, median": median("sample told"),
        "sample's corners, share of a side, median": median("sample"),
        "sample's corners within 1%": float(np.mean([r.get("sample", 1) <= 0.01 for r in rows])),
    }
    kinds = {"all": None, "HDR": "hdr", "JPEG": "jpeg"}
    medians = [[e, *(median(n, k) for k in kinds.values())] for n, e in ERRORS.items()]
    tables = {"medians": table(["error", *kinds], medians),
              "counts": table(["", ""], [[k, float(v)] for k, v in more.items()])}  # fmt: skip
    results = {"bars": bars, **more, "photos": rows, "without a ball": wrong}
    write_results(args.out, results, tables)
    plot(args.out / "capture.png", rows)


def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Cumulative errors of the ball and of the lights; a dashed line at each bar."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), sharey=True)
    for axis, names in zip(axes, (("centre", "radius"), ("irradiance", "gain")), strict=True):
        for name in names:
            values = sorted(r[name] for r in rows if name in r)
            axis.semilogx(values, (np.arange(len(values)) + 1) / len(rows), label=name)
        axis.set_xlabel("relative error")
        axis.legend()
    axes[0].axvline(0.01, color="k", linestyle="--", linewidth=0.8)
    axes[0].set_ylabel("share of photos")
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
