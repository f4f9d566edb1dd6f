"""Seamless maps: each border is covered by the sample's own inside, cut in where it shows least.

Image quilting's minimum error boundary cut [Efros and Freeman 2001] within one texture: along x, a
copy shifted by the best matching offset lies over the strips at both borders, where it is
continuous across them; in each strip the two meet along the path of least difference. Then the same
along y. Whole pixels are taken, all maps alike, so no new material appears but on the few pixels
across a cut, which are blended.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from invrender.maps import Maps
from invrender.sampling import resize
from invrender.types import Array, InputError

STRIP = 0.25  # of the side: where cuts may run
FEATHER = 3.0  # pixels over which a cut is blended


@dataclass(frozen=True)
class Seams:
    """Mean steps across the borders when tiled, over the mean step between neighbours inside:
    ``before`` and ``after``; along the ``cuts``; and the share of pixels that was ``replaced``."""

    before: float
    after: float
    cuts: float
    replaced: float


def make_tileable(maps: Maps) -> tuple[Maps, Seams]:
    """Maps of the same size that tile without a seam, and how well that went.

    Raises `InputError` for maps below 16 pixels a side.
    """
    if min(maps.shape) < 16:
        raise InputError("maps must have 16 pixels a side or more to be made tileable")
    stack = np.concatenate(
        [maps.diffuse, maps.specular, maps.roughness[..., None], maps.normal], -1
    ).astype(np.float32)
    scale = stack.std((0, 1))
    scale = 1 / np.where(scale > 1e-4, scale, np.inf)
    inner = _inner_step(stack, scale)
    along_x, cut_x, from_x = _cover(stack, scale, closed=False)
    turned = np.ascontiguousarray(along_x.swapaxes(0, 1))
    turned, cut_y, from_y = _cover(turned, scale, closed=True)
    result = turned.swapaxes(0, 1)
    replaced = 1 - (1 - from_x) * (1 - from_y.T)
    seams = Seams(
        _border_step(stack, scale) / inner,
        _border_step(result, scale) / inner,
        (cut_x + cut_y) / 2 / inner,
        float(replaced.mean()),
    )
    normal = result[..., 7:] / np.linalg.norm(result[..., 7:], axis=-1, keepdims=True)
    new = Maps(result[..., :3], result[..., 3:6], result[..., 6], normal)
    return Maps(*(np.ascontiguousarray(m) for m in new.__dict__.values())), seams


def _cover(stack: Array, scale: Array, closed: bool) -> tuple[Array, float, Array]:
    """Make the columns periodic; the stack, the mean step across the cuts, the copy's weight.

    closed: the cuts must end in the column where they began, because the rows are periodic.
    """
    height, width, _ = stack.shape
    strip = max(int(width * STRIP), 4)
    other = np.roll(stack, _best_shift(stack * scale, strip), 1)
    x = np.arange(width, dtype=np.float32)
    weight = np.zeros((height, width), np.float32)
    steps = []
    for columns in (slice(0, strip), slice(width - strip, width)):
        left = columns.start == 0
        difference = (((stack[:, columns] - other[:, columns]) * scale) ** 2).sum(-1)
        path = _least_path(difference, closed)
        rows = np.arange(height)
        across = (stack[rows, path + columns.start] - other[rows, path + columns.start]) * scale
        steps.append(np.abs(across).mean())
        distance = x - (path[:, None] + columns.start)
        weight = np.maximum(
            weight, np.clip(0.5 + (-distance if left else distance) / FEATHER, 0, 1)
        )
    # The borders themselves belong to the copy.
    weight[:, [0, -1]] = 1
    mixed = stack.copy()
    for columns in (slice(0, strip), slice(width - strip, width)):
        change = (other[:, columns] - stack[:, columns]) * weight[:, columns, None]
        mixed[:, columns] += change
    return mixed, float(np.mean(steps)), weight


def _best_shift(stack: Array, strip: int) -> int:
    """The shift along columns whose copy differs least from the stack on the border strips.

    All shifts that keep the copy's own border out of the strips, first at an eighth of the pixels.
    """
    height, width, _ = stack.shape
    small = resize(stack, min(height, 64), min(width, 128))
    ratio = width / small.shape[1]

    def cost(image: Array, shift: int, strip: int) -> float:
        other = np.roll(image, shift, 1)
        ends = [image[:, :strip] - other[:, :strip], image[:, -strip:] - other[:, -strip:]]
        return sum(float(np.square(e).sum()) for e in ends)

    coarse = max(int(np.ceil(strip / ratio)), 1)
    shifts = range(coarse, small.shape[1] - coarse + 1)
    best = min(shifts, key=lambda s: cost(small, s, coarse)) * ratio
    rows = stack[:: max(height // 64, 1)]
    around = range(int(best - ratio), int(best + ratio) + 1)
    inside = [s for s in around if strip <= s <= width - strip] or [int(best)]
    return min(inside, key=lambda s: cost(rows, s, strip))


def _least_path(cost: Array, closed: bool) -> NDArray[np.intp]:
    """The column of each row on the cheapest path from the first row to the last, by dynamic
    programming; a step goes to one of the three nearest columns. closed: ends where it began."""
    path = _path(cost)
    if closed and abs(path[0] - path[-1]) > 1:
        # The best loop through the place where two turns of the open path would meet.
        twice = _path(np.concatenate([cost, cost]))
        start = int(twice[len(cost)])
        cost = cost.copy()
        cost[[0, -1]] = np.where(np.arange(cost.shape[1]) == start, cost[[0, -1]], 1e9)
        path = _path(cost)
    return path


def _path(cost: Array) -> NDArray[np.intp]:
    height, width = cost.shape
    total = cost[0].astype(np.float64)
    come = np.zeros((height, width), np.int8)
    padded = np.full(width + 2, np.inf)
    for row in range(1, height):
        padded[1:-1] = total
        three = np.stack([padded[:-2], padded[1:-1], padded[2:]])
        come[row] = three.argmin(0) - 1
        total = cost[row] + three.min(0)
    path = np.empty(height, np.intp)
    path[-1] = total.argmin()
    for row in range(height - 1, 0, -1):
        path[row - 1] = path[row] + come[row, path[row]]
    return path


def _border_step(stack: Array, scale: Array) -> float:
    """Mean absolute step between the first and last row and column, in standard deviations."""
    rows, columns = stack[0] - stack[-1], stack[:, 0] - stack[:, -1]
    return float((np.abs(rows * scale).mean() + np.abs(columns * scale).mean()) / 2)


def _inner_step(stack: Array, scale: Array) -> float:
    """Mean absolute step between neighbours; 1 for constant maps, which have none."""
    rows, columns = np.diff(stack, axis=0), np.diff(stack, axis=1)
    mean = float((np.abs(rows * scale).mean() + np.abs(columns * scale).mean()) / 2)
    return mean if mean > 0 else 1.0
