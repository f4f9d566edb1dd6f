"""What a person sets by hand in a photo: which way is up, the ball, the sample's corners."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from invrender.capture.ball import find_ball
from invrender.capture.lights import (
    FoundLights,
    find_lights,
    light_warnings,
    measure_fov,
    measure_lights,
    use_reflectance,
)
from invrender.capture.orientation import turned_photo, turned_rig
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array, InputError

GREATEST_MISFIT = 0.05  # of the square's side by which corners may miss those of any camera
FARTHEST_CAMERA = 1.0  # of the sample's size that the camera may stand off
STEEPEST_CAMERA = 60.0  # degrees that it may be tilted
TOO_LOW = 0.1  # of the screen's height, below which no camera is looked for
INSIDE = 0.99  # of the bounds, where the search may start


def find_corrected_lights(capture: Capture, fix: dict[str, Any]) -> FoundLights:
    """`find_lights` with what was set by hand in place of what it would look for.

    fix: ``turn``, quarters counter-clockwise that the photo is turned by; ``ball`` (x, y, radius)
    and ``corners`` (4, 2), in the order of `Rig.sample_corners`, in pixels of the turned photo.
    Raises `InputError` as `find_lights` does, and for corners that no camera sees.
    """
    turn, corners = fix.get("turn", 0), fix.get("corners")
    ball = tuple(fix["ball"]) if fix.get("ball") else None
    if not turn and corners is None:
        return find_lights(capture, ball=ball)
    capture = turned(capture, turn)
    photo, notices = capture.photo, capture.warnings
    if capture.fov_from == "unknown":
        capture, fov_notices = measure_fov(capture, ball)
        notices = (*notices, *fov_notices)
    if corners is None:
        found = find_ball(photo, capture.rig, ball)
    else:
        rig = camera_of_corners(capture.rig, np.asarray(corners), photo.height, photo.width)
        capture = replace(capture, rig=rig)
        found = find_ball(photo, rig, ball)
        found = replace(found, camera_tilt=None, tilt_deviation=None)  # the corners tell it
    capture, mirror = use_reflectance(capture, found)
    lights = measure_lights(capture, found)
    return FoundLights(capture, lights, found, (*notices, *mirror, *light_warnings(lights)))


def turned(capture: Capture, turn: int) -> Capture:
    """The capture with its photo turned counter-clockwise by quarters, the optics as they are."""
    if turn % 4 == 0:
        return capture
    photo = capture.photo
    rig = turned_rig(capture.rig, (photo.height, photo.width), turn)
    return replace(capture, photo=turned_photo(photo, turn), rig=rig)


def turn_between(before: Photo, after: Photo) -> int:
    """Quarters counter-clockwise by which a photo was turned."""
    step = max(1, max(before.height, before.width) // 64)  # a small copy tells
    small = before.image[::step, ::step]
    for turn in range(4):
        back = np.rot90(after.image, -turn)
        if back.shape == before.image.shape and np.array_equal(back[::step, ::step], small):
            return turn
    return 0


def camera_of_corners(rig: Rig, corners: Array, height: int, width: int) -> Rig:
    """The rig with its camera where it sees the sample's corners at these pixels (4, 2).

    Least squares over the camera's place and tilt. Raises `InputError` where no camera does.
    """
    side = float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=-1).mean())
    if not side > 0:
        raise InputError("the sample's corners lie in one point: drag each to its own corner")
    scale = np.array([rig.sample_size] * 3 + [math.degrees(1)] * 3)

    def posed(x: Array) -> Rig:
        shift, tilt = np.split(x * scale, 2)
        return replace(rig, camera_shift=tuple(shift.tolist()), camera_tilt=tuple(tilt.tolist()))

    def misfit(x: Array) -> Array:
        seen = posed(x).project(rig.sample_corners, height, width)
        return np.nan_to_num((seen - corners) / side, nan=FARTHEST_CAMERA).ravel()

    reach = np.array([FARTHEST_CAMERA] * 3 + [math.radians(STEEPEST_CAMERA)] * 3)
    low = -reach
    low[2] = max(low[2], (TOO_LOW - 1) * rig.screen_height / rig.sample_size)
    start = np.clip([*rig.camera_shift, *rig.camera_tilt] / scale, low * INSIDE, reach * INSIDE)
    best = least_squares(misfit, start, bounds=(low, reach), x_scale="jac")
    if np.abs(best.fun).max() > GREATEST_MISFIT:
        raise InputError(
            "no camera sees a square at these four corners: drag each to the sample's own corner"
        )
    return posed(best.x)
