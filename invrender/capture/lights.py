"""From a capture to its lights: the steps in order."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from invrender.capture.ball import agrees, find_fov, measure_reflectance
from invrender.capture.ball_image import BallImage, trace_image, unfold_pattern
from invrender.capture.ball_shade import without_ball_shade
from invrender.capture.camera import find_camera
from invrender.capture.clipped_lamps import raise_clipped
from invrender.capture.environment import fill_environment, unfold_environment
from invrender.capture.glare import remove_glare
from invrender.capture.hidden_lamp import add_hidden_lamp
from invrender.capture.mirror import Ball
from invrender.capture.near_lamp import find_near_lamp
from invrender.capture.orientation import find_ball_and_orientation, not_the_pattern
from invrender.capture.response import Response, curve_exponent
from invrender.capture.screen import Screen, fit_screen
from invrender.capture.screen_shade import place_lamps
from invrender.capture.settings import (
    EXPOSURE,
    MIRRORED_TABLE,
    PATTERN_CHECK,
    SCREEN_FIT,
    STRENGTH,
    TABLE_LEVEL,
    UNFOLDING,
)
from invrender.capture.sheet import FoundSheet, moved_circle, undone, use_paper, use_sheet
from invrender.capture.strength import light_deviation, light_doubts, strength_warnings
from invrender.capture.table import lit_table
from invrender.capture.vignetting import find_vignetting, without_vignetting
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.lights import IDEAL, NO_PATTERN, Lights
from invrender.rig import Rig
from invrender.types import Array, InputError, Notice

CURVE_TEXT = (
    "the photo has a tone curve, as phones give it to a JPEG; it was undone by what the ball shows "
    "of the pattern: a raw photo needs no such guess"
)
USUAL_CURVE_TEXT = (
    "too much of the screen is saturated in the ball to tell the photo's tone curve; one as cameras"
    " have on average was undone, which leaves bright over dark light uncertain by {:.0%}: take a "
    "raw photo, or a bracket"
)


@dataclass(frozen=True)
class FoundLights:
    """What `find_lights` returns.

    capture: with photo and pattern the right way round and the camera where it was found; ball:
    None where no ball was needed; notices: what a person should know, the files' warnings first;
    sheet: None where the photo shows no capture sheet.
    """

    capture: Capture
    lights: Lights
    ball: Ball | None
    notices: tuple[Notice, ...]
    sheet: FoundSheet | None = None


def find_lights(
    capture: Capture,
    *,
    ball: tuple[float, float, float] | None = None,
    environment: Array | None = None,
    gain: Any = None,
) -> FoundLights:
    """Find the light on the sample: the room's and the screen's.

    ball: its circle in the photo, x, y, radius in pixels, where it is given by hand. environment:
    the room's radiance (H, 2H, 3) in the photo's unit, linear RGB, if it is known; zeros for a dark
    room. gain: the screen's radiance for a white pattern, likewise, a number or RGB. With both, or
    with the room of a rig without a screen, no ball is looked for. Raises `InputError` where no
    ball is found, or where it does not show the pattern.

        capture = load_capture("my-capture")
        found = find_lights(capture)
        print(found.lights.gain, [notice.text for notice in found.notices])
    """
    with threadpool_limits(1, "blas"):
        photo = capture.photo
        capture, sheet, sheet_notices = use_sheet(capture)
        ball = moved_circle(sheet, ball, photo, capture.photo)
    if not capture.rig.has_screen:
        gain = 0.0
    if environment is not None and gain is not None:
        capture = replace(capture, photo=capture.photo.in_rec709())
        if sheet is None:
            capture = replace(capture, rig=find_camera(capture.photo, capture.rig)[0])
        lights = Lights(
            capture.rig, capture.pattern, environment, _rgb(gain), device=capture.device
        )
        return FoundLights(capture, lights, None, (*capture.warnings, *sheet_notices), sheet)
    fov_notices: tuple[Notice, ...] = ()
    # The matrices are small: more threads than one only slow each other down.
    with threadpool_limits(1, "blas"):
        if capture.fov_from == "unknown":
            capture, fov_notices = measure_fov(capture, ball)
        try:
            capture, found, turned = find_ball_and_orientation(capture, ball)
        except InputError as error:
            raise InputError(f"{error}{_fault_of(capture.photo)}") from None
        seen = capture
        capture, mirror = use_reflectance(seen, found)
        printed = None if sheet is None else sheet.printed
        lights, response = _measure(capture, found, printed=printed)
        if response is not None:
            seen = replace(seen, photo=response.undo(seen.photo))
            found = measure_reflectance(seen.photo, seen.rig, found)
            capture, mirror = use_reflectance(seen, found)
            lights, _ = _measure(capture, found, printed=printed)
            usual = USUAL_CURVE_TEXT.format(response.deviation)
            text = CURVE_TEXT if response.measured else usual
            mirror = (*mirror, Notice("photo-curve", text))
            sheet = undone(sheet, response)
        lights.fit["curve_exponent"] = curve_exponent(capture.photo)
        lights, paper = use_paper(sheet, lights, found)
        photo = without_vignetting(capture.photo, lights.fit["vignetting"])
        lights = _in_rec709(lights, photo.matrix)
        # The rim's tilt is kept only where the square of the sample shows none.
        unseen = sheet is None and found.camera_tilt is not None
        lights.fit["border_unseen"] = float(unseen)
        photo = without_ball_shade(photo.in_rec709(), lights, found)
        if environment is None:
            lights = place_lamps(photo, lights)
        capture = replace(capture, photo=photo)
    if environment is not None:  # nothing of it is a guess
        lights = replace(lights, environment=environment, lamps=None)
    if gain is not None:
        lights = replace(lights, gain=_rgb(gain))
    notices = (
        *capture.warnings, *sheet_notices, *fov_notices, *turned, *mirror, *paper,
        *light_warnings(lights), *strength_warnings(lights.fit),
    )  # fmt: skip
    return FoundLights(capture, lights, found, notices, sheet)


def _fault_of(photo: Photo) -> str:
    """What is wrong with a whole photo, to be added to what cannot be found in it."""
    brightest = photo.image.max(-1)
    if photo.clipped.mean() > EXPOSURE.saturated:
        return "; much of the photo is saturated: expose it shorter"
    if photo.clip_level and np.median(brightest) < EXPOSURE.dark * photo.clip_level:
        return "; the photo is almost black: expose it longer"
    if np.ptp(photo.image, -1).max() < EXPOSURE.grey * brightest.max():
        return "; the photo is grey: the pattern is recognised by its colours"
    return ""


def _in_rec709(lights: Lights, matrix: Array | None) -> Lights:
    """The lights in Rec. 709 that were found in primaries from which ``matrix`` (3, 3) leads there:
    the display's white stays white, and its channels mix otherwise."""
    if matrix is None:
        return lights
    room, lamps, seen = (
        None if a is None else np.maximum(a @ matrix.T, 0).astype(np.float32)
        for a in (lights.environment, lights.lamps, lights.pattern_captured)
    )
    assert room is not None
    lights = replace(lights, environment=room, lamps=lamps, pattern_captured=seen)
    if not np.any(lights.gain):
        return lights
    by_channel = matrix @ (_rgb(lights.gain)[:, None] * np.asarray(lights.device.mixing))
    by_channel = np.maximum(by_channel, 0)
    white = by_channel.sum(1)
    red, green, blue = ((r, g, b) for r, g, b in (by_channel / white[:, None]).tolist())
    device = replace(lights.device, mixing=(red, green, blue))
    return replace(lights, gain=white.astype(np.float32), device=device)


def _rgb(gain: Any) -> Array:
    return np.broadcast_to(np.asarray(gain, np.float32), 3).copy()


def measure_fov(
    capture: Capture, ball: tuple[float, float, float] | None = None
) -> tuple[Capture, tuple[Notice, ...]]:
    """The capture with the field of view by the ball's size, where nothing else gives it; the ball
    may be given by hand."""
    rig = replace(capture.rig, fov=find_fov(capture.photo, capture.rig, ball))
    text = (
        f"neither rig.toml nor the photo's EXIF gives the field of view; by the ball's size it is "
        f"{rig.fov:.1f}° across the photo: set [camera] fov in rig.toml if you know it better"
    )
    return replace(capture, rig=rig), (Notice("fov-measured", text),)


def use_reflectance(capture: Capture, ball: Ball) -> tuple[Capture, tuple[Notice, ...]]:
    """The capture with the ball's reflectance where nobody states it: as measured, or as balls
    have it; and what a person should know of it.

    A stated reflectance is used, and doubted where the photo contradicts it.
    """
    measured, deviation = ball.reflectance, ball.reflectance_deviation
    nominal, stated = capture.rig.ball_reflectance, "ball_reflectance" not in capture.unknown
    if measured is None or deviation is None:
        if stated:
            return capture, ()
        usual = MIRRORED_TABLE.usual
        text = (
            f"nothing tells the ball's reflectance; it was taken as {usual:.0%}, ± "
            f"{MIRRORED_TABLE.usual_deviation:.0%} of that, and albedo scales with it: set [ball] "
            "reflectance in rig.toml"
        )
        rig = replace(capture.rig, ball_reflectance=(usual, usual, usual))
        return replace(capture, rig=rig), (Notice("ball-reflectance-guessed", text),)
    found = f"{np.mean(measured):.0%} of the light, ± {deviation:.0%} of that"
    if stated:
        if agrees(nominal, measured, deviation):
            return capture, ()
        text = (
            f"by the table in it the ball reflects {found}, but rig.toml says "
            f"{np.mean(nominal):.0%}, which was used: check [ball] reflectance; albedo scales with "
            "it"
        )
        return capture, (Notice("ball-reflectance-doubtful", text),)
    capture = replace(capture, rig=replace(capture.rig, ball_reflectance=measured))
    if agrees(nominal, measured, deviation):
        return capture, ()
    text = (
        f"the ball reflects {found}, by the table in it, and albedo scales with that: set [ball] "
        "reflectance in rig.toml if you know it better"
    )
    return capture, (Notice("ball-reflectance-measured", text),)


def measure_lights(capture: Capture, ball: Ball, height: int = UNFOLDING.height) -> Lights:
    """Read the lights off the ball: the environment (``height`` rows), the display and its gain.

    The photo counts as linear: `find_lights` undoes a tone curve before.
    """
    return _measure(replace(capture, photo=replace(capture.photo, linear=True)), ball, height)[0]


def _measure(
    capture: Capture, ball: Ball, height: int = UNFOLDING.height, printed: Array | None = None
) -> tuple[Lights, Response | None]:
    """The lights, and the photo's tone curve where there is one, in which case the lights are not
    worth much before that is undone; printed: of a capture sheet (`FoundSheet`)."""
    if ball.size != (capture.photo.height, capture.photo.width):
        raise InputError("the ball was found in a photo of another size")
    if height < 8 or height % 2:
        raise InputError(f"the environment needs an even height of 8 rows or more, got {height}")
    rig = level_table(capture.photo, capture.rig, ball)
    image = trace_image(rig, ball)
    photo = remove_glare(capture.photo, rig, image)
    if not rig.has_screen:
        return _measure_room(capture, photo, rig, image, height), None
    screen = fit_screen(photo, rig, image, capture.pattern, capture.device, printed)
    lit = capture.pattern, screen.gain, screen.device
    fit = _fit_numbers(screen, rig)
    if _shows_another_pattern(screen, ball):
        raise not_the_pattern(ball)
    if (
        fit["screen_shift"] > PATTERN_CHECK.least_shift * rig.sample_size
        or fit["screen_tilt"] > PATTERN_CHECK.least_tilt
    ):
        rig = screen.rig
    fit |= _mirror_numbers(capture, rig, ball)
    fit["room_saturated"] = _room_saturated(photo, rig, image)
    environment, coverage = unfold_environment(photo, rig, image, height, screen.blur, screen.gain)
    seen, environment = environment, fill_environment(environment, coverage)
    filling = environment - seen
    raised = raise_clipped(photo, rig, image, lit, environment, screen.gain_deviation, screen.blur)
    environment, lamps, fit["room_raised"] = raised.environment, raised.lamps, raised.factor
    gain = screen.gain * raised.gain
    fit["gain_by_table"] = float(raised.gain.mean())
    lit = capture.pattern, gain, screen.device
    fit["vignetting"] = 0.0
    table = cache(partial(lit_table, photo, rig, ball, lit, environment))
    if fit["room_raised"] == 1 and screen.saturated <= SCREEN_FIT.saturated:  # the light is known
        fit["vignetting"] = find_vignetting(photo, rig, table)
        if fit["vignetting"]:
            photo = without_vignetting(photo, fit["vignetting"])
            table = cache(partial(lit_table, photo, rig, ball, lit, environment))
    shown = environment
    environment, fit["hidden_lamp"] = add_hidden_lamp(photo, rig, ball, table, shown, coverage)
    if fit["hidden_lamp"] > 1:
        lamps = environment - shown
    size = min(PATTERN_CHECK.captured_size, max(capture.pattern.shape[:2]))
    captured = unfold_pattern(photo, rig, ball, size)
    lights = Lights(
        rig, capture.pattern, environment, gain, coverage, captured, fit, screen.device, lamps
    )
    guess = STRENGTH.hidden_lamp if fit["hidden_lamp"] > 1 else raised.deviation
    fit |= light_doubts(lights, filling, screen.gain_deviation, guess)
    fit["light_deviation"] = light_deviation(fit)
    return lights, screen.response


def _measure_room(
    capture: Capture, photo: Photo, rig: Rig, image: BallImage, height: int
) -> Lights:
    """The lights of a rig without a screen: the environment, all of which the ball shows."""
    fit = {"camera_tilt": rig.off_nadir, "vignetting": 0.0}
    fit |= _mirror_numbers(capture, rig, image.ball)
    fit["room_saturated"] = _room_saturated(photo, rig, image)
    seen, coverage = unfold_environment(photo, rig, image, height)
    environment = fill_environment(seen, coverage)
    filling = environment - seen
    raised = raise_clipped(photo, rig, image, (NO_PATTERN, np.zeros(3), IDEAL), environment)
    environment, fit["room_raised"] = raised.environment, raised.factor
    near = find_near_lamp(photo, rig, image.ball, environment)
    if near is not None:
        fit["lamp_distance"] = math.dist(near.place, near.seen_from)
    gain = np.zeros(3, np.float32)
    lights = Lights(
        rig, NO_PATTERN, environment, gain, coverage, None, fit, lamps=raised.lamps, near=near
    )
    fit |= light_doubts(lights, filling, 0.0, raised.deviation)
    fit["light_deviation"] = light_deviation(fit)
    return lights


def _mirror_numbers(capture: Capture, rig: Rig, ball: Ball) -> dict[str, float]:
    """The numbers of `Lights.fit` that tell the mirror's reflectance."""
    known = "ball_reflectance" not in capture.unknown
    deviation = ball.reflectance_deviation or MIRRORED_TABLE.usual_deviation
    return {
        "ball_reflectance": float(np.mean(rig.ball_reflectance)),
        "ball_reflectance_deviation": 0.0 if known else deviation,
    }


def level_table(photo: Photo, rig: Rig, ball: Ball) -> Rig:
    """The rig with its table as it lies in the photo, by the ball's rim
    (`invrender.capture.ball_rim`).

    A camera that does not look straight down sees the horizon's image off the ball's middle. A
    photo cannot tell a turned camera from a turned table: camera and screen are turned together
    about the ball's centre, so that the ball stays where it is and what the camera sees of the
    screen too. A tilt that the rig gives is kept. One is not believed below
    `TABLE_LEVEL.least_tilt`, or where it is not several times its expected error, or in a JPEG,
    whose rounding hides the horizon, or by a full sphere, whose horizon lies beside the far table.
    """
    tilt = ball.camera_tilt
    if tilt is None or any(rig.camera_tilt) or photo.clip_level is not None:
        return rig
    error = TABLE_LEVEL.least_deviations * (ball.tilt_deviation or 0.0)
    if rig.ball_shape == "sphere" or np.linalg.norm(tilt) < max(TABLE_LEVEL.least_tilt, error):
        return rig
    return rig.turned(Rotation.from_rotvec(tilt, degrees=True), np.asarray(ball.position))


def _fit_numbers(screen: Screen, rig: Rig) -> dict[str, float]:
    """The numbers of `Lights.fit` that the screen's fit gives."""
    shift, tilt = (
        float(np.linalg.norm(np.subtract(getattr(screen.rig, n), getattr(rig, n))))
        for n in ("screen_shift", "screen_tilt")
    )
    return {
        "residual": screen.residual,
        "pattern_residual": screen.ideal_residual,
        "gain_deviation": screen.gain_deviation,
        "gamma": float(np.mean(screen.device.gamma)),
        "falloff": screen.device.falloff,
        "falloff_deviation": screen.falloff_deviation,
        "blur": screen.blur,
        "pixels": float(screen.pixels),
        "saturated": screen.saturated,
        "screen_shift": shift,
        "screen_tilt": tilt,
        "camera_tilt": rig.off_nadir,
    }


def _shows_another_pattern(screen: Screen, ball: Ball) -> bool:
    """Whether the ball shows another pattern, or is none.

    A display far from its place or with another curve explains a poor fit of the ideal one, if it
    fits itself. A ball that was given by hand is kept.
    """
    limit = PATTERN_CHECK.not_the_pattern
    return (
        screen.ideal_residual > limit
        and (screen.residual > limit or ball.confidence < PATTERN_CHECK.certain)
        and ball.confidence < 1
    )


def _room_saturated(photo: Photo, rig: Rig, image: BallImage) -> float:
    """Share of the ball's pixels that show the room, above the horizon, and are saturated."""
    room = image.sky & ~image.screen(rig)
    clipped = replace(photo, image=photo.image[image.area]).clipped
    return float(clipped[room].mean()) if room.any() else 0.0


def light_warnings(lights: Lights) -> tuple[Notice, ...]:
    """What is doubtful about the lights that a ball shows."""
    notices = []
    fit = lights.fit
    if fit.get("saturated", 0) > SCREEN_FIT.saturated and not fit.get("gain_by_paper"):
        text = (
            f"{fit['saturated']:.0%} of the screen is saturated in the ball; its radiance is read "
            f"from the rest, to ± {fit.get('gain_deviation', 0):.0%}, and from the table's "
            "shading: expose shorter"
        )
        notices.append(Notice("screen-saturated", text))
    if fit.get("room_saturated", 0) > PATTERN_CHECK.room_saturated:
        text = (
            f"{fit['room_saturated']:.1%} of the room is saturated in the ball; it was made "
            f"{fit.get('room_raised', 1):.1f} times brighter, as the table's shading suggests: "
            "expose shorter, or take a raw photo, to know"
        )
        notices.append(Notice("room-saturated", text))
    if fit.get("vignetting", 0) > 0:
        text = (
            f"the lens loses {fit['vignetting']:.0%} of the light in the photo's corners, by the "
            "table's shading; that was undone: use the camera's own lens correction if it has one"
        )
        notices.append(Notice("photo-vignetting", text))
    if fit.get("hidden_lamp", 1) > 1:
        text = (
            "the table's shading shows that there is a lamp behind the screen, which the ball does "
            "not show; it was made as bright as that suggests: turn the rig, or the lamp off, to "
            "know"
        )
        notices.append(Notice("hidden-lamp", text))
    if fit.get("pattern_residual", 0) > PATTERN_CHECK.not_the_pattern:
        text = (
            f"the ball shows the pattern only to within {fit['pattern_residual']:.0%}: check "
            "that the display shows this pattern, mirrored and the right way up"
        )
        notices.append(Notice("pattern-fits-badly", text))
    return tuple(notices)
