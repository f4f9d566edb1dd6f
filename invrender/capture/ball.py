"""Finding the mirror ball in a photo.

A hemisphere on the table has two sharp curves in a photo: its outline, and inside it the image of
the horizon, where the mirror turns from showing the table to showing what is above it. Both are
exact functions of the ball's place on the table and its radius, (x, y, radius) in metres: ``theta``
below. Between the two the ball shows the table around it, which the photo shows as well: this part
of the image can be predicted, and no coin or printed circle passes that test.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from invrender.capture.ball_rim import TILT_PRIOR, fit_rim
from invrender.capture.ball_view import (
    BLURS,
    TOE,
    View,
    horizon_curve,
    normals,
    outline_curve,
    view_around,
)
from invrender.capture.mirror import Ball, is_whole, make_ball, mirror_normals, on_table, place_ball
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array, InputError

__all__ = ["Ball", "find_ball", "make_ball", "mirror_normals", "place_ball"]

RADIUS_PRIOR = 0.10  # how far the ball's radius in pixels may be from what the rig says
MIN_RADIUS = 10.0  # pixels; below this the pattern in the ball cannot be read
SEARCH = 3.0  # how many radii from where the rig puts it the ball is looked for
MIN_CONFIDENCE = 0.5
SURE, LIKELY = 0.7, 0.65  # confidences from which no other place is tried; where two agree
ALIKE = 0.003  # radii between two balls that count as one
MIRROR_WEIGHT = 1.0
OUTLINE_WEIGHT = 0.5  # of the outline beside the horizon: a mirror pales into the table there
UNLEVEL = 0.9  # confidence at most where nothing else tells the camera's tilt
UNSURE = 0.0012  # deviation of the radius, relative, that takes half of `DOUBT` of the confidence
DOUBT = 0.4
FINE = 64  # pixels; the ball's radius in the view of the last fit


def find_ball(
    photo: Photo,
    rig: Rig,
    manual: tuple[float, float, float] | None = None,
    tilt: float = TILT_PRIOR,
) -> Ball:
    """Find the mirror hemisphere in a photo; the rig says how big it is and about where.

    Every place within `SEARCH` radii of the photo's middle is scored by how well the image's edges
    run along the horizon's and the outline's curves there; the best few are refined and the winner
    kept. ``manual`` (x, y, r) in pixels overrides the search. ``tilt``: how sure the camera's is, a
    deviation in degrees. Raises `InputError` where no ball is
    found with a confidence of `MIN_CONFIDENCE`, or where it is cut off, saturated or too small.
    """
    size = (photo.height, photo.width)
    if manual is not None:
        ball = place_ball(rig, size, *manual)
        _check_exposure(photo, ball)
        return ball
    expected = make_ball(rig, rig.ball_centre, rig.ball_radius, size)
    if expected.radius < MIN_RADIUS:
        raise InputError(
            f"the ball should be {expected.radius:.1f} pixels in radius by the rig, too small to "
            "read: take a larger photo or check rig.toml"
        )
    middle = np.asarray(expected.centre)
    if not ((middle >= 0) & (middle <= size[::-1])).all():  # also where it is no number
        raise InputError("the rig puts the ball outside the photo: check its lengths and its tilt")
    view = view_around(photo, middle, (SEARCH + 1.5) * expected.radius, expected.radius / 48)
    starts = []
    likely = sorted(_coarse(view, rig, expected), key=lambda t: -_score(view, rig, t, 64, 2)[0])
    for start in likely[:3]:
        theta = _climb(view, rig, start, 2, 0.08, 25)
        starts.append((_score(view, rig, theta, 64, 1)[0], theta))
    if not starts:
        raise InputError("no mirror ball found: the photo shows nothing where the rig puts it")
    starts.sort(key=lambda pair: -pair[0])

    def finer(theta: Array) -> Array:
        return _climb(view, rig, _climb(view, rig, theta, 1, 0.04, 40), 0, 0.02, 40)

    def places() -> Iterator[Array]:
        best = finer(starts[0][1])
        yield best
        # The others serve only where the best one leaves doubt.
        yield best * [1, 1, 0.93]
        for _, other in starts[1:2]:
            yield finer(other)
        yield best * [1, 1, 1.07]

    balls: list[Ball] = []
    for theta in places():
        found = _settle(photo, view, rig, theta, bool(balls), tilt)
        alike = any(_distance(found, other) < ALIKE for other in balls)
        balls.append(found)
        if found.confidence > (LIKELY if alike else SURE):
            break
    ball = max(balls, key=lambda b: b.confidence)
    if tilt > TILT_PRIOR:
        ball = replace(ball, confidence=min(ball.confidence, UNLEVEL))
    (x, y), r = ball.centre, ball.radius
    if ball.confidence < MIN_CONFIDENCE:
        raise InputError(
            f"no mirror ball found (the best place, {x:.0f}, {y:.0f} with a radius of {r:.0f} "
            f"pixels, has a confidence of {ball.confidence:.2f}): give it by hand as x, y, radius"
        )
    if not is_whole(size, x, y, r):
        raise InputError(f"the mirror ball at {x:.0f}, {y:.0f} is cut off by the edge of the photo")
    _check_exposure(photo, ball)
    return ball


def _settle(photo: Photo, view: View, rig: Rig, theta: Array, thorough: bool, tilt: float) -> Ball:
    """The ball near ``theta`` by its rim, with the confidence in it.

    The ball is the one that the untilted camera would see like that.
    """
    size = (photo.height, photo.width)
    found = make_ball(rig, np.array([theta[0], theta[1], 0.0]), theta[2], size)
    fine = view_around(photo, np.asarray(found.centre), 3.3 * found.radius, found.radius / FINE)
    rim = fit_rim(fine, rig, theta, thorough, tilt)
    doubt = DOUBT / (1 + (UNSURE / max(rim.deviation, 1e-9)) ** 2)
    confidence = _confidence(view, rim.rig, rim.theta) * (1 - doubt)
    ball = make_ball(rim.rig, np.array([*rim.theta[:2], 0.0]), rim.theta[2], size)
    if is_whole(size, *ball.centre, ball.radius):
        ball = place_ball(rig, size, *ball.centre, ball.radius)
    return replace(ball, confidence=confidence, camera_tilt=rim.rig.camera_tilt)


def _distance(a: Ball, b: Ball) -> float:
    """How far two balls are apart, of place and radius the larger, in radii."""
    offset = math.dist(a.centre, b.centre)
    return max(offset, abs(a.radius - b.radius)) / b.radius


def _check_exposure(photo: Photo, ball: Ball) -> None:
    (x, y), r = ball.centre, ball.radius * 0.7
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

    The share of the structure tensor across the curve, with the usual trace added below so that
    flat and noisy places count little. Blind to which side is the lighter one.
    """
    h, w = view.tensor.shape[:2]
    inside = np.all((curve >= 0.5) & (curve <= [w - 0.5, h - 0.5]), -1)
    xx, xy, yy = (_look(view.tensor[None], 0, curve) * inside[:, None]).T
    nx, ny = normals(curve).T
    across = xx * nx * nx + 2 * xy * nx * ny + yy * ny * ny
    return np.asarray(across / (xx + yy + 3 * view.noise))


def _score(
    view: View, rig: Rig, theta: Array, count: int = 96, blur: int = 0
) -> tuple[float, float, float, float]:
    """Weighted sum of: the horizon's and the outline's share of edge, the mirrored table's fit."""
    h, o = (
        float(_alignment(view, curve(view, rig, theta, count)).mean())
        for curve in (horizon_curve, outline_curve)
    )
    m = _mirrored(view, rig, theta, blur)
    return h + OUTLINE_WEIGHT * o + MIRROR_WEIGHT * m, h, o, m


def _ring() -> tuple[Array, Array]:
    """Normals (n, 3) of the part of a ball that mirrors the table near it, and for each the blur
    level of `BLURS` that fits how much the mirror shrinks the table there."""
    sine = np.linspace(0.80, 0.99, 14)
    beta = np.arcsin(sine)
    reach = sine + np.cos(beta) / np.tan(2 * beta - np.pi / 2)  # distance on the table, in radii
    shrink = np.maximum(-np.gradient(reach, sine), 1)
    level = np.clip(np.log2(shrink), 0, 3)
    psi = np.arange(72) * (2 * np.pi / 72)
    normal = np.stack(
        [
            sine[:, None] * np.cos(psi),
            sine[:, None] * np.sin(psi),
            np.broadcast_to(np.cos(beta)[:, None], (14, 72)),
        ],
        -1,
    )
    return normal.reshape(-1, 3), np.repeat(np.round(level).astype(int), 72)


def _mirrored(view: View, rig: Rig, theta: Array, blur: int = 0) -> float:
    """How well the ball's rim shows the table around it, as the same photo shows that, in [0, 1].

    1 - mean of a truncated square of the difference in log radiance; 0.5 if the photo shows nothing
    of that table.
    """
    difference, valid = _mirror_difference(view, rig, theta, blur)
    if valid.mean() < 0.25:
        return 0.5
    error = np.abs(difference[valid]).mean(-1)
    return 1 - float(np.minimum(1, (error / 0.4) ** 2).mean())


def _mirror_difference(
    view: View, rig: Rig, theta: Array, blur: int = 0
) -> tuple[Array, NDArray[np.bool_]]:
    """Differences (n, 3) in log radiance between the ball's rim and the table it mirrors.

    Each point of the ring between horizon and outline mirrors a point of the table; the photo
    there, times the mirror's reflectance, should be the photo here. The mask (n,) says where the
    photo shows that point of the table. Both are blurred by ``blur`` levels more than need be.
    """
    normal, level = _RING
    level = np.minimum(level + blur, len(BLURS) - 1)
    point, rise, at = _mirrored_table(rig, theta, normal)
    table = view.at(at, rig)
    h, w = view.tone.shape[:2]
    valid = (rise < -0.05) & (table > 0).all(-1) & (table < [w, h]).all(-1)
    table = np.where(valid[:, None], table, 0)
    expected = _look(view.levels, level, table) * np.asarray(rig.ball_reflectance)
    seen = _look(view.levels, np.full_like(level, blur), view.at(point, rig))
    return np.log(seen + TOE) - np.log(expected + TOE), valid


def _mirrored_table(rig: Rig, theta: Array, normal: Array) -> tuple[Array, Array, Array]:
    """Points (..., 3) of the ball with these normals, the z of the ray that each mirrors, and where
    that meets the table, (..., 3)."""
    point = np.array([theta[0], theta[1], 0.0]) + theta[2] * normal
    ray = point - rig.camera
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    mirrored = ray - 2 * np.sum(ray * normal, -1, keepdims=True) * normal
    down = np.minimum(mirrored[..., 2:], -0.02)
    return point, mirrored[..., 2], point - mirrored * (point[..., 2:] / down)


def _look(levels: Array, level: Array | int, at: Array) -> Array:
    """Bilinear look-ups (n, 3) in the chosen level at positions (n, 2), the border repeated."""
    h, w = levels.shape[1:3]
    x, y = np.clip(at[:, 0] - 0.5, 0, w - 1.001), np.clip(at[:, 1] - 0.5, 0, h - 1.001)
    i, j = y.astype(int), x.astype(int)
    fy, fx = (y - i)[:, None], (x - j)[:, None]
    top = levels[level, i, j] * (1 - fx) + levels[level, i, j + 1] * fx
    bottom = levels[level, i + 1, j] * (1 - fx) + levels[level, i + 1, j + 1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy)


def _coarse(view: View, rig: Rig, expected: Ball, keep: int = 8) -> list[Array]:
    """The best few (x, y, radius) on the table, by scoring every pixel of the view."""
    trace = view.tensor[..., 0] + view.tensor[..., 2] + 3 * view.noise
    # Every second pixel will do: the curves of a ball of 48 pixels are that blurred anyway.
    xx, xy, yy = (
        ndimage.gaussian_filter(view.tensor[..., k] / trace, 1.5)[::2, ::2] for k in range(3)
    )
    h, w = xx.shape
    centre = rig.ball_centre
    middle = view.at(centre, rig)
    margin = int(max(expected.ellipse[2:4]) / view.step / 2 * (1 + RADIUS_PRIOR)) + 2
    found: list[tuple[float, float, float, float]] = []
    xx, xy, yy = (np.pad(a, margin) for a in (xx, xy, yy))
    for scale in np.linspace(1 - RADIUS_PRIOR, 1 + RADIUS_PRIOR, 6):
        theta = np.array([centre[0], centre[1], expected.radius_m * scale])
        total = np.zeros((h, w), np.float32)
        for find, weight in ((horizon_curve, 1.0), (outline_curve, OUTLINE_WEIGHT)):
            curve = find(view, rig, theta, 48)
            shifts = np.round((curve - middle) / 2).astype(int) + margin
            across = normals(curve).astype(np.float32)
            for (sx, sy), (nx, ny) in zip(shifts, across, strict=True):
                part = slice(sy, sy + h), slice(sx, sx + w)
                total += np.float32(weight / 48) * (
                    xx[part] * (nx * nx) + xy[part] * (2 * nx * ny) + yy[part] * (ny * ny)
                )
        peaks = total == ndimage.maximum_filter(total, 5)
        for y, x in np.argwhere(peaks):
            found.append((float(total[y, x]), 2 * x + 0.5, 2 * y + 0.5, theta[2]))
    found.sort(reverse=True)
    reach = SEARCH * expected.radius / view.step
    chosen: list[Array] = []
    places: list[tuple[float, float, float]] = []
    for _, x, y, radius in found:
        if math.hypot(x - middle[0], y - middle[1]) > reach:
            continue
        if any(math.hypot(x - a, y - b) < 6 and abs(radius / c - 1) < 0.05 for a, b, c in places):
            continue
        places.append((x, y, radius))
        pixel = np.array([x, y]) * view.step + view.origin
        at = on_table(rig, view.size, float(pixel[0]), float(pixel[1]))
        chosen.append(np.array([at[0], at[1], radius]))
        if len(chosen) == keep:
            break
    return chosen


def _climb(view: View, rig: Rig, start: Array, blur: int, reach: float, evaluations: int) -> Array:
    """Move (x, y, radius) to a better score nearby (Nelder–Mead), ``reach`` in radii at first."""
    unit = rig.ball_radius * reach

    def cost(u: Array) -> float:
        theta = start + u * unit
        off = (theta[2] / rig.ball_radius - 1) / RADIUS_PRIOR
        return -_score(view, rig, theta, 48, blur)[0] + 0.05 * off**2 + max(0.0, abs(off) - 1.5)

    simplex = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) - 0.25
    result = optimize.minimize(
        cost, np.zeros(3), method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "maxfev": evaluations},
    )  # fmt: skip
    return np.asarray(start + result.x * unit)


def _features(view: View, rig: Rig, theta: Array) -> Array:
    """Six numbers (6,) that tell a ball from other round things.

    The shares of edge along horizon and outline; the mirrored table's fit; the offset of that fit
    (a printed ring is as light as the table, a mirror darker by its reflectance); how much more
    edge the outline has than circles outside it; how much better the table fits than at a radius
    that must be wrong.
    """
    _, h, o, m = _score(view, rig, theta)
    difference, valid = _mirror_difference(view, rig, theta)
    offset = float(np.median(difference[valid])) if valid.mean() > 0.25 else 0.0
    beyond = np.mean([_score(view, rig, theta * [1, 1, k])[2] for k in (1.12, 1.2, 1.28)])
    wrong = _mirrored(view, rig, theta * [1, 1, 1.3])
    return np.array([h, o, m, abs(offset), o - beyond, m - wrong])


def _confidence(view: View, rig: Rig, theta: Array) -> float:
    """Probability in [0, 1] that a ball stands at ``theta``: logistic in `_features`.

    The weights were fitted to simulated photos with and without a ball.
    """
    weights = np.array([2.63, 2.79, 2.76, -9.88, -0.19, 13.73])
    return float(1 / (1 + math.exp(5.72 - _features(view, rig, theta) @ weights)))


_RING = _ring()
