"""The camera's pose from the sample's square in the photo.

A hand holds the camera a few millimetres and degrees off, and the square of the sample is then not
where the rig says. Its four sides are straight lines along which the photo changes; textures
change here and there. So for each side and each line near it, the signed change across is averaged
over pieces of the line, which texture does not survive. The squares of these means, relative to
their medians over all lines, are summed (as a Hough transform does, of gradients). The pose that
explains the four best lines together, under a Gaussian prior, is taken. It has six unknowns and
the lines give eight numbers, so that what is left over shows whether they belong together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from invrender.capture.ball_image import sample_image
from invrender.capture.ball_view import View, view_around
from invrender.capture.settings import CROPPING, RIM_FIT, SQUARE_FIT
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sampling import parabola_top
from invrender.types import Array, InputError, Mask


def is_whole(photo: Photo) -> bool:
    """Whether a photo has a shape as cameras make it, so that it was not cropped."""
    ratio = max(photo.width, photo.height) / min(photo.width, photo.height)
    return bool(np.abs(np.log(np.array(CROPPING.ratios) / ratio)).min() <= CROPPING.tolerance)


def find_camera(photo: Photo, rig: Rig) -> tuple[Rig, float]:
    """The rig with its camera where the photo's square of the sample says; and the expected error
    of the camera's tilt, in degrees.

    The rig stays as it is where its own square is as clear in the photo, or none is near.
    """
    try:
        pose = _find(photo, rig)
    except InputError:  # a camera that no rig may have
        pose = None
    if pose is None:
        return rig, SQUARE_FIT.unseen_tilt
    at = [corners(photo, r) for r in (rig, _posed(rig, pose))]
    moved = np.linalg.norm(at[1] - at[0], axis=-1).mean()
    if moved > SQUARE_FIT.least_move * np.linalg.norm(at[0][1] - at[0][0]):
        return _posed(rig, pose), SQUARE_FIT.found_tilt
    return rig, RIM_FIT.tilt_deviation


def _find(photo: Photo, rig: Rig) -> Array | None:
    """The camera's pose, in deviations of the prior; None where no square is clear."""
    if not _in_photo(photo, corners(photo, rig)):
        return None
    views = [_view(photo, rig, pixels) for pixels, *_ in SQUARE_FIT.passes]
    nominal = _sides(views[-1], rig)
    pose: Array = np.zeros(6)
    if np.all(nominal.median > SQUARE_FIT.nominal) and nominal.clear():
        return pose  # all four: no need to look elsewhere
    far = _elsewhere(photo, rig)
    if far is not None:
        return far
    border = _border(views, rig, np.zeros(6), SQUARE_FIT.passes[0][1])
    if border is not None:
        # Bricks have borders of their own, a little inside.
        clearer = np.log(_sides(views[-1], _posed(rig, border)).on / nominal.on).sum()
        seen = np.all(nominal.median > SQUARE_FIT.nominal)
        return pose if seen and clearer < SQUARE_FIT.clearer else border
    misfit = 0.0
    passes = zip(views, SQUARE_FIT.passes, strict=True)
    for view, (_, reach, turns, askew, step, *deviations) in passes:
        for _ in range(turns):
            if not _inside(view, _ends(view, _posed(rig, pose))):
                return None
            pose, misfit = _improve(view, rig, pose, reach, askew, step, np.tile(deviations, 4))
    found = _sides(view, _posed(rig, pose))
    likely = (
        misfit <= SQUARE_FIT.greatest_misfit
        and pose @ pose <= SQUARE_FIT.greatest_pose
        and found.clear()
    )
    # The nominal square stays unless another is much clearer: a sample may have lines of its own.
    better = np.log(found.on / nominal.on).sum() > SQUARE_FIT.better
    if np.sum(nominal.median > SQUARE_FIT.nominal) >= 3 and not (likely and better):
        return np.zeros(6)
    if not likely:
        return None
    for _ in range(2):
        wanted, deviation, _ = _outermost(view, _ends(view, _posed(rig, pose)))
        pose = pose + _solve(_slopes(view, rig, pose), pose, wanted, deviation)
    return pose


def _elsewhere(photo: Photo, rig: Rig) -> Array | None:
    """The camera's pose by a square far from the rig's own; None where none is clear."""
    start = _far_start(photo, rig)
    if start is None:
        return None
    views = [_view(photo, _posed(rig, start), pixels) for pixels, *_ in SQUARE_FIT.passes]
    for reach in SQUARE_FIT.far_reaches:
        border = _border(views, rig, start, reach)
        if border is not None:
            return border
    # Some sides may be hardly another tone than the table.
    ends = _ends(views[0], _posed(rig, start))
    if not _inside(views[0], ends):
        return None
    near = SQUARE_FIT.passes[0][0] * SQUARE_FIT.far_reaches[0]
    return start if _outermost(views[0], ends, near)[2].sum() >= 2 else None


def _far_start(photo: Photo, rig: Rig) -> Array | None:
    """A pose near that whose square is clear in the photo, far from the rig's own; None where there
    is none."""
    at = corners(photo, rig)
    side = float(np.linalg.norm(at[1] - at[0]))
    reach = np.abs(at - at.mean(0)).max() + SQUARE_FIT.far * side
    view = view_around(photo, at.mean(0), reach, side / SQUARE_FIT.far_pixels)
    square = _clearest(view, _ends(view, rig))
    if square is None:
        return None
    moved = np.linalg.norm((square - _ends(view, rig)).mean((0, 1)))
    if moved < SQUARE_FIT.far_off * SQUARE_FIT.far_pixels:
        return None
    pose, deviation = np.zeros(6), np.full(8, SQUARE_FIT.far_deviation)
    for _ in range(2):
        wanted = _moved(_ends(view, _posed(rig, pose)), square)
        pose = pose + _solve(_slopes(view, rig, pose), pose, wanted, deviation)
    return pose if pose @ pose <= SQUARE_FIT.greatest_pose * SQUARE_FIT.surely else None


def _clearest(view: View, ends: Array) -> Array | None:
    """The clearest square like that whose sides end at ``ends`` (4, 2, 2), scaled, turned and
    anywhere in the view; None where none is clear.

    It is as clear as the share of a side's points where the photo changes exceeds that of the
    points beside it, outside, and on its line beyond the corners; the mean over the sides.
    """
    slopes = [
        ndimage.gaussian_gradient_magnitude(tone, SQUARE_FIT.far_blur)
        for tone in np.moveaxis(view.tone, -1, 0)
    ]
    slope = np.linalg.norm(slopes, axis=0)
    times, least = SQUARE_FIT.far_change
    changes = (slope > times * np.median(slope) + least).astype(np.float32)
    near = ndimage.maximum_filter(changes, 3)
    squares, clear = [], []
    for scale, degrees in product(SQUARE_FIT.far_scales, SQUARE_FIT.far_turns):
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()[:2, :2]
        moved = (ends - ends.mean((0, 1))) @ turn.T * scale
        shares = np.zeros(changes.shape)
        for (a, b), outwards in zip(moved, _normals(moved), strict=True):
            lines = [(a + d * outwards, b + d * outwards) for d in SQUARE_FIT.far_beside]
            first, last = (d * (b - a) for d in SQUARE_FIT.far_beyond)
            lines += [(b + first, b + last), (a - first, a - last)]
            none = np.max([_share(changes, *line) for line in lines], 0)
            shares += np.maximum(_share(near, a, b) - none, 0) / 4
        squares.append(moved)
        clear.append(shares)
    best = np.max(clear)
    if best < SQUARE_FIT.far_clear:
        return None
    # Squares of other sizes and turns, and some pixels off, are as clear: their mean.
    alike, *rows = np.nonzero(np.array(clear) > best - SQUARE_FIT.far_alike)
    place = np.stack(rows[::-1], -1) + 0.5
    first = np.unravel_index(np.argmax(clear), np.shape(clear))[:0:-1]
    own = np.linalg.norm(place - first, axis=-1) < SQUARE_FIT.far_near
    return np.asarray(np.mean(np.array(squares)[alike[own]] + place[own][:, None, None], 0))


def _share(changes: Array, a: Array, b: Array) -> Array:
    """The share (H, W) of the points between a and b (2,), from each pixel, that are changes."""
    points = np.rint(np.linspace(a, b, SQUARE_FIT.far_pixels)).astype(int)
    height, width = changes.shape
    r = int(np.abs(points).max())
    around, count = np.pad(changes, r), np.zeros_like(changes)
    for x, y in r + points:
        count += around[y : y + height, x : x + width]
    return count / len(points)


def _border(views: list[View], rig: Rig, pose: Array, reach: float) -> Array | None:
    """The camera's pose from the outermost changes within ``reach`` sides of a pose's square, where
    the table beside it is plain; None where these are no square."""
    seen = np.zeros(4, bool)
    for view, (pixels, *_) in zip(views, SQUARE_FIT.passes, strict=True):
        near = pixels * reach if view is views[0] else None
        for _ in range(2):
            ends = _ends(view, _posed(rig, pose))
            if not _inside(view, ends):
                return None
            wanted, deviation, seen = _outermost(view, ends, near)
            if seen.sum() < 3:
                return None
            near, slopes = None, _slopes(view, rig, pose)
            move, misfit = _fitted(slopes, pose, wanted, deviation)
            if misfit > SQUARE_FIT.greatest_misfit:  # one may be the display's edge
                without = np.repeat(np.where(np.eye(4), SQUARE_FIT.left_out, 1.0), 2, 1)
                move, misfit = min(
                    (_fitted(slopes, pose, wanted, deviation * w) for w in without),
                    key=lambda f: f[1] + float(((pose + f[0]) ** 2).sum()),
                )
            if misfit > SQUARE_FIT.greatest_misfit:
                return None
            pose = pose + move
    clear = _sides(views[-1], _posed(rig, pose)).clear()
    most = SQUARE_FIT.greatest_pose * (SQUARE_FIT.surely if clear and seen.all() else 1)
    return pose if (clear or seen.all()) and pose @ pose <= most else None


def _in_photo(photo: Photo, at: Array) -> bool:
    """Whether a square with those corners is about in the photo, and large enough."""
    size, middle = np.array([photo.width, photo.height]), at.mean(0)
    near = np.all((at > -size) & (at < 2 * size)) and np.all((middle > 0) & (middle < size))
    return bool(near and np.ptp(at, 0).min() > SQUARE_FIT.least_side)


def corners(photo: Photo, rig: Rig) -> Array:
    """The sample's corners in photo pixels, (4, 2), one after another around it."""
    return rig.project(rig.sample_corners, photo.height, photo.width)


def _posed(rig: Rig, pose: Array) -> Rig:
    """The rig with its camera moved: shift and tilt in deviations of the prior."""
    return replace(
        rig,
        camera_shift=tuple(
            np.add(rig.camera_shift, pose[:3] * SQUARE_FIT.shift_deviation * rig.sample_size)
        ),
        camera_tilt=tuple(np.add(rig.camera_tilt, pose[3:] * SQUARE_FIT.tilt_deviation)),
    )


def _view(photo: Photo, rig: Rig, pixels: float) -> View:
    """The photo around where the square may be, a side of it about so many pixels."""
    at = corners(photo, rig)
    side = float(np.linalg.norm(at[1] - at[0]))
    half = np.abs(at - at.mean(0)).max() + SQUARE_FIT.view_margin * SQUARE_FIT.passes[0][1] * side
    return view_around(photo, at.mean(0), half, side / pixels)


def _ends(view: View, rig: Rig) -> Array:
    """The ends of the square's sides in the view, (side, end, 2)."""
    at = view.at(rig.sample_corners, rig)
    return np.stack([at, np.roll(at, -1, 0)], 1)


def _inside(view: View, ends: Array) -> bool:
    shape = view.tone.shape[1::-1]
    return bool(np.isfinite(ends).all() and (ends > 0).all() and (ends < shape).all())


def _improve(
    view: View, rig: Rig, pose: Array, reach: float, askew: float, step: float, deviation: Array
) -> tuple[Array, float]:
    """A better pose, and the squared misfit of its lines."""
    now = _ends(view, _posed(rig, pose))
    length = float(np.linalg.norm(now[:, 1] - now[:, 0], axis=-1).mean())
    best = [_best_lines(view, e, reach * length, askew * length, step) for e in now]
    fours = np.array(list(product(*best)))  # (combination, side, 3)
    wanted, gain = fours[..., :2].reshape(len(fours), 8), fours[..., 2].sum(-1)
    slopes = _slopes(view, rig, pose)
    moves = _solve(slopes, pose, wanted, deviation)
    misfit = (((wanted - moves @ slopes.T) / deviation) ** 2).sum(-1)
    i = np.argmin(misfit / 2 + ((pose + moves) ** 2).sum(-1) / 2 - gain)
    return pose + moves[i], float(misfit[i])


def _slopes(view: View, rig: Rig, pose: Array) -> Array:
    """By what a pose moves the sides' places and slopes, (8, 6)."""
    now = _ends(view, _posed(rig, pose))

    def lines(pose: Array) -> Array:
        return _moved(now, _ends(view, _posed(rig, pose)))

    step = SQUARE_FIT.slope_step
    return np.stack(
        [(lines(pose + u) - lines(pose - u)) / (2 * step) for u in step * np.eye(6)], -1
    )


def _moved(now: Array, then: Array) -> Array:
    """How far sides (4, 2, 2) have moved across: the mean of each one's ends and the difference,
    (8,)."""
    off = ((then - now) * _normals(now)[:, None]).sum(-1)
    return np.stack([off.mean(1), off[:, 1] - off[:, 0]], -1).ravel()


def _solve(slopes: Array, pose: Array, wanted: Array, deviation: Array) -> Array:
    """The most probable moves (..., 6) of a pose where places and slopes should move by ``wanted``
    (..., 8)."""
    weight = 1 / deviation**2
    matrix = slopes.T @ (weight[:, None] * slopes) + np.eye(6)
    return np.asarray((wanted @ (weight[:, None] * slopes) - pose) @ np.linalg.inv(matrix))


def _fitted(slopes: Array, pose: Array, wanted: Array, deviation: Array) -> tuple[Array, float]:
    """The most probable move of a pose, and the squared misfit of places and slopes then."""
    move = _solve(slopes, pose, wanted, deviation)
    return move, float((((wanted - slopes @ move) / deviation) ** 2).sum())


def _outermost(view: View, ends: Array, reach: float | None = None) -> tuple[Array, Array, Mask]:
    """Where the sides' outermost changes lie, place and slope, and the deviations of these, (8,);
    and of which sides (4,) most points lie on a line.

    A sample has lines beside its border, a plain table has none: from outside inwards the first
    change that is larger than the table's is the border. A side beside a table that changes as much
    stays. reach: pixels to either side that are searched, those of `SQUARE_FIT.outward` if
    None.
    """
    inwards, outwards, border = SQUARE_FIT.outward
    if reach is not None:
        inwards, outwards, border = -reach, reach + outwards - border, reach
    t = np.arange(inwards, outwards, 0.5)
    outside, near = t >= border, np.flatnonzero(t <= border)
    wanted, lines = np.zeros((4, 2)), np.zeros(4, bool)
    deviation = np.tile(np.array(SQUARE_FIT.passes[-1][-2:]) / 2, (4, 1))
    for k, side in enumerate(ends):
        change, u = _changes(view, side, t, SQUARE_FIT.blur)
        size = np.sqrt((change**2).sum(0))
        table = np.quantile(size[outside], SQUARE_FIT.table_quantile)
        median = np.median(size[near].max(0))
        over = size[near] > max(SQUARE_FIT.table_change * table, SQUARE_FIT.least_change * median)
        some = over.any(0)
        first = len(near) - 1 - np.argmax(over[::-1], 0)
        rows = np.maximum(first - np.arange(SQUARE_FIT.behind)[:, None], 0)  # the peak behind it
        peak = t[first - np.argmax(np.take_along_axis(size, rows, 0), 0)]
        a = np.stack([np.ones_like(u), u - 0.5], -1)[some]
        line = np.array([np.median(peak[some]), 0.0]) if some.any() else np.zeros(2)
        for _ in range(SQUARE_FIT.rounds):
            weight = 1 / (1 + (peak[some] - a @ line) ** 2)
            matrix = a.T @ (weight[:, None] * a) + SQUARE_FIT.ridge * np.eye(2)
            line = np.linalg.solve(matrix, a.T @ (weight * peak[some]))
        on = np.sum(np.abs(peak[some] - a @ line) < 1) > SQUARE_FIT.most * len(u)
        if on and (reach is None or _is_step(change, t, line[0] + line[1] * (u - 0.5))):
            wanted[k], deviation[k], lines[k] = line, SQUARE_FIT.border_deviation, True
    return wanted.ravel(), deviation.ravel(), lines


def _is_step(change: Array, t: Array, at: Array) -> bool:
    """Whether the tone is another one on the two sides of a line, as no joint between tiles has it:
    ``change`` (3, n, points) at distances t (n,), the line's (points,)."""
    tone = np.cumsum(change, 1) * (t[1] - t[0])
    places = at + SQUARE_FIT.beside * np.array([[-1], [1], [3]])
    rows = np.clip(np.searchsorted(t, places), 0, len(t) - 1)
    inside, table, beyond = (tone[:, row, np.arange(len(at))] for row in rows)
    step, even = (np.median(np.linalg.norm(d, axis=0)) for d in (inside - table, table - beyond))
    return bool(step > SQUARE_FIT.clear * even)


def _normals(ends: Array) -> Array:
    """Outward unit normals (..., 2) of sides (..., 2, 2)."""
    along = ends[..., 1, :] - ends[..., 0, :]
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    return np.stack([-along[..., 1], along[..., 0]], -1) / length


def _changes(view: View, ends: Array, t: Array, blur: float) -> tuple[Array, Array]:
    """How the tone changes across a side (2, 2) at distances t (n,) from it: (3, n, points); and
    where on the side the points are, from 0 to 1."""
    count, inset = SQUARE_FIT.pieces * SQUARE_FIT.points, SQUARE_FIT.inset
    u = (np.arange(count) + 0.5) / count * (1 - 2 * inset) + inset
    step = t[1] - t[0]
    more = round(3 * blur / step)
    far = np.concatenate(
        [t[0] - step * np.arange(more, 0, -1), t, t[-1] + step * np.arange(1, more + 1)]
    )
    at = (ends[0] + (ends[1] - ends[0]) * u[:, None]) + far[:, None, None] * _normals(ends)
    across = np.ascontiguousarray(np.moveaxis(sample_image(view.tone, at), -1, 0))
    change = ndimage.gaussian_filter1d(across, blur / step, axis=1, order=1)
    return change[:, more : more + len(t)], u


def _even(change: Array) -> Array:
    """Changes such that no single one outweighs the others, in [-1, 1]."""
    times, least = SQUARE_FIT.even
    return change / np.sqrt(change**2 + (times * np.median(np.abs(change)) + least) ** 2)


def _power(change: Array) -> Array:
    """Squares (..., pieces) of the means of changes (3, ..., points) over pieces of the line."""
    count, points = SQUARE_FIT.pieces, SQUARE_FIT.points
    pieces = change.reshape(*change.shape[:-1], count, points) @ np.full(points, 1 / points)
    return np.asarray((pieces**2).sum(0))


@dataclass(frozen=True)
class _Sides:
    """How clear the square's sides are, (4,) each.

    ``on``: the changes on it; ``median``, ``tenth``: over the median and the greatest tenth of
    those beside it; ``most``: the share of its points that change most there. ``wide``: as
    ``tenth``, of changes over a hundredth of the side; ``whole``: the same, of the whole side's
    mean.
    """

    on: Array
    median: Array
    tenth: Array
    most: Array
    wide: Array
    whole: Array

    def clear(self) -> bool:
        """Whether three are lines, or steps, as textures make none."""
        sharp = (self.tenth > SQUARE_FIT.clear) & (self.most > SQUARE_FIT.most)
        step = (self.wide > SQUARE_FIT.clear) & (self.whole > SQUARE_FIT.whole)
        return bool(max(sharp.sum(), step.sum()) >= 3)


def _sides(view: View, rig: Rig) -> _Sides:
    """Next to nothing where the view does not show all of them."""
    ends = _ends(view, rig)
    out = np.full((6, 4), SQUARE_FIT.least_power[0])
    if _inside(view, ends):
        out[:] = np.transpose([_side(view, side) for side in ends])
    return _Sides(*out)


def _side(view: View, side: Array) -> tuple[Any, ...]:
    """The numbers of `_Sides` for one side (2, 2)."""
    tenth, (least_on, least, least_whole) = SQUARE_FIT.tenth, SQUARE_FIT.least_power
    reach, within, beyond = SQUARE_FIT.near
    t = np.arange(-reach, reach + 1) * 0.5
    change, _ = _changes(view, side, t, SQUARE_FIT.blur)
    power = _power(_even(change))
    on = power[np.abs(t) <= within].max(0)
    # The sample may have lines of its own: the greatest changes that count are the table's.
    median = np.quantile(power[np.abs(t) >= beyond], 0.5, axis=0) + least
    levels = median, np.quantile(power[t >= beyond], tenth, axis=0) + least
    most = np.abs(t[np.argmax((change**2).sum(0), 0)]) <= SQUARE_FIT.peak_on
    reach, within, beyond = SQUARE_FIT.wide
    t = np.arange(-reach, reach + 1.0)
    near, far = np.abs(t) <= within, np.abs(t) >= beyond
    length = float(np.linalg.norm(side[1] - side[0]))
    change, _ = _changes(view, side, t, SQUARE_FIT.wide_blur * length)
    power = _power(_even(change))
    wide = np.median(power[near].max(0) / (np.quantile(power[far], tenth, axis=0) + least))
    mean = (change.mean(-1) ** 2).sum(0)
    whole = mean[near].max() / (np.quantile(mean[far], tenth) + least_whole)
    over = (np.median(on / level) for level in levels)
    return np.median(on) + least_on, *over, most.mean(), wide, whole


def _best_lines(view: View, ends: Array, reach: float, askew: float, step: float) -> list[Array]:
    """The `SQUARE_FIT.best` lines near a side (2, 2): place, slope, and how clear each is against
    the median line.

    Place and slope in pixels outwards.
    """
    n, m = round(reach / step), round(askew / step)
    places, slopes = np.arange(-n, n + 1) * step, np.arange(-m, m + 1) * step
    far = n + round(askew / step / 2) + 1
    clear = np.zeros((len(slopes), len(places)))
    length = float(np.linalg.norm(ends[1] - ends[0]))
    for blur in (SQUARE_FIT.blur, SQUARE_FIT.wide_blur * length):
        change, u = _changes(view, ends, np.arange(-far, far + 1) * step, blur)
        first = np.round(slopes[:, None] * (u - 0.5) / step).astype(int) + far - n
        row = first[:, None] + np.arange(2 * n + 1)[:, None]  # (slope, place, point)
        power = _power(_even(change)[:, row, np.arange(len(u))])
        power /= np.median(power, (0, 1)) + SQUARE_FIT.least_power[1]
        clear += np.log1p(power / 3).sum(-1)
    peaks = np.argwhere(clear == ndimage.maximum_filter(clear, 9))
    peaks = peaks[np.argsort(-clear[tuple(peaks.T)])][: SQUARE_FIT.best]
    return [
        np.array([places[j] + step * parabola_top(clear[i], j),
                  slopes[i] + step * parabola_top(clear[:, j], i), clear[i, j]])
        for i, j in peaks
    ]  # fmt: skip
