"""A capture folder in; its lights and its sample out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from invrender.capture.ball_image import (
    pixel_grid,
    screen_coordinates,
    trace_ball,
    unfold_pattern,
    window,
)
from invrender.capture.clipped_lamps import raise_clipped
from invrender.capture.environment import fill_environment, unfold_environment
from invrender.capture.glare import lift_veil
from invrender.capture.hidden_lamp import add_hidden_lamp
from invrender.capture.mirror import Ball
from invrender.capture.screen import SATURATED, fit_screen
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array, InputError

# Residual of the ideal pattern from which the ball shows another pattern, or is none: nine
# hard simulated balls had at most 0.12, nine wrong ones at least 0.29.
NO_PATTERN = 0.22
SURE = 0.75  # confidence from which a ball is one even if its pattern fits as badly
# Shift in sizes of the sample, and tilt in degrees, that an error of the ball's place, a hundredth
# of its radius, cannot explain: a smaller one is taken for such an error.
MOVED = (0.022, 1.0)
TILTED = 1.1  # degrees; a smaller tilt of the camera is taken for an error of the rim's fit


@dataclass(frozen=True)
class Lights:
    """The light on the sample, in the photo's radiance units.

    ``environment`` (H, 2H, 3): radiance, filled in behind the screen, nought below the horizon;
    ``coverage`` (H, 2H): the share of each texel that the ball really shows. The screen's radiance
    is ``gain`` (3,) times ``pattern`` (h, w, 3); ``pattern_captured`` is what the ball shows of it,
    rectified. ``fit`` tells how well: ``residual`` of the pattern's fit relative to the gain,
    ``gamma`` the exponent on the pattern that fits best (1: as it should be; the gain is for 1),
    ``blur`` the camera's in pixels, ``pixels`` the number used, ``saturated`` and
    ``room_saturated`` the shares of screen and room in the ball that are saturated,
    ``room_raised`` how many times brighter the saturated lamps were made, ``hidden_lamp`` how many
    times brighter than the filling a part of the room behind the screen was made (1: none),
    ``pattern_residual`` the residual before the screen's pose and curve were fitted,
    ``camera_tilt`` how far the camera is found to look past straight down, in degrees. Where the
    pattern as it should be fits badly, ``pattern`` is as the display really shows it, and ``rig``
    as the screen really hangs; else both are those of the capture, but for the tilt (`level`).
    """

    environment: Array
    coverage: Array
    pattern: Array
    gain: Array
    pattern_captured: Array
    rig: Rig
    fit: dict[str, float] = field(default_factory=dict)


def not_the_pattern(ball: Ball) -> InputError:
    """What is wrong with a ball whose image of the screen is another's."""
    (x, y), r = ball.centre, ball.radius
    return InputError(
        f"what looks like the mirror ball ({x:.0f}, {y:.0f}, radius {r:.0f} pixels) does not "
        "show the pattern: check that the display shows it the right way round, or give the "
        f"ball by hand, --ball {x:.0f},{y:.0f},{r:.0f} to keep this one"
    )


def level(photo: Photo, rig: Rig, ball: Ball) -> Rig:
    """The rig with its table as it lies in the photo, by the ball's rim
    (`invrender.capture.ball_rim`).

    A camera that does not look straight down sees the horizon's image off the ball's middle. A
    photo cannot tell a turned camera from a turned table: camera and screen are turned together
    about the ball's centre, so that the ball stays where it is and what the camera sees of the
    screen too. A tilt that the rig tells is kept, and one below `TILTED` not believed; a JPEG's
    rounding hides the horizon too well.
    """
    tilt = ball.camera_tilt
    if tilt is None or any(rig.camera_tilt) or photo.clip_level is not None:
        return rig
    if np.linalg.norm(tilt) < TILTED:
        return rig
    return rig.turned(Rotation.from_rotvec(tilt, degrees=True), np.asarray(ball.position))


def extract_lights(capture: Capture, ball: Ball, height: int = 128) -> Lights:
    """Unfold the ball: the environment (``height`` rows) and the screen's pattern and gain."""
    photo, rig = capture.photo, capture.rig
    if ball.size != (photo.height, photo.width):
        raise InputError("the ball was found in a photo of another size")
    if height < 8 or height % 2:
        raise InputError(f"the environment needs an even height of 8 rows or more, got {height}")
    rig = level(photo, rig, ball)
    tilted = math.degrees(math.acos(min(1.0, float(rig.camera_axes[2, 2]))))
    photo = lift_veil(photo, rig, ball)
    screen = fit_screen(photo, rig, ball, capture.pattern)
    pattern, gain = screen.shown, screen.gain
    shift, tilt = (
        float(np.linalg.norm(np.subtract(getattr(screen.rig, n), getattr(rig, n))))
        for n in ("screen_shift", "screen_tilt")
    )
    if shift > MOVED[0] * rig.sample_size or tilt > MOVED[1]:
        rig = screen.rig
    fit = {
        "residual": screen.residual, "pattern_residual": screen.ideal_residual,
        "gamma": float(np.mean(screen.gamma)), "blur": screen.blur, "pixels": float(screen.pixels),
        "saturated": screen.saturated, "screen_shift": shift, "screen_tilt": tilt,
        "camera_tilt": tilted,
    }  # fmt: skip
    # A display far from its place or with another curve explains a poor ideal fit, if it fits.
    if (
        fit["pattern_residual"] > NO_PATTERN
        and (fit["residual"] > NO_PATTERN or ball.confidence < SURE)
        and ball.confidence < 1
    ):
        raise not_the_pattern(ball)
    fit["room_saturated"] = _room_saturated(photo, rig, ball)
    environment, coverage = unfold_environment(photo, rig, ball, height, blur=screen.blur)
    environment, fit["room_raised"] = raise_clipped(
        photo, rig, ball, pattern, gain, environment, coverage
    )
    environment, fit["hidden_lamp"] = add_hidden_lamp(
        photo, rig, ball, pattern, gain, fill_environment(environment, coverage), coverage
    )
    captured = unfold_pattern(photo, rig, ball, min(256, max(pattern.shape[:2])))
    return Lights(environment, coverage, pattern, gain, captured, rig, fit)


def _room_saturated(photo: Photo, rig: Rig, ball: Ball) -> float:
    """Share of the ball's pixels that show the room, above the horizon, and are saturated."""
    rows, columns = window(ball)
    point, mirrored, seen = trace_ball(rig, ball, pixel_grid(rows, columns))
    room = seen & (mirrored[..., 2] > 0) & ~screen_coordinates(rig, point, mirrored)[2]
    return float(photo.clipped[rows, columns][room].mean()) if room.any() else 0.0


def light_warnings(lights: Lights) -> list[str]:
    """What is doubtful about the lights that a ball shows, a sentence each."""
    warnings = []
    fit = lights.fit
    if fit.get("saturated", 0) > SATURATED:
        warnings.append(
            f"{fit['saturated']:.0%} of the screen is saturated in the ball; its radiance is "
            "guessed from the rest, and likely too low: expose shorter"
        )
    if fit.get("room_saturated", 0) > 0.001:
        warnings.append(
            f"{fit['room_saturated']:.1%} of the room is saturated in the ball; it was made "
            f"{fit.get('room_raised', 1):.1f} times brighter, as the table's shading suggests: "
            "expose shorter, or take a raw photo, to know"
        )
    if fit.get("hidden_lamp", 1) > 1:
        warnings.append(
            "the table's shading tells of a lamp behind the screen, which the ball does not show; "
            "it was made as bright as that suggests: turn the rig, or the lamp off, to know"
        )
    if fit.get("pattern_residual", 0) > NO_PATTERN:
        warnings.append(
            f"the ball shows the pattern only to within {fit['pattern_residual']:.0%}: check "
            "that the display shows this pattern, mirrored and the right way up"
        )
    return warnings
