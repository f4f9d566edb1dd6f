"""What is found in a photo, in numbers and in a picture, before anything is reconstructed."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from invrender.capture.crop import crop_mask, sample_corners
from invrender.capture.lights import FoundLights
from invrender.capture.mirror import Ball, horizon_points, mirror_normals, outline_points
from invrender.capture.settings import SHEET_FIT
from invrender.capture.sheet import FoundSheet, clear_squares
from invrender.colour import linear_to_srgb
from invrender.report.advice import advice, pattern_share, sky_shown
from invrender.rig import Rig
from invrender.types import Array, InputError, Notice

SHOWN = 1600  # pixels, the longer side of the annotated picture
INSET = 0.4  # of its shorter side, of the enlarged ball in it
BLURRED = 0.03  # of the ball's radius, the camera's blur from which it is told
COLOURS = {
    "ball": "lime", "horizon": "yellow", "screen": "red", "sample": "deepskyblue",
    "marker": "magenta", "saturated": "orange",
}  # fmt: skip
WEAK = 0.1  # share of the sample's light that the pattern gives, likewise; designed for 0.2 or more


def camera_place(nominal: Rig, found: Rig) -> str:
    """Where the camera was found, in words."""
    if found.camera_shift == nominal.camera_shift:
        return "where the rig puts it"
    shift = np.subtract(found.camera_shift, nominal.camera_shift)
    tilt = np.subtract(found.camera_tilt, nominal.camera_tilt)
    return (
        f"{1000 * np.linalg.norm(shift):.1f} mm and {np.linalg.norm(tilt):.1f}° from where the rig "
        "puts it"
    )


def summary(found: FoundLights) -> dict[str, Any]:
    """Everything found by a ball, as plain numbers; lengths in metres, angles in degrees."""
    capture, ball, lights = found.capture, found.ball, found.lights
    assert ball is not None and lights.coverage is not None
    warnings = [*found.notices, *_photo_notices(found, ball, pattern_share(lights))]
    return {
        "photo": [capture.photo.width, capture.photo.height],
        "fov": capture.rig.fov if found.sheet is None else found.sheet.fov,
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
        "coverage": sky_shown(lights),
        "room_saturated": lights.fit["room_saturated"],
        "pattern_share": pattern_share(lights),
        "exposure": capture.photo.exposure,
        "deviations": deviations(found),
        "sheet": _sheet_numbers(found.sheet),
        "warnings": [notice._asdict() for notice in warnings],
        "notes": [notice._asdict() for notice in found.capture.photo.notes],
        "advice": [notice._asdict() for notice in advice(found)],
    }


def deviations(found: FoundLights) -> dict[str, float | None]:
    """Standard deviations of what is found, None where nothing tells them: the camera's tilt and
    field of view in degrees and its height in metres; the logarithms of the screen's gain and of
    the ball's reflectance, which scales albedo, and of the gain by the sheet's paper."""
    capture, lights, sheet = found.capture, found.lights, found.sheet
    stated = SHEET_FIT.focal_deviation.get(capture.fov_from)
    sine = math.degrees(math.sin(math.radians(capture.rig.fov)))
    tilt = found.ball.tilt_deviation if found.ball else None
    return {
        "camera_tilt": tilt if sheet is None else sheet.tilt_deviation,
        "camera_height": None if sheet is None else sheet.place_deviation[2],
        "fov": sheet.fov_deviation if sheet else None if stated is None else sine * stated,
        "gain": lights.fit.get("gain_deviation"),
        "ball_reflectance": lights.fit.get("ball_reflectance_deviation"),
        "paper_gain": lights.fit.get("paper_gain_deviation"),
    }


def _sheet_numbers(sheet: FoundSheet | None) -> dict[str, Any] | None:
    if sheet is None:
        return None
    return {
        "markers": len(sheet.ids),
        "residual": sheet.residual,
        "principal": list(sheet.principal),
        "principal_deviation": list(sheet.principal_deviation),
        "distortion": sheet.distortion,
        "distortion_deviation": sheet.distortion_deviation,
        "white_squares": clear_squares(sheet),
    }


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
    blur = lights.fit.get("blur", 0.0)
    if blur > BLURRED * ball.radius:
        text = (
            f"the photo is blurred by {blur:.1f} pixels in the ball, too much to read the pattern "
            "well: focus, hold still, or go closer"
        )
        notices.append(Notice("photo-blurred", text))
    if lights.rig.has_screen and share < WEAK:
        text = (
            f"the pattern gives only {share:.0%} of the light on the sample: turn the display's "
            "brightness up or the room's light down"
        )
        notices.append(Notice("pattern-weak", text))
    return notices


def annotate(found: FoundLights) -> Image.Image:
    """The photo with what was found in it, each in its colour of `COLOURS`, and a legend: outlines,
    the screen's corners as the ball shows them, the sheet's markers, and what is saturated. The
    ball stands in a corner once more, enlarged."""
    assert found.ball is not None
    photo, rig, ball, sheet = found.capture.photo, found.lights.rig, found.ball, found.sheet
    step = max(1, math.ceil(max(photo.width, photo.height) / SHOWN))
    white = max(float(np.percentile(photo.image[::step, ::step], 99)), 1e-9)
    saturated = photo.clip_level is not None and photo.image.max() >= photo.clip_level
    lines = outlines(rig, ball, photo.height, photo.width)
    if sheet is not None:
        lines |= {f"marker {i}": quad for i, quad in zip(sheet.ids, sheet.corners, strict=True)}

    def part(x0: int, y0: int, x1: int, y1: int, scale: float) -> Image.Image:
        """A rectangle of the photo with its lines; a pixel is ``scale`` pixels wide."""
        every = max(1, round(1 / scale))
        some = replace(photo, image=photo.image[y0:y1:every, x0:x1:every])
        tone = linear_to_srgb(some.image / white) * 255 + 0.5
        tone[some.clipped] = ImageColor.getrgb(COLOURS["saturated"])
        picture = Image.fromarray(tone.astype(np.uint8))
        if scale > 1:
            size = round((x1 - x0) * scale), round((y1 - y0) * scale)
            picture = picture.resize(size, Image.Resampling.NEAREST)
        draw = ImageDraw.Draw(picture)
        for name, line in lines.items():
            points = [(float(u), float(v)) for u, v in (line - [x0, y0]) * scale]
            draw.line([*points, points[0]], fill=COLOURS[name.split()[0]], width=2)
            if name == "screen":
                for u, v in points[:: len(points) // 4]:
                    draw.ellipse((u - 4, v - 4, u + 4, v + 4), outline=COLOURS[name], width=2)
        return picture

    picture = part(0, 0, photo.width, photo.height, 1 / step)
    half = math.ceil(1.3 * ball.radius)
    x, y = (round(c) for c in ball.centre)
    box = (
        max(x - half, 0),
        max(y - half, 0),
        min(x + half, photo.width),
        min(y + half, photo.height),
    )
    inset = part(*box, INSET * min(picture.size) / (2 * half))
    picture.paste(inset, (picture.width - inset.width, picture.height - inset.height))
    _legend(picture, {
        "ball": f"ball ({rig.ball_shape})", "horizon": "horizon in it",
        "screen": "screen in it, with its corners" if rig.has_screen else "", "sample": "sample",
        "marker": f"{len(sheet.ids)} markers of the capture sheet" if sheet else "",
        "saturated": "saturated" if saturated else "",
    })  # fmt: skip
    return picture


def _legend(picture: Image.Image, texts: dict[str, str]) -> None:
    """Write texts in their names' colours, those that are not empty."""
    draw, size = ImageDraw.Draw(picture), max(12, picture.width // 60)
    font, at = ImageFont.load_default(size), 6
    for name, text in texts.items():
        if text:
            box = draw.textbbox((8, at), text, font=font)
            draw.rectangle((box[0] - 4, box[1] - 2, box[2] + 4, box[3] + 2), fill="black")
            draw.text((8, at), text, fill=COLOURS[name], font=font)
            at += round(1.4 * size)


def outlines(rig: Rig, ball: Ball, height: int, width: int) -> dict[str, Array]:
    """Closed lines (n, 2) in photo pixels: the ball's outline, its horizon, the screen in it and
    the sample's border."""
    centre = np.asarray(ball.position)
    points = {
        "ball": outline_points(rig, centre, ball.radius_m),
        "horizon": horizon_points(rig, centre, ball.radius_m),
        "sample": rig.sample_corners,
    }
    if rig.has_screen:
        points["screen"] = _screen_image(rig, ball)
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
