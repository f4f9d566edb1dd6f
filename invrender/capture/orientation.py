"""Which way round a photo is, and the pattern in it.

A phone that looks straight down cannot tell which side of its photo is up, so that its EXIF
orientation is arbitrary; and a display may show the pattern turned or not mirrored. The ball tells
both: the screen's image lies on one side of it, and the pattern resembles none of its own turns.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from invrender.capture.ball import find_ball
from invrender.capture.ball_image import unfold_pattern
from invrender.capture.camera import find_camera
from invrender.capture.lights import not_the_pattern
from invrender.capture.mirror import Ball, place_ball
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sampling import resize_pattern
from invrender.types import Array, InputError

CELLS = 24  # of the pattern as it is compared
ALIKE = 0.7  # correlation from which the ball shows the pattern in another orientation ...
BETTER = 0.3  # ... if it is that much higher than as it is
UNLIKE = 0.5  # correlation below which it is another one; 25 hard simulated photos had 0.82
FLAT = 0.05  # standard deviation of a pattern that has no sides to tell
Circle = tuple[float, float, float]


def find_upright_ball(
    capture: Capture, manual: Circle | None = None
) -> tuple[Capture, Ball, list[str]]:
    """`find_ball`, with photo and pattern turned as they should have been; and what was turned.

    ``manual`` is the ball's circle in the photo as it is. The capture comes back unchanged unless
    the ball shows the pattern plainly in another orientation. Raises `InputError` as `find_ball`,
    and where a ball that was not given by hand shows something else.
    """
    fallback: tuple[Capture, Ball, float] | None = None
    problem: InputError | None = None
    photo = capture.photo
    # As it is; then with the field of view taken to be across the photo's other side.
    for first in (0, 1) if manual is None and photo.height != photo.width else (0,):
        told = replace(capture, photo=_turned_photo(photo, first))
        here, tilt = posed(told)
        try:
            ball = find_ball(here.photo, here.rig, manual, tilt)
        except InputError as error:
            problem = problem or error
            continue
        usual = _likeness(
            unfold_pattern(here.photo, here.rig, ball, CELLS), resize_pattern(here.pattern, CELLS)
        )
        if usual > 1 - BETTER:  # no orientation can be so much more alike
            return here, ball, _told(first, 0, False)
        (turn, quarter, mirrored), alike = _orientation(told, ball)
        if alike > ALIKE and alike > usual + BETTER:
            turned, moved = _turned(told, ball, turn)
            assert moved is not None
            rig = _turned_rig(capture.rig, ball.size, turn)
            shown = oriented(here.pattern, quarter, mirrored)
            here, _ = posed(replace(told, photo=turned, rig=rig, pattern=shown))
            again = place_ball(here.rig, moved.size, *moved.centre, moved.radius)
            ball = replace(again, confidence=ball.confidence, camera_tilt=moved.camera_tilt)
            return here, ball, _told((first + turn) % 4, quarter, mirrored)
        if first == 0:
            fallback = here, ball, usual
    if fallback is None:
        assert problem is not None
        raise _explained(problem, capture) from None
    here, ball, usual = fallback
    if manual is None and usual < UNLIKE and capture.pattern.std((0, 1)).max() > FLAT:
        raise not_the_pattern(ball)
    return here, ball, []


def posed(capture: Capture) -> tuple[Capture, float]:
    """The capture with its camera where the sample's square is seen from, if that is plain; and the
    deviation to expect of the camera's tilt in degrees."""
    rig, tilt = find_camera(capture.photo, capture.rig)
    return replace(capture, rig=rig), tilt


def _orientation(capture: Capture, ball: Ball) -> tuple[tuple[int, int, bool], float]:
    """Quarters of the photo and of the pattern, and whether that is mirrored, by which the ball
    shows the pattern best; and how alike they are then."""
    best, alike = (0, 0, False), -1.0
    pattern = resize_pattern(capture.pattern, CELLS)
    for turn in range(4):
        photo, moved = _turned(capture, ball, turn)
        if moved is None:
            continue
        # The optics stay as they are, so that the angle across the other side differs.
        seen = unfold_pattern(photo, _turned_rig(capture.rig, ball.size, turn), moved, CELLS)
        for mirrored in (False, True):
            for quarter in range(4):
                score = _likeness(seen, oriented(pattern, quarter, mirrored))
                if score > alike:
                    alike, best = score, (turn, quarter, mirrored)
    return best, alike


def _told(turns: int, quarter: int, mirrored: bool) -> list[str]:
    """What was turned, a sentence each."""
    warnings = []
    if turns:
        warnings.append(
            f"the photo was turned by {90 * turns}° counter-clockwise: the ball shows which side "
            "is up"
        )
    if quarter or mirrored:
        how = " and ".join(["mirrored"] * mirrored + [f"turned by {90 * quarter}°"] * bool(quarter))
        warnings.append(
            f"the display shows the pattern {how}; it was taken as shown, but show it as "
            "'invrender pattern -o FILE.html' does"
        )
    return warnings


def oriented(pattern: Array, quarter: int, mirrored: bool) -> Array:
    """The pattern mirrored left to right, if so, then turned by quarters counter-clockwise."""
    return np.ascontiguousarray(np.rot90(pattern[:, ::-1] if mirrored else pattern, quarter))


def _turned_photo(photo: Photo, turns: int) -> Photo:
    return replace(photo, image=np.rot90(photo.image, turns)) if turns % 4 else photo


def _turned_rig(rig: Rig, size: tuple[int, int], turns: int) -> Rig:
    """The rig with the field of view across a photo of ``size`` (H, W), turned by quarters."""
    if turns % 2 == 0:
        return rig
    tangent = math.tan(math.radians(rig.fov) / 2) * size[0] / size[1]
    return replace(rig, fov=min(max(math.degrees(2 * math.atan(tangent)), 1), 170))


def _turned(capture: Capture, ball: Ball, turns: int) -> tuple[Photo, Ball | None]:
    """Photo and ball turned by quarters counter-clockwise; no ball where it cannot be there."""
    photo = _turned_photo(capture.photo, turns)
    if turns % 4 == 0:
        return photo, ball
    (x, y), (h, w) = ball.centre, ball.size
    x, y = {1: (y, w - x), 2: (w - x, h - y), 3: (h - y, x)}[turns % 4]
    rig = _turned_rig(capture.rig, ball.size, turns)
    try:
        moved = place_ball(rig, (photo.height, photo.width), x, y, ball.radius)
    except InputError:
        return photo, None
    if ball.camera_tilt is None:
        return photo, moved
    tilt = Rotation.from_euler("z", 90 * turns, degrees=True).apply(ball.camera_tilt)
    return photo, replace(moved, camera_tilt=tuple(tilt.tolist()))


def _likeness(seen: Array, shown: Array) -> float:
    """Correlation in [-1, 1] of two images, each channel about its own mean and spread."""
    a, b = (x.reshape(-1, 3) - x.reshape(-1, 3).mean(0) for x in (seen, shown))
    spread = a.std(0) * b.std(0)
    use = spread > 1e-3 * np.abs(seen).mean() * np.abs(shown).mean() + 1e-12
    return float(((a * b).mean(0)[use] / spread[use]).mean()) if use.any() else 0.0


def _explained(error: InputError, capture: Capture) -> InputError:
    """The error with the field of view's part in it, where that is only what the EXIF says."""
    if capture.photo.fov is None or capture.photo.fov != capture.rig.fov:
        return error
    return InputError(
        f"{error}; the photo's EXIF gives a field of view of {capture.rig.fov:.0f}°: where that is "
        "wrong, set [camera] fov in rig.toml"
    )
