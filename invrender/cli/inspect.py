"""``invrender inspect``: what is found in a photo, before anything is recovered from it."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw
from rich.console import Console

from invrender.capture.crop import crop_mask, sample_corners
from invrender.capture.lights import Lights, find_lights
from invrender.capture.mirror import Ball, horizon_points, mirror_normals, outline_points
from invrender.cli import arguments
from invrender.colour import linear_to_srgb
from invrender.files.capture import Capture, check_photo, load_capture
from invrender.files.images import Photo, read_photo
from invrender.files.write import atomic_path, write_exr
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.sampling import resize_pattern
from invrender.sphere import irradiance
from invrender.types import InputError

SHOWN = 1600  # pixels, the longer side of the annotated picture
BLURRED = 0.03  # of the ball's radius, the camera's blur from which it is told
WEAK = 0.1  # share of the sample's light that the pattern gives, likewise; designed for 0.2 or more


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "inspect",
        help="show what is found in a photo: ball, screen, sample, lights",
        description="Find the mirror ball and read the lights as 'refine' does, and say how sure "
        "that is. A lone photo is taken with the default rig and pattern.",
    )
    parser.add_argument("capture", type=Path, help="a capture's folder, or a photo alone")
    parser.add_argument("-o", "--out", type=Path, help="folder for inspect.png and the lights")
    parser.add_argument(
        "--ball",
        type=arguments.ball,
        metavar="X,Y,R",
        help="the ball's centre and radius in photo pixels",
    )
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the subcommand."""
    if args.out is not None and args.out.exists() and not args.out.is_dir():
        raise InputError(f"{args.out} is a file; choose a folder for the results")
    if args.capture.is_dir():
        capture = load_capture(args.capture)
    else:
        photo = read_photo(args.capture)
        check_photo(photo, str(args.capture))
        rig = Rig() if photo.fov is None else Rig(fov=photo.fov)
        fov_from = "unknown" if photo.fov is None else "exif"
        capture = Capture(photo, rig, default_pattern(), fov_from=fov_from, warnings=photo.warnings)
    nominal = capture.rig
    found = find_lights(capture, ball=args.ball)
    capture, ball, lights = found.capture, found.ball, found.lights
    assert ball is not None
    numbers = summary(capture, ball, lights)
    numbers["warnings"] = [*(notice.text for notice in found.notices), *numbers["warnings"]]
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        with atomic_path(args.out / "inspect.png") as path:
            annotate(capture.photo, lights.rig, ball).save(path, format="PNG")
        write_exr(args.out / "environment.exr", lights.environment)
        write_exr(args.out / "coverage.exr", lights.coverage)
        write_exr(args.out / "pattern.exr", lights.pattern_captured)
    if args.json:
        print(json.dumps(numbers))
        return 0
    x, y = ball.centre
    gain = ", ".join(f"{g:.3g}" for g in lights.gain)
    fit = lights.fit
    for line in (
        f"photo   {capture.photo.width} × {capture.photo.height} pixels, field of view "
        f"{capture.rig.fov:.1f}°",
        f"camera  {_moved(nominal, capture.rig)}",
        f"ball    at {x:.1f}, {y:.1f}, radius {ball.radius:.1f} pixels, "
        + ("given by hand" if args.ball else f"confidence {ball.confidence:.2f}"),
        f"screen  radiance of white {gain}; pattern fits to {fit['residual']:.1%}, display's gamma "
        f"{fit['gamma']:.2f}, {fit['saturated']:.0%} saturated",
        f"room    {numbers['coverage']:.0%} of the sky seen, {numbers['room_saturated']:.1%} of it "
        f"saturated; the pattern gives {numbers['pattern_share']:.0%} of the light on the sample",
    ):
        console.print(line)
    for warning in numbers["warnings"]:
        console.print(f"warning: {warning}")
    return 0


def _moved(nominal: Rig, found: Rig) -> str:
    if found.camera_shift == nominal.camera_shift:
        return "where the rig puts it"
    shift = np.subtract(found.camera_shift, nominal.camera_shift)
    tilt = np.subtract(found.camera_tilt, nominal.camera_tilt)
    return (
        f"{1000 * np.linalg.norm(shift):.1f} mm and {np.linalg.norm(tilt):.1f}° from where the rig "
        "puts it, by the sample's square"
    )


def summary(capture: Capture, ball: Ball, lights: Lights) -> dict[str, Any]:
    """Everything found, as plain numbers; lengths in metres, angles in degrees."""
    sky = lights.coverage[: len(lights.coverage) // 2]
    sine = np.sin((np.arange(len(sky)) + 0.5) * math.pi / len(lights.coverage))
    share = pattern_share(lights)
    return {
        "photo": [capture.photo.width, capture.photo.height],
        "fov": capture.rig.fov,
        "ball_centre": list(ball.centre),
        "ball_radius": ball.radius,
        "ball_ellipse": list(ball.ellipse),
        "ball_confidence": ball.confidence,
        "gain": [float(g) for g in lights.gain],
        "camera_shift": list(lights.rig.camera_shift),
        "camera_tilt": list(lights.rig.camera_tilt),
        "screen_shift": list(lights.rig.screen_shift),
        "screen_tilt": list(lights.rig.screen_tilt),
        "fit": lights.fit,
        "coverage": float((sky.mean(1) * sine).sum() / sine.sum()),
        "room_saturated": lights.fit["room_saturated"],
        "pattern_share": share,
        "exposure": capture.photo.exposure,
        "warnings": _photo_warnings(capture, ball, lights, share),
    }


def pattern_share(lights: Lights) -> float:
    """Share of the light on the middle of the sample that comes from the screen, in [0, 1]."""
    shown = resize_pattern(lights.pattern, 32).mean(-1)
    screen = float(
        np.mean(lights.gain) * (shown * lights.rig.screen_cosines(np.zeros(3), 32)).sum()
    )
    room = float(irradiance(lights.environment).mean())
    return screen / max(screen + room, 1e-30)


def _photo_warnings(capture: Capture, ball: Ball, lights: Lights, share: float) -> list[str]:
    """What is doubtful about a photo apart from its lights, a sentence each."""
    warnings = []
    saturated = 0.0
    try:
        sample_corners(capture.photo, lights.rig)
        saturated = float(crop_mask(capture.photo, lights.rig, 128).mean())
    except InputError as error:
        warnings.append(str(error))
    if saturated > 0:
        warnings.append(
            f"{saturated:.1%} of the sample is saturated; the photo tells nothing there: expose "
            "shorter"
        )
    blur = lights.fit["blur"]
    if blur > BLURRED * ball.radius:
        warnings.append(
            f"the photo is blurred by {blur:.1f} pixels in the ball, too much to read the pattern "
            "well: focus, hold still, or go closer"
        )
    if share < WEAK:
        warnings.append(
            f"the pattern gives only {share:.0%} of the light on the sample: turn the display's "
            "brightness up or the room's light down"
        )
    return warnings


def annotate(photo: Photo, rig: Rig, ball: Ball) -> Image.Image:
    """The photo with the ball's outline (green), its horizon (yellow), the screen in it (red) and
    the sample's border (blue)."""
    step = max(1, math.ceil(max(photo.width, photo.height) / SHOWN))
    small = photo.image[::step, ::step]
    white = max(float(np.percentile(small, 99)), 1e-9)
    picture = Image.fromarray((linear_to_srgb(small / white) * 255 + 0.5).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    size = (photo.height, photo.width)

    def line(points: Any, colour: str) -> None:
        pixels = rig.project(points, *size) / step
        draw.line([(float(u), float(v)) for u, v in [*pixels, pixels[0]]], fill=colour, width=2)

    centre = np.asarray(ball.position)
    line(outline_points(rig, centre, ball.radius_m), "lime")
    line(horizon_points(rig, centre, ball.radius_m), "yellow")
    line(_screen_image(rig, ball), "red")
    line(rig.sample_corners, "deepskyblue")
    return picture


def _screen_image(rig: Rig, ball: Ball) -> Any:
    """Points (n, 3) of the ball where the camera sees the screen's border."""
    e_x, e_y = rig.screen_edges
    t = np.arange(32)[:, None] / 32
    corner = rig.screen_corner
    border = np.concatenate(
        [corner + t * e_x, corner + e_x + t * e_y, corner + e_x + e_y - t * e_x,
         corner + e_y - t * e_y]
    )  # fmt: skip
    centre = np.asarray(ball.position)
    return centre + ball.radius_m * mirror_normals(rig, centre, ball.radius_m, border, True)
