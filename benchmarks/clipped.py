"""Clipped lamps in a JPEG's ball: the room's irradiance when they are left, doubled, or raised.

Photos as in `benchmarks.common.photos`; ball,
screen's pose and light as they are, so that nothing else errs; only photos with clipped lamps
count. Error: mean over nine normals, relative. The lamps' excess in the rooms themselves, printed
first, is to compare the prior in `invrender.capture.clipped_lamps` with. The formula of the
paper's code has no scale of its own: it is given that of the truth on the plane.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.common.photos import Shot, arguments, make_shot
from benchmarks.common.results import table, write_results
from invrender.capture.ball_image import trace_image
from invrender.capture.clipped_lamps import clipped_light, raise_clipped
from invrender.capture.environment import fill_environment, unfold_environment
from invrender.capture.mirror import make_ball
from invrender.data.environments import find_environments, procedural_environment, read_environment
from invrender.sphere import irradiance, resample_environment
from nets.training.draw import belongs

Array = NDArray[np.floating[Any]]
SEED = 3000  # photos from here on
LIT = 1e-3  # share of the sky that must be clipped
TILT = np.radians(50)
NORMALS = [np.array([0.0, 0.0, 1.0])] + [
    np.array([np.sin(TILT) * np.cos(a), np.sin(TILT) * np.sin(a), np.cos(TILT)])
    for a in np.arange(8) * np.pi / 4
]
PAPER = "x·mean(x)²"
METHODS = ("left", "doubled", PAPER, "raised")


def excess(rooms: Path | None, count: int = 60) -> tuple[float, float, int]:
    """Mean and standard deviation of the logarithm of how far lamps exceed a photo's white.

    White is 12 to 100 times the mean radiance, as in photos exposed for the screen; rooms are
    blurred to the ball's resolution. Held-out rooms are left aside.
    """
    files = [p for p in find_environments(rooms) if belongs(p.stem, "train")] if rooms else []
    found = []
    for k in range(len(files) or count):
        room = read_environment(files[k], 256) if files else procedural_environment(k, 256)
        room = resample_environment(room, 128)
        room = ndimage.gaussian_filter(room, (1, 1, 0), mode=("nearest", "wrap", "nearest"))[:64]
        mean = irradiance(np.concatenate([room, 0 * room])).mean() / np.pi
        for white in mean * np.array([12, 25, 50, 100]):
            over = room[room >= white]
            if over.size >= 12:
                found.append(float(np.log(over.mean() / white)))
    return float(np.mean(found)), float(np.std(found)), len(found)


def measure(shot: Shot) -> dict[str, Any] | None:
    """Relative error of the irradiance by each method; None where no lamp is clipped."""
    photo, rig = shot.photo, shot.rig
    assert shot.ball is not None and photo.clip_level is not None
    size = (photo.height, photo.width)
    image = trace_image(rig, make_ball(rig, shot.ball, rig.ball_radius, size))
    environment, coverage = unfold_environment(photo, rig, image)
    environment = fill_environment(environment, coverage)
    clipped = clipped_light(photo, rig, image, len(environment))
    if (clipped.max(-1) > 0).mean() < LIT / 2:
        return None
    level = photo.clip_level / np.asarray(rig.ball_reflectance)
    x = environment / level
    lit = shot.pattern, shot.gain, shot.device
    raised = raise_clipped(photo, rig, image, lit, environment)
    results: list[Array] = [
        environment, environment + clipped,
        x * x.mean(-1, keepdims=True) ** 2, raised.environment,
    ]  # fmt: skip
    truth = shot.environment.copy()
    truth[len(truth) // 2 :] = 0

    def light(environment: Array) -> Array:
        return np.array([irradiance(environment, n) for n in NORMALS])

    true = light(truth)
    row: dict[str, Any] = {"photo": shot.name, "factor": raised.factor}
    for name, result in zip(METHODS, results, strict=True):
        found = light(result.astype(np.float32))
        if name == PAPER:
            found = found * (true[0] / found[0])
        error = found - true
        row[name] = float(np.abs(error).mean() / true.mean())
    return row


def parser() -> argparse.ArgumentParser:
    return arguments(__doc__, 60, "photos with clipped lamps")


def main(args: argparse.Namespace) -> None:
    prior = excess(args.rooms, 10 if args.quick else 60)
    print(
        "logarithm of the excess: mean {:.2f}, standard deviation {:.2f} ({} cases)".format(*prior)
    )
    rows: list[dict[str, Any]] = []
    seed = SEED
    while len(rows) < (5 if args.quick else args.count):
        rooms = args.rooms if seed % 2 else None
        row = measure(make_shot(seed, kind="jpeg", rooms=rooms))
        seed += 1
        if row:
            rows.append(row)
            print({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()})
    bad = [r for r in rows if r["left"] > 0.1]
    lines: list[list[Any]] = []
    for name in METHODS:
        every, these = ([r[name] for r in some] for some in (rows, bad))
        lines.append(
            [name, np.median(every), np.mean(every), np.quantile(every, 0.9), np.median(these)]
        )
    header = ["lamps", "median", "mean", "90%", f"median of the {len(bad)} that lose over 10%"]
    results = {"prior": prior, "photos": rows, "photographs tried": seed - SEED}
    write_results(args.out, results, {"irradiance": table(header, lines)})
