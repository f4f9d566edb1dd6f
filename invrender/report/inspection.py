"""What is found in a photo, in numbers and in a picture, before anything is reconstructed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from invrender.capture.crop import crop_mask, sample_corners
from invrender.capture.lights import FoundLights
from invrender.capture.mirror import Ball, horizon_points, mirror_normals, outline_points
from invrender.colour import linear_to_srgb
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.rig import Rig
from invrender.sampling import resize_pattern
from invrender.sphere import irradiance
from invrender.types import Array, InputError, Notice

SHOWN = 1600  # pixels, the longer side of the annotated picture
BLURRED = 0.03  # of the ball's radius, the camera's blur from which it is told
COLOURS = {"ball": "lime", "horizon": "yellow", "screen": "red", "sample": "deepskyblue"}
WEAK = 0.1  # share of the sample's light that the pattern gives, likewise; designed for 0.2 or more


def camera_place(nominal: Rig, found: Rig) -> str:
    """Where the camera was found, in words."""
    if found.camera_shift == nominal.camera_shift:
        return "where the rig puts it"
    shift = np.subtract(found.camera_shift, nominal.camera_shift)
    tilt = np.subtract(found.camera_tilt, nominal.camera_tilt)
    return (
        f"{1000 * np.linalg.norm(shift):.1f} mm and {np.linalg.norm(tilt):.1f}° from where the rig "
        "puts it, by the sample's square"
    )


def summary(found: FoundLights) -> dict[str, Any]:
    """Everything found by a ball, as plain numbers; lengths in metres, angles in degrees."""
    capture, ball, lights = found.capture, found.ball, found.lights
    assert ball is not None and lights.coverage is not None
    warnings = [*found.notices, *_photo_notices(found, ball, pattern_share(lights))]
    sky = lights.coverage[: len(lights.coverage) // 2]
    sine = np.sin((np.arange(len(sky)) + 0.5) * math.pi / len(lights.coverage))
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
        "pattern_share": pattern_share(lights),
        "exposure": capture.photo.exposure,
        "warnings": [notice._asdict() for notice in warnings],
        "notes": [notice._asdict() for notice in found.capture.photo.notes],
    }


def pattern_share(lights: Lights) -> float:
    """Share of the light on the middle of the sample that comes from the screen, in [0, 1]."""
    shown = resize_pattern(lights.shown, 32).mean(-1)
    weights = lights.rig.screen_cosines(np.zeros(3), 32, lights.device.falloff)
    screen = float(np.mean(lights.gain) * (shown * weights).sum())
    room = float(irradiance(lights.environment).mean())
    return screen / max(screen + room, 1e-30)


def _photo_notices(found: FoundLights, ball: Ball, share: float) -> list[Notice]:
    """What is doubtful about a photo apart from its lights."""
    capture, lights = found.capture, found.lights
    notices = []
    saturated = 0.0
    try:
        sample_corners(capture.photo, lights.rig)
        saturated = float(crop_mask(capture.photo, lights.rig, 128).mean())
    except InputError as error:
        notices.append(Notice("sample-not-in-photo", str(error)))
    if saturated > 0:
        text = f"{saturated:.1%} of the sample is saturated; the photo tells nothing there: expose "
        notices.append(Notice("sample-saturated", text + "shorter"))
    blur = lights.fit["blur"]
    if blur > BLURRED * ball.radius:
        text = (
            f"the photo is blurred by {blur:.1f} pixels in the ball, too much to read the pattern "
            "well: focus, hold still, or go closer"
        )
        notices.append(Notice("photo-blurred", text))
    if share < WEAK:
        text = (
            f"the pattern gives only {share:.0%} of the light on the sample: turn the display's "
            "brightness up or the room's light down"
        )
        notices.append(Notice("pattern-weak", text))
    return notices


def annotate(photo: Photo, rig: Rig, ball: Ball) -> Image.Image:
    """The photo with the ball's outline (green), its horizon (yellow), the screen in it (red) and
    the sample's border (blue)."""
    step = max(1, math.ceil(max(photo.width, photo.height) / SHOWN))
    small = photo.image[::step, ::step]
    white = max(float(np.percentile(small, 99)), 1e-9)
    picture = Image.fromarray((linear_to_srgb(small / white) * 255 + 0.5).astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    lines = outlines(rig, ball, photo.height, photo.width)
    for name, colour in COLOURS.items():
        pixels = lines[name] / step
        draw.line([(float(u), float(v)) for u, v in [*pixels, pixels[0]]], fill=colour, width=2)
    return picture


def outlines(rig: Rig, ball: Ball, height: int, width: int) -> dict[str, Array]:
    """Closed lines (n, 2) in photo pixels: the ball's outline, its horizon, the screen in it and
    the sample's border."""
    centre = np.asarray(ball.position)
    points = {
        "ball": outline_points(rig, centre, ball.radius_m),
        "horizon": horizon_points(rig, centre, ball.radius_m),
        "screen": _screen_image(rig, ball),
        "sample": rig.sample_corners,
    }
    return {name: rig.project(p, height, width) for name, p in points.items()}


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
