"""Which way round a photo is, and the pattern in it.

A phone that looks straight down cannot tell which side of its photo is up, so that its EXIF
orientation is arbitrary; and a display may show the pattern turned or not mirrored. The ball shows
both: the screen's image lies on one side of it, and the pattern resembles none of its own turns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from invrender.capture.ball import find_ball, no_ball
from invrender.capture.ball_image import unfold_pattern
from invrender.capture.camera import find_camera, is_whole
from invrender.capture.mirror import Ball, make_ball, place_ball
from invrender.capture.settings import BALL_SEARCH, BALL_SHAPE, CROPPING, ORIENTATION, SQUARE_FIT
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.rig import BALL_SHAPES, Rig, fov_of
from invrender.sampling import resize_pattern
from invrender.types import TINY, Array, InputError, Notice

Circle = tuple[float, float, float]


def find_ball_and_orientation(
    capture: Capture, manual: Circle | None = None
) -> tuple[Capture, Ball, tuple[Notice, ...]]:
    """Find camera and ball, and turn photo and pattern the right way round.

    Returns the capture with its camera where the sample's square says and with photo and pattern
    turned, the ball, and a notice for each that was turned. Both stay unless the ball clearly shows
    the pattern in another orientation. ``manual`` (x, y, radius) is the ball's circle in the photo
    as it is, in pixels. Raises `InputError` as `find_ball` does, and where a ball that was not
    given by hand shows something else than the pattern.
    """
    found: list[tuple[Capture, Ball, tuple[Notice, ...]]] = []
    fallback: tuple[Capture, Ball, float] | None = None
    problem: InputError | None = None
    photo = capture.photo
    if not capture.rig.has_screen:
        return _find_ball_alone(capture, manual)
    # As it is; then with the field of view taken to be across the photo's other side.
    for first in (0, 1) if manual is None and photo.height != photo.width else (0,):
        nominal = replace(capture, photo=turned_photo(photo, first))
        here, tilt_deviation = posed(nominal)
        try:
            here, ball = find_either_ball(here, manual, tilt_deviation, BALL_SEARCH.doubtful)
            if tilt_deviation < SQUARE_FIT.unseen_tilt:  # the square shows the tilt better
                ball = replace(ball, camera_tilt=None, tilt_deviation=None)
        except InputError as error:
            problem = problem or error
            continue
        if manual is None and here.tilt_deviation is None:
            _check_uncropped(here, ball)
        seen, white = unfold_pattern(here.photo, here.rig, ball, ORIENTATION.cells), white_of(here)
        expected = likeness(seen, resize_pattern(here.pattern, ORIENTATION.cells), white)
        if manual is None and is_unlikely(ball, expected):
            problem = problem or no_ball(ball)
            continue
        tells = (seen < ORIENTATION.saturated * white).any(-1).mean() > ORIENTATION.telling
        # No orientation can be so much more alike, or the screen is white in all of them.
        if expected > 1 - ORIENTATION.better or not tells:
            found.append((here, ball, _notices(first, 0, False)))
            break
        nominal = replace(nominal, rig=replace(nominal.rig, ball_shape=here.rig.ball_shape))
        (turn, quarter, mirrored), alike = _best_orientation(nominal, ball)
        if alike > ORIENTATION.alike and alike > expected + ORIENTATION.better:
            turned, moved = _turned(nominal, ball, turn)
            assert moved is not None
            rig = turned_rig(replace(capture.rig, ball_shape=here.rig.ball_shape), ball.size, turn)
            shown = oriented(here.pattern, quarter, mirrored)
            here, _ = posed(replace(nominal, photo=turned, rig=rig, pattern=shown))
            again = place_ball(here.rig, moved.size, *moved.centre, moved.radius)
            ball = replace(
                moved, position=again.position, radius_m=again.radius_m, ellipse=again.ellipse
            )
            found.append((here, ball, _notices((first + turn) % 4, quarter, mirrored)))
            if turn % 2 == 0:
                break
            # By a quarter the field of view went to the other side; the next round asks whether
            # it was that side's from the start, which a ball of unknown shape can hide.
        if first == 0:
            fallback = here, ball, expected
    if found:
        return max(found, key=lambda one: one[1].confidence)
    if fallback is None:
        assert problem is not None
        raise _explained(problem, capture) from None
    here, ball, expected = fallback
    has_sides = capture.pattern.std((0, 1)).max() > ORIENTATION.flat
    if manual is None and expected < ORIENTATION.unlike and has_sides:
        raise not_the_pattern(ball)
    return here, ball, ()


def _find_ball_alone(
    capture: Capture, manual: Circle | None
) -> tuple[Capture, Ball, tuple[Notice, ...]]:
    """As `find_ball_and_orientation`, without a screen: the first of the photo's quarter turns in
    which there are the ball and, beside it, the sample's square or the capture sheet; the photo as
    it is where none shows both."""
    photo, first = capture.photo, None
    problem: InputError | None = None
    for turn in range(4 if manual is None and capture.tilt_deviation is None else 1):
        rig = turned_rig(capture.rig, (photo.height, photo.width), turn)
        here = replace(capture, photo=turned_photo(photo, turn), rig=rig)
        here, tilt_deviation = posed(here)
        clear = tilt_deviation < SQUARE_FIT.unseen_tilt
        if turn and not clear:
            continue
        try:
            here, ball = find_either_ball(here, manual, tilt_deviation)
        except InputError as error:
            problem = problem or error
            continue
        if clear:
            ball = replace(ball, camera_tilt=None, tilt_deviation=None)
            return here, ball, _notices(turn, 0, False)
        first = here, ball, ()
    if first is None:
        assert problem is not None
        raise _explained(problem, capture) from None
    return first


def _check_uncropped(capture: Capture, ball: Ball) -> None:
    """Raise `InputError` for a photo whose shape no camera has, with the ball off its middle: the
    optical axis is then not the photo's centre."""
    photo = capture.photo
    rig = capture.rig
    expected = make_ball(rig, rig.ball_centre, rig.ball_radius, ball.size)
    distance = math.dist(ball.centre, expected.centre) / ball.radius
    if not is_whole(photo) and distance > CROPPING.off_centre:
        raise InputError(
            f"the photo seems to be cropped off centre: it has {photo.width} × {photo.height} "
            f"pixels, as no camera makes them, and the ball lies {distance:.1f} radii from its "
            "middle; give the whole photo, or the ball by hand with --ball to take it as it is"
        )


def not_the_pattern(ball: Ball) -> InputError:
    """The error for a ball whose image of the screen shows another pattern, or none."""
    (x, y), r = ball.centre, ball.radius
    return InputError(
        f"what looks like the mirror ball ({x:.0f}, {y:.0f}, radius {r:.0f} pixels) does not "
        "show the pattern: check that the display shows it the right way round, or give the "
        f"ball by hand, --ball {x:.0f},{y:.0f},{r:.0f} to keep this one"
    )


def is_unlikely(ball: Ball, alike: float) -> bool:
    """Whether a ball that is alike to the pattern by so much is none: its rim is not all that tells
    it."""
    return ball.confidence < BALL_SEARCH.least_confidence and alike < ORIENTATION.alike


def find_either_ball(
    capture: Capture,
    manual: Circle | None,
    tilt_deviation: float,
    least: float = BALL_SEARCH.least_confidence,
) -> tuple[Capture, Ball]:
    """The ball, a hemisphere or a sphere, whichever fits better where nobody states it; and the
    capture with that shape. least: of `find_ball`."""
    photo, rig = capture.photo, capture.rig
    if "ball_shape" not in capture.unknown or manual is not None:
        return capture, find_ball(photo, rig, manual, tilt_deviation, least)
    found: list[tuple[float, Rig, Ball]] = []
    problem: InputError | None = None
    # The capture sheet measures the ball: taken for the other shape it is some 6% off.
    weight = BALL_SHAPE.sheet_weight if capture.fov_from == "sheet" else 1.0
    for shape in BALL_SHAPES:
        shaped = replace(rig, ball_shape=shape)
        try:
            ball = find_ball(photo, shaped, None, tilt_deviation, least)
        except InputError as error:
            problem = problem or error
            continue
        score = ball.confidence - weight * abs(ball.radius_m / rig.ball_radius - 1)
        found.append((score, shaped, ball))
        if score > BALL_SHAPE.certain:
            break
    if not found:
        assert problem is not None
        raise problem
    _, shaped, ball = max(found, key=lambda f: f[0])
    return replace(capture, rig=shaped), ball


def posed(capture: Capture) -> tuple[Capture, float]:
    """The capture with its camera where the sample's square says, unless that is known better."""
    if capture.tilt_deviation is not None:
        return capture, capture.tilt_deviation
    rig, tilt_deviation = find_camera(capture.photo, capture.rig)
    return replace(capture, rig=rig), tilt_deviation


def seen_patterns(capture: Capture, ball: Ball) -> Iterator[tuple[int, Array]]:
    """What the ball shows of the screen, `ORIENTATION.cells` a side, with the photo turned
    counter-clockwise by so many quarters, where the ball can be there."""
    for turn in range(4):
        photo, moved = _turned(capture, ball, turn)
        if moved is not None:
            # The optics stay as they are, so that the angle across the other side differs.
            rig = turned_rig(capture.rig, ball.size, turn)
            yield turn, unfold_pattern(photo, rig, moved, ORIENTATION.cells)


def _best_orientation(capture: Capture, ball: Ball) -> tuple[tuple[int, int, bool], float]:
    """Quarters of the photo and of the pattern, and whether that is mirrored, by which the ball
    shows the pattern best; and how alike they are then."""
    best, alike = (0, 0, False), -1.0
    white = white_of(capture)
    pattern = resize_pattern(capture.pattern, ORIENTATION.cells)
    for turn, seen in seen_patterns(capture, ball):
        for mirrored in (False, True):
            for quarter in range(4):
                score = likeness(seen, oriented(pattern, quarter, mirrored), white)
                if score > alike:
                    alike, best = score, (turn, quarter, mirrored)
    return best, alike


def _notices(turns: int, quarter: int, mirrored: bool) -> tuple[Notice, ...]:
    """What was turned."""
    notices = []
    if turns:
        text = (
            f"the photo was turned by {90 * turns}° counter-clockwise: the ball shows which side "
            "is up"
        )
        notices.append(Notice("photo-turned", text))
    if quarter or mirrored:
        how = " and ".join(["mirrored"] * mirrored + [f"turned by {90 * quarter}°"] * bool(quarter))
        text = (
            f"the display shows the pattern {how}; it was taken as shown, but the networks know it "
            "only as 'invrender pattern -o FILE.html' shows it, and the maps are worse"
        )
        notices.append(Notice("pattern-turned", text))
    return tuple(notices)


def oriented(pattern: Array, quarter: int, mirrored: bool) -> Array:
    """The pattern mirrored left to right, if so, then turned by quarters counter-clockwise."""
    return np.ascontiguousarray(np.rot90(pattern[:, ::-1] if mirrored else pattern, quarter))


def turned_photo(photo: Photo, turns: int) -> Photo:
    return replace(photo, image=np.rot90(photo.image, turns)) if turns % 4 else photo


def turned_rig(rig: Rig, size: tuple[int, int], turns: int) -> Rig:
    """The rig with the field of view across a photo of ``size`` (H, W), turned by quarters."""
    if turns % 2 == 0:
        return rig
    tangent = math.tan(math.radians(rig.fov) / 2) * size[0] / size[1]
    return replace(rig, fov=min(max(fov_of(tangent), 1), 170))


def _turned(capture: Capture, ball: Ball, turns: int) -> tuple[Photo, Ball | None]:
    """Photo and ball turned by quarters counter-clockwise; no ball where it cannot be there."""
    photo = turned_photo(capture.photo, turns)
    if turns % 4 == 0:
        return photo, ball
    (x, y), (h, w) = ball.centre, ball.size
    x, y = {1: (y, w - x), 2: (w - x, h - y), 3: (h - y, x)}[turns % 4]
    rig = turned_rig(capture.rig, ball.size, turns)
    try:
        moved = place_ball(rig, (photo.height, photo.width), x, y, ball.radius)
    except InputError:
        return photo, None
    moved = replace(
        ball,
        position=moved.position,
        radius_m=moved.radius_m,
        size=moved.size,
        centre=moved.centre,
        radius=moved.radius,
        ellipse=moved.ellipse,
    )
    if ball.camera_tilt is None:
        return photo, moved
    tilt = Rotation.from_euler("z", 90 * turns, degrees=True).apply(ball.camera_tilt)
    return photo, replace(moved, camera_tilt=tuple(tilt.tolist()))


def white_of(capture: Capture) -> Array:
    """Radiance (3,) from which the ball's image is saturated; infinite where nothing is."""
    level = capture.photo.clip_level or math.inf
    return np.asarray(level / np.broadcast_to(capture.rig.ball_reflectance, 3))


def likeness(seen: Array, shown: Array, white: Array) -> float:
    """Correlation in [-1, 1] of two images (n, n, 3), each channel about its own mean and spread.

    What is seen is saturated from ``white`` (3,) on; as much of what is ``shown`` counts as that.
    The brightest few cells of both count as equal: a lamp beside the screen's edge may be seen in
    them.
    """
    saturated = (seen >= ORIENTATION.saturated * white).mean((0, 1))
    share = np.minimum(1 - saturated, 1 - ORIENTATION.brightest)
    seen, shown = (
        np.minimum(a, [np.quantile(a[..., c], share[c]) for c in range(3)]) for a in (seen, shown)
    )
    a, b = (x.reshape(-1, 3) - x.reshape(-1, 3).mean(0) for x in (seen, shown))
    spread = a.std(0) * b.std(0)
    least = ORIENTATION.least_spread * np.abs(seen).mean() * np.abs(shown).mean()
    use = spread > least + TINY
    return float(((a * b).mean(0)[use] / spread[use]).mean()) if use.any() else 0.0


def _explained(error: InputError, capture: Capture) -> InputError:
    """The error, with a hint at the field of view where that is only what the EXIF says."""
    if capture.photo.fov is None or capture.photo.fov != capture.rig.fov:
        return error
    return InputError(
        f"{error}; the photo's EXIF gives a field of view of {capture.rig.fov:.0f}°: where that is "
        "wrong, set [camera] fov in rig.toml"
    )
