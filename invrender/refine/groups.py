"""Pixels of like features as groups, the same on every run and every processor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from invrender.types import Array

GROUPING_ROUNDS = 30  # of Lloyd's algorithm, which settles within 20


def group(points: Array, count: int) -> tuple[Array, NDArray[np.intp]]:
    """Centres (groups, features) and each point's group (n,), of points (n, features).

    k-means from no random start: the group that scatters most is cut across its principal axis, at
    its mean, until there are ``count`` (PCA-Part, Su and Dy 2004). Fewer where the points are fewer
    or alike.
    """
    points = points.astype(np.float64)
    label = np.zeros(len(points), np.intp)
    for _ in range(1, count):
        off = points - _means(points, label)[label]
        scatter = np.bincount(label, (off**2).sum(1))
        widest = int(scatter.argmax())
        of = label == widest
        if scatter[widest] <= 1e-9 * of.sum():
            break
        axis = np.linalg.eigh(off[of].T @ off[of])[1][:, -1]
        label[of] = np.where(off[of] @ axis > 0, len(scatter), widest)
    for _ in range(GROUPING_ROUNDS):
        centres = _means(points, label)
        nearest = _nearest(points, centres)
        if (nearest == label).all():
            break
        label = np.unique(nearest, return_inverse=True)[1]
    return _means(points, label), label


def _means(points: Array, label: NDArray[np.intp]) -> Array:
    sums = np.array([np.bincount(label, column) for column in points.T])
    return (sums / np.bincount(label)).T


def _nearest(points: Array, centres: Array) -> NDArray[np.intp]:
    apart = [((points - centre) ** 2).sum(1) for centre in centres]
    return np.argmin(apart, 0)
