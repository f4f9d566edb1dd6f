"""Resampling of images: area means to fewer pixels, bilinear to more."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from invrender.types import TINY, Array


def resize(image: Array, height: int, width: int) -> Array:
    """Resize (H, W) or (H, W, C): the mean over each new pixel's area, linear when enlarging."""
    result = np.asarray(image, np.float32)
    for axis, size in enumerate((height, width)):
        if result.shape[axis] != size:
            moved = np.ascontiguousarray(np.swapaxes(result, 0, axis))
            new = resize_weights(moved.shape[0], size) @ moved.reshape(moved.shape[0], -1)
            result = np.swapaxes(new.reshape(size, *moved.shape[1:]), 0, axis)
    return np.ascontiguousarray(result)


def resize_weights(old: int, new: int) -> csr_array:
    """Weights (new, old) of old pixels in new ones. Sparse: no BLAS threads to fight others'."""
    edges = np.linspace(0, old, new + 1)
    if new <= old:
        first = np.floor(edges[:-1]).astype(np.intp)
        column = first[:, None] + np.arange(int(np.ceil(old / new)) + 1)
        overlap = np.minimum(edges[1:, None], column + 1) - np.maximum(edges[:-1, None], column)
        weight = np.maximum(overlap, 0) / (old / new)
        column = np.minimum(column, old - 1)
    else:
        centre = np.clip((edges[:-1] + edges[1:]) / 2 - 0.5, 0, old - 1)
        first = np.minimum(centre.astype(np.intp), max(old - 2, 0))
        column = np.minimum(first[:, None] + np.arange(2), old - 1)
        weight = np.stack([1 - (centre - first), centre - first], -1)
    start = np.arange(new + 1) * column.shape[1]
    values = weight.astype(np.float32).ravel()
    return csr_array((values, column.ravel(), start), shape=(new, old))


def means_of_blocks(image: Array, step: int, dtype: Any = None) -> Array:
    """Means over ``step`` × ``step`` pixels of (H, W, ...); what is left over at the right and the
    lower border is dropped."""
    h, w = (n // step for n in image.shape[:2])
    # Rows first: numpy's mean over two axes apart takes five times as long.
    rows = image[: h * step, : w * step].reshape(h, step, w * step, *image.shape[2:])
    means = rows.mean(1, dtype=dtype).reshape(h, w, step, *image.shape[2:]).mean(2, dtype=dtype)
    return np.asarray(means)


def centres(n: int, of: int) -> NDArray[np.intp]:
    """Which of ``of`` pixels hold the centres of n that span the same length."""
    return ((np.arange(n) + 0.5) / n * of).astype(np.intp)


def resize_pattern(
    pattern: NDArray[Any], size: int, width: int | None = None
) -> NDArray[np.float32]:
    """A pattern (h, w, 3) at (size, width or size, 3): bilinear to more pixels, means over the new
    pixels' areas to fewer."""
    rows, columns = map(_resampling, pattern.shape[:2], (size, width or size))
    out = np.einsum("ir,jc,rcd->ijd", rows, columns, pattern, optimize=True)
    return np.clip(out, 0, 1).astype(np.float32)


@cache
def _resampling(old: int, new: int) -> NDArray[np.float64]:
    """Rows of weights (new, old) along one axis; the border is repeated."""
    weights = np.zeros((new, old))
    if new <= old:  # overlaps of the new pixels with the old ones
        edges = np.arange(new + 1) * (old / new)
        cells = np.arange(old)
        overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
        return np.asarray(np.maximum(overlap, 0) * (new / old))
    place = np.clip((np.arange(new) + 0.5) * old / new - 0.5, 0, old - 1)
    left = np.minimum(place.astype(int), max(old - 2, 0))
    right = np.minimum(left + 1, old - 1)
    np.add.at(weights, (np.arange(new), left), 1 - (place - left))
    np.add.at(weights, (np.arange(new), right), place - left)
    return weights


def knot_shares(x: Array, knots: Array) -> Array:
    """How much of each knot's value a function that is linear between ``knots`` (k,), and constant
    beyond, has at x (...): (..., k)."""
    return np.stack([np.interp(x, knots, row) for row in np.eye(len(knots))], -1)


def parabola_top(values: Array, i: int) -> float:
    """How far beside its greatest value, at ``i``, a parabola through three has its top."""
    if not 0 < i < len(values) - 1:
        return 0.0
    a, b, c = values[i - 1 : i + 2]
    return float(0.5 * (a - c) / min(a - 2 * b + c, -TINY))
