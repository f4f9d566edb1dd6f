"""Finding the mirror ball in a photo.

A hemisphere on the table has two sharp curves in a photo: its outline, and inside it the image of
the horizon, where the mirror turns from showing the table to showing what is above it. Both are
exact functions of the ball's circle: x and y of its centre on the table and its radius, in metres.
Between the two curves the ball shows the table around it, which the photo shows as well: this part
of the image can be predicted, and no coin or printed circle passes that test.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
from scipy import ndimage, optimize

from invrender.capture.ball_rim import fit_rim
from invrender.capture.ball_view import View, horizon_curve, normals, outline_curve, view_around
from invrender.capture.mirror import (
    Ball,
    ball_centre,
    is_whole,
    make_ball,
    mirror_normals,
    on_table,
    place_ball,
)
from invrender.capture.response import curve_exponent
from invrender.capture.robust import spread
from invrender.capture.settings import (
    BALL_SEARCH,
    BALL_VIEW,
    FIELD_OF_VIEW,
    MIRRORED_TABLE,
    RIM_FIT,
)
from invrender.files.images import Photo
from invrender.rig import Rig, fov_of
from invrender.types import TINY, Array, InputError, Mask, Vec3

__all__ = ["Ball", "find_ball", "make_ball", "mirror_normals", "place_ball"]


def find_ball(
    photo: Photo,
    rig: Rig,
    manual: tuple[float, float, float] | None = None,
    tilt_deviation: float = RIM_FIT.tilt_deviation,
    least: float = BALL_SEARCH.least_confidence,
) -> Ball:
    """Find the mirror ball in a photo; the rig gives its shape, its size and about its place.

    Every place within `BALL_SEARCH.reach` radii of where the rig puts it is scored by how well the
    image's edges run along the horizon's and the outline's curves there; the best few are refined
    and the best of these is kept. The mirror's reflectance need not be known: at each place it is
    measured, from the table seen in the ball against the same table seen directly, and the rig's is
    used only where the photo agrees with it. ``manual`` (x, y, r) in pixels overrides the search.
    ``tilt_deviation``: the expected error of the camera's tilt, degrees. Raises `InputError` where
    no ball is found with at least the confidence ``least``, or where it is cut off, saturated or
    too small.
    """
    size = (photo.height, photo.width)
    if manual is not None:
        ball = place_ball(rig, size, *manual)
        _check_exposure(photo, ball)
        return measure_reflectance(photo, rig, ball)
    view, climbed = _search(photo, rig)

    def finer(circle: Array) -> Array:
        for settings in BALL_SEARCH.climbs:
            circle = _climb_measured(view, rig, circle, *settings)
        return circle

    def worth_fitting(circle: Array) -> bool:
        mirror, _ = _with_reflectance(view, rig, circle)
        return _confidence(view, mirror, circle) > BALL_SEARCH.worth_fitting

    def circles() -> Iterator[Array]:
        best = finer(climbed[0])
        yield best
        # The others serve only where the best one leaves doubt.
        smaller, larger = BALL_SEARCH.other_radii
        yield best * [1, 1, smaller]
        for other in climbed[1:2]:
            yield finer(other)
        yield best * [1, 1, larger]
        # A speckled table has many places that look likelier at first.
        if max(b.confidence for b in balls) < BALL_SEARCH.least_confidence:
            yield from filter(worth_fitting, map(finer, climbed[2:]))
            more = _search(photo, rig, BALL_SEARCH.kept)[1]
            yield from filter(worth_fitting, map(finer, more))

    balls: list[Ball] = []
    for circle in circles():
        found = _fit(photo, view, rig, circle, bool(balls), tilt_deviation)
        fits_agree = any(_distance(found, other) < BALL_SEARCH.same for other in balls)
        balls.append(found)
        if found.confidence > (BALL_SEARCH.likely if fits_agree else BALL_SEARCH.certain):
            break
    ball = max(balls, key=lambda b: b.confidence)
    if tilt_deviation > RIM_FIT.tilt_deviation:
        ball = replace(ball, confidence=min(ball.confidence, BALL_SEARCH.tilted_confidence))
    (x, y), r = ball.centre, ball.radius
    if ball.confidence < least:
        raise no_ball(ball)
    if not is_whole(size, x, y, r):
        raise InputError(f"the mirror ball at {x:.0f}, {y:.0f} is cut off by the edge of the photo")
    _check_exposure(photo, ball)
    return measure_reflectance(photo, rig, ball)


def no_ball(ball: Ball) -> InputError:
    """The error for a photo in which the best place for a ball is none."""
    (x, y), r = ball.centre, ball.radius
    return InputError(
        f"no mirror ball found (the best place, {x:.0f}, {y:.0f} with a radius of {r:.0f} "
        f"pixels, has a confidence of {ball.confidence:.2f}): give it by hand as x, y, radius"
    )


def find_fov(photo: Photo, rig: Rig, manual: tuple[float, float, float] | None = None) -> float:
    """The horizontal field of view, degrees, in which the ball is as large as the rig says.

    The ball is looked for with focal lengths a step apart; in the likeliest few its rim is fitted.
    ``manual`` (x, y, r) in pixels is a ball given by hand. Raises `InputError` where no ball is
    found with any of them.
    """
    if manual is not None:
        for _ in range(FIELD_OF_VIEW.rounds):
            ball = place_ball(rig, (photo.height, photo.width), *manual)
            rig = replace(rig, fov=_fov_by(ball, rig))
        return rig.fov
    low, high = (
        math.tan(math.radians(angle) / 2)
        for angle in (FIELD_OF_VIEW.narrowest, FIELD_OF_VIEW.widest)
    )
    count = math.ceil(math.log(high / low) / math.log(FIELD_OF_VIEW.step)) + 1
    scored: list[tuple[float, Rig]] = []
    for tangent in np.geomspace(low, high, count):
        tried = replace(rig, fov=fov_of(tangent))
        try:
            view, climbed = _search(photo, tried, FIELD_OF_VIEW.candidates)
        except InputError:
            continue
        scored.append((_score_measured(view, tried, climbed[0], 0), tried))
    scored.sort(key=lambda pair: -pair[0])
    best: tuple[float, float] | None = None
    for _, tried in scored[: FIELD_OF_VIEW.tries]:
        try:
            for _ in range(FIELD_OF_VIEW.rounds):
                ball, before = find_ball(photo, tried), tried.focal(2)
                tried = replace(tried, fov=_fov_by(ball, tried))
                if abs(tried.focal(2) / before - 1) < FIELD_OF_VIEW.settled:
                    break
        except InputError:
            continue
        if best is None or ball.confidence > best[0]:
            best = ball.confidence, tried.fov
        if ball.confidence > FIELD_OF_VIEW.certain:
            break
    if best is None:
        raise InputError(
            "neither rig.toml nor the photo's EXIF gives the field of view, and no mirror ball was "
            "found to measure it by: set [camera] fov in rig.toml"
        )
    return best[1]


def _fov_by(ball: Ball, rig: Rig) -> float:
    """The field of view, degrees, in which that ball in the photo has the rig's radius."""
    tangent = math.tan(math.radians(rig.fov) / 2) * rig.ball_radius / ball.radius_m
    return fov_of(tangent)


def _score_measured(view: View, rig: Rig, circle: Array, blur: int) -> float:
    """The score of a circle, with the reflectance that its image shows."""
    return _score(view, _with_reflectance(view, rig, circle, blur)[0], circle, 64, blur)[0]


def _climb_measured(
    view: View, rig: Rig, circle: Array, reach: float, blur: int, evaluations: int
) -> Array:
    """A better circle nearby, with the reflectance that the first one's image shows."""
    mirror, _ = _with_reflectance(view, rig, circle, blur)
    return _climb(view, mirror, circle, reach, blur, evaluations)


def _search(
    photo: Photo, rig: Rig, count: int = BALL_SEARCH.candidates
) -> tuple[View, list[Array]]:
    """The view of the search, and up to ``count`` circles in it that may be the ball's, the
    likeliest first."""
    size = (photo.height, photo.width)
    expected = make_ball(rig, rig.ball_centre, rig.ball_radius, size)
    if expected.radius < BALL_SEARCH.least_radius:
        raise InputError(
            f"the ball should be {expected.radius:.1f} pixels in radius by the rig, too small to "
            "read: take a larger photo or check rig.toml"
        )
    middle = np.asarray(expected.centre)
    if not ((middle >= 0) & (middle <= size[::-1])).all():  # also where it is no number
        raise InputError("the rig puts the ball outside the photo: check its lengths and its tilt")
    reach = (BALL_SEARCH.reach + BALL_SEARCH.view_margin) * expected.radius
    view = view_around(photo, middle, reach, expected.radius / BALL_SEARCH.view_radius)
    candidates = sorted(
        _coarse(view, rig, expected), key=lambda c: -_score_measured(view, rig, c, 2)
    )
    climbed = [_climb_measured(view, rig, c, *BALL_SEARCH.climb_first) for c in candidates[:count]]
    if not climbed:
        raise InputError("no mirror ball found: the photo shows nothing where the rig puts it")
    return view, sorted(climbed, key=lambda c: -_score_measured(view, rig, c, 1))


def measure_reflectance(photo: Photo, rig: Rig, ball: Ball) -> Ball:
    """The ball with its mirror's reflectance and that logarithm's standard deviation, by the table
    seen in it against the table seen directly; without, where the photo shows too little of it.

    What is left of a tone curve changes that logarithm as it changes any."""
    reach = (BALL_SEARCH.reach + BALL_SEARCH.view_margin) * ball.radius
    view = view_around(photo, np.asarray(ball.centre), reach, ball.radius / BALL_SEARCH.view_radius)
    circle = np.array([*ball.position[:2], ball.radius_m])
    reflectance, deviation = _measured_reflectance(view, rig, circle)
    if reflectance is None:
        return ball
    by_curve = curve_exponent(photo) * float(np.log(reflectance).mean())
    deviation = math.hypot(deviation, by_curve)
    return replace(ball, reflectance=reflectance, reflectance_deviation=deviation)


def _with_reflectance(view: View, rig: Rig, circle: Array, blur: int = 0) -> tuple[Rig, float]:
    """The rig with the reflectance that the ball's image shows, where that contradicts the rig's;
    and the expected error of its logarithm."""
    measured, deviation = _measured_reflectance(view, rig, circle, blur)
    if measured is None or agrees(rig.ball_reflectance, measured, deviation):
        return rig, RIM_FIT.reflectance_deviation
    return replace(rig, ball_reflectance=measured), deviation


def agrees(nominal: Vec3, measured: Vec3, deviation: float) -> bool:
    """Whether a measured reflectance, its logarithm having that deviation, allows the nominal."""
    off = np.abs(np.log(measured) - np.log(nominal)).max()
    allowed = max(MIRRORED_TABLE.contradiction * deviation, MIRRORED_TABLE.least_contradiction)
    return bool(off <= allowed)


def _measured_reflectance(
    view: View, rig: Rig, circle: Array, blur: int = 0
) -> tuple[Vec3 | None, float]:
    """The mirror's reflectance (RGB), limited to what mirrors have, and its logarithm's deviation.

    Each point of the ring gives a ratio of radiances; the middle of their shortest half (of the
    logarithms) is taken, which glare over less than half of the ring does not move.
    """
    seen, table, distance, valid = _table_both_ways(view, rig, circle, blur)
    near, far = MIRRORED_TABLE.measured
    dark = TINY + BALL_VIEW.least_level
    white = MIRRORED_TABLE.unsaturated * view.white
    use = valid & (distance > near) & (distance < far)
    use &= ((np.minimum(seen, table) > dark) & (np.maximum(seen, table) < white)).all(-1)
    if use.sum() < MIRRORED_TABLE.least_share * len(use) / 2:
        return None, math.inf
    ratios = np.sort(np.log(seen[use]) - np.log(table[use]), 0)
    count = len(ratios) // 2
    width = ratios[count:] - ratios[: len(ratios) - count]
    first = np.argmin(width, 0)
    middle = np.array([np.median(ratios[i : i + count, c]) for c, i in enumerate(first)])
    error = float(spread(ratios - middle)) / math.sqrt(MIRRORED_TABLE.independent)
    grey = float(np.clip(middle.mean(), *np.log(MIRRORED_TABLE.reflectances)))
    tint = np.clip(middle - middle.mean(), -MIRRORED_TABLE.tint, MIRRORED_TABLE.tint)
    red, green, blue = np.minimum(np.exp(grey + tint), 1).tolist()
    return (red, green, blue), math.hypot(error, MIRRORED_TABLE.least_deviation)


def _fit(
    photo: Photo, view: View, rig: Rig, circle: Array, thorough: bool, tilt_deviation: float
) -> Ball:
    """The ball near ``circle`` by its rim, with the confidence in it.

    The ball is the one that the untilted camera would see like that.
    """
    size = (photo.height, photo.width)
    found = make_ball(rig, ball_centre(rig, circle), circle[2], size)
    reach = BALL_SEARCH.fit_reach * found.radius
    fine = view_around(
        photo, np.asarray(found.centre), reach, found.radius / BALL_SEARCH.fit_radius
    )
    mirror, deviation = _with_reflectance(view, rig, circle)
    rim = fit_rim(fine, mirror, circle, thorough, tilt_deviation, deviation)
    relative = BALL_SEARCH.radius_error / max(rim.deviation, TINY)
    doubt = BALL_SEARCH.doubt / (1 + relative**2)
    measured, _ = _with_reflectance(
        view, replace(rim.rig, ball_reflectance=rig.ball_reflectance), rim.circle
    )
    confidence = _confidence(view, measured, rim.circle) * (1 - doubt)
    ball = make_ball(rim.rig, ball_centre(rim.rig, rim.circle), rim.circle[2], size)
    if is_whole(size, *ball.centre, ball.radius):
        ball = place_ball(rig, size, *ball.centre, ball.radius)
    return replace(
        ball,
        confidence=confidence,
        camera_tilt=rim.rig.camera_tilt,
        tilt_deviation=rim.tilt_deviation,
    )


def _distance(a: Ball, b: Ball) -> float:
    """How far two balls are apart, of place and radius the larger, in radii."""
    offset = math.dist(a.centre, b.centre)
    return max(offset, abs(a.radius - b.radius)) / b.radius


def _check_exposure(photo: Photo, ball: Ball) -> None:
    (x, y), r = ball.centre, ball.radius * BALL_SEARCH.saturated_disc
    y0, x0 = max(0, int(y - r)), max(0, int(x - r))
    inside = slice(y0, int(y + r) + 1), slice(x0, int(x + r) + 1)
    ys, xs = np.mgrid[inside]
    disc = (xs + 0.5 - x) ** 2 + (ys + 0.5 - y) ** 2 < r * r
    clipped = Photo(photo.image[inside], photo.clip_level).clipped
    disc = disc[: clipped.shape[0], : clipped.shape[1]]
    if disc.any() and clipped[disc].mean() > 0.5:
        raise InputError("the mirror ball is saturated in the photo: expose it shorter")
    if not photo.image[inside].max() > 0:
        raise InputError("the mirror ball is black in the photo: expose it longer")


def _alignment(view: View, curve: Array) -> Array:
    """How much of an edge runs along a curve at each of its points, (n,) in [0, 1].

    It is the share of the structure tensor across the curve; its median trace is added below, so
    that flat and noisy places count little. It does not tell which side is the lighter one.
    """
    h, w = view.tensor.shape[:2]
    inside = np.all((curve >= 0.5) & (curve <= [w - 0.5, h - 0.5]), -1)
    xx, xy, yy = (_look_up(view.tensor[None], 0, curve) * inside[:, None]).T
    nx, ny = normals(curve).T
    across = xx * nx * nx + 2 * xy * nx * ny + yy * ny * ny
    return np.asarray(across / (xx + yy + BALL_SEARCH.noise_traces * view.noise))


def _score(
    view: View, rig: Rig, circle: Array, count: int = 96, blur: int = 0
) -> tuple[float, float, float, float]:
    """Weighted sum of: the horizon's and the outline's share of edge, the mirrored table's fit."""
    h, o = (
        float(_alignment(view, curve(view, rig, circle, count)).mean())
        for curve in (horizon_curve, outline_curve)
    )
    m = _mirrored_table_fit(view, rig, circle, blur)
    return h + BALL_SEARCH.outline_weight * o + BALL_SEARCH.mirror_weight * m, h, o, m


@cache
def _ring(height: float) -> tuple[Array, Array]:
    """Normals (n, 3) of the part of a ball that mirrors the table near it, and for each the blur
    level of a view that fits how much the mirror shrinks the table there.

    height: of the ball's centre above the table, in radii.
    """
    around = MIRRORED_TABLE.around
    sine = np.linspace(*MIRRORED_TABLE.sines)
    beta = np.arcsin(sine)
    # Distance on the table, in radii, for rays from straight above.
    reach = sine + (height + np.cos(beta)) / np.tan(2 * beta - np.pi / 2)
    shrink = np.maximum(-np.gradient(reach, sine), 1)
    level = np.clip(np.log2(shrink), 0, MIRRORED_TABLE.deepest_level)
    psi = np.arange(around) * (2 * np.pi / around)
    normal = np.stack(
        [
            sine[:, None] * np.cos(psi),
            sine[:, None] * np.sin(psi),
            np.broadcast_to(np.cos(beta)[:, None], (len(sine), around)),
        ],
        -1,
    )
    return normal.reshape(-1, 3), np.repeat(np.round(level).astype(int), around)


def _mirrored_table_fit(view: View, rig: Rig, circle: Array, blur: int = 0) -> float:
    """How well the ball's rim shows the table around it, as the same photo shows that, in [0, 1].

    It is 1 less the mean of a truncated square of the difference in log radiance; where the photo
    shows too little of that table, `MIRRORED_TABLE.unknown`.
    """
    difference, valid = _mirror_difference(view, rig, circle, blur)
    if valid.mean() < MIRRORED_TABLE.least_share:
        return MIRRORED_TABLE.unknown
    error = np.abs(difference[valid]).mean(-1)
    return 1 - float(np.minimum(1, (error / MIRRORED_TABLE.tolerance) ** 2).mean())


def _mirror_difference(view: View, rig: Rig, circle: Array, blur: int = 0) -> tuple[Array, Mask]:
    """Differences (n, 3) in log radiance between the ball's rim and the table it mirrors.

    Each point of the ring between horizon and outline mirrors a point of the table; the photo
    there, times the mirror's reflectance, should be the photo here. The mask (n,) says where the
    photo shows that point of the table. Both are blurred by ``blur`` levels more than need be.
    """
    seen, table, _, valid = _table_both_ways(view, rig, circle, blur)
    expected = table * np.asarray(rig.ball_reflectance)
    return np.log(seen + BALL_VIEW.toe) - np.log(expected + BALL_VIEW.toe), valid


def _table_both_ways(
    view: View, rig: Rig, circle: Array, blur: int
) -> tuple[Array, Array, Array, Mask]:
    """Radiance (n, 3) of the ring's points in the ball and of the table that they mirror, that
    table's distance from the ball's centre in radii (n,), and whether the photo shows it."""
    normal, level = _ring(rig.ball_height(1.0))
    level = np.minimum(level + blur, len(BALL_VIEW.blurs) - 1)
    point, rise, at = _mirrored_table(rig, circle, normal)
    distance = np.hypot(*(at[:, :2] - circle[:2]).T) / circle[2]
    place = view.at(at, rig)
    h, w = view.tone.shape[:2]
    valid = (rise < -MIRRORED_TABLE.downward) & (place > 0).all(-1) & (place < [w, h]).all(-1)
    place = np.where(valid[:, None], place, 0)
    table = _look_up(view.levels, level, place)
    seen = _look_up(view.levels, np.full_like(level, blur), view.at(point, rig))
    return seen, table, distance, valid


def _mirrored_table(rig: Rig, circle: Array, normal: Array) -> tuple[Array, Array, Array]:
    """Points (..., 3) of the ball with these normals, the z of the ray that each mirrors, and where
    that meets the table, (..., 3)."""
    point = ball_centre(rig, circle) + circle[2] * normal
    ray = point - rig.camera
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    mirrored = ray - 2 * np.sum(ray * normal, -1, keepdims=True) * normal
    down = np.minimum(mirrored[..., 2:], -MIRRORED_TABLE.least_downward)
    return point, mirrored[..., 2], point - mirrored * (point[..., 2:] / down)


def _look_up(levels: Array, level: Array | int, at: Array) -> Array:
    """Bilinear look-ups (n, 3) in the chosen level at positions (n, 2), the border repeated."""
    h, w = levels.shape[1:3]
    x, y = np.clip(at[:, 0] - 0.5, 0, w - 1 - TINY), np.clip(at[:, 1] - 0.5, 0, h - 1 - TINY)
    i, j = y.astype(int), x.astype(int)
    fy, fx = (y - i)[:, None], (x - j)[:, None]
    top = levels[level, i, j] * (1 - fx) + levels[level, i, j + 1] * fx
    bottom = levels[level, i + 1, j] * (1 - fx) + levels[level, i + 1, j + 1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy)


def _coarse(view: View, rig: Rig, expected: Ball) -> list[Array]:
    """The best few circles, by scoring every second pixel of the view."""
    noise = BALL_SEARCH.noise_traces * view.noise
    trace = view.tensor[..., 0] + view.tensor[..., 2] + noise
    # Every second pixel will do: the curves of a ball of that size are blurred further anyway.
    xx, xy, yy = (
        ndimage.gaussian_filter(view.tensor[..., k] / trace, BALL_SEARCH.coarse_blur)[::2, ::2]
        for k in range(3)
    )
    h, w = xx.shape
    centre = rig.ball_centre
    middle = view.at(centre, rig)
    deviation = BALL_SEARCH.radius_deviation
    margin = int(max(expected.ellipse[2:4]) / view.step / 2 * (1 + deviation)) + 2
    found: list[tuple[float, float, float, float]] = []
    xx, xy, yy = (np.pad(a, margin) for a in (xx, xy, yy))
    count = BALL_SEARCH.coarse_points
    for scale in np.linspace(1 - deviation, 1 + deviation, BALL_SEARCH.coarse_radii):
        circle = np.array([centre[0], centre[1], expected.radius_m * scale])
        total = np.zeros((h, w), np.float32)
        for find, weight in ((horizon_curve, 1.0), (outline_curve, BALL_SEARCH.outline_weight)):
            curve = find(view, rig, circle, count)
            shifts = np.round((curve - middle) / 2).astype(int) + margin
            across = normals(curve).astype(np.float32)
            for (sx, sy), (nx, ny) in zip(shifts, across, strict=True):
                part = slice(sy, sy + h), slice(sx, sx + w)
                total += np.float32(weight / count) * (
                    xx[part] * (nx * nx) + xy[part] * (2 * nx * ny) + yy[part] * (ny * ny)
                )
        peaks = total == ndimage.maximum_filter(total, BALL_SEARCH.peak_window)
        for y, x in np.argwhere(peaks):
            found.append((float(total[y, x]), 2 * x + 0.5, 2 * y + 0.5, circle[2]))
    found.sort(reverse=True)
    reach = BALL_SEARCH.reach * expected.radius / view.step
    far, larger = BALL_SEARCH.distinct
    chosen: list[Array] = []
    places: list[tuple[float, float, float]] = []
    for _, x, y, radius in found:
        if math.hypot(x - middle[0], y - middle[1]) > reach:
            continue
        if any(
            math.hypot(x - a, y - b) < far and abs(radius / c - 1) < larger for a, b, c in places
        ):
            continue
        places.append((x, y, radius))
        pixel = np.array([x, y]) * view.step + view.origin
        height = rig.ball_height(radius)
        at = on_table(rig, view.size, float(pixel[0]), float(pixel[1]), height)
        chosen.append(np.array([at[0], at[1], radius]))
        if len(chosen) == BALL_SEARCH.kept:
            break
    return chosen


def _climb(view: View, rig: Rig, start: Array, reach: float, blur: int, evaluations: int) -> Array:
    """Move a circle to a better score nearby (Nelder–Mead), ``reach`` in radii at first."""
    unit = rig.ball_radius * reach

    def cost(u: Array) -> float:
        circle = start + u * unit
        off = (circle[2] / rig.ball_radius - 1) / BALL_SEARCH.radius_deviation
        score = _score(view, rig, circle, 48, blur)[0]
        beyond = max(0.0, abs(off) - BALL_SEARCH.climb_limit)
        return -score + BALL_SEARCH.climb_prior * off**2 + beyond

    simplex = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) - BALL_SEARCH.climb_start
    step, gain = BALL_SEARCH.climb_precision
    result = optimize.minimize(
        cost, np.zeros(3), method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": step, "fatol": gain, "maxfev": evaluations},
    )  # fmt: skip
    return np.asarray(start + result.x * unit)


def _features(view: View, rig: Rig, circle: Array) -> Array:
    """Six numbers (6,) that distinguish a ball from other round things.

    The shares of edge along horizon and outline; the mirrored table's fit; the offset of that fit
    (a printed ring is as light as the table, a mirror darker by its reflectance); how much more
    edge the outline has than circles outside it; how much better the table fits than at a radius
    that must be wrong.
    """
    _, h, o, m = _score(view, rig, circle)
    difference, valid = _mirror_difference(view, rig, circle)
    known = valid.mean() > MIRRORED_TABLE.least_share
    offset = float(np.median(difference[valid])) if known else 0.0
    beyond = np.mean([_score(view, rig, circle * [1, 1, k])[2] for k in MIRRORED_TABLE.wider])
    wrong = _mirrored_table_fit(view, rig, circle * [1, 1, MIRRORED_TABLE.wrong])
    return np.array([h, o, m, abs(offset), o - beyond, m - wrong])


def _confidence(view: View, rig: Rig, circle: Array) -> float:
    """Probability in [0, 1] that a ball has that circle: logistic regression on `_features`."""
    logit = _features(view, rig, circle) @ MIRRORED_TABLE.weights - MIRRORED_TABLE.bias
    return float(1 / (1 + math.exp(-logit)))
