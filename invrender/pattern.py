"""The light pattern that the screen shows.

The default is the outcome of `python -m invrender.design`: docs/pattern.md tells how.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.images import read_image

# Red, green, blue and the three pairs, none of them black: every part of the screen gives light.
_PALETTE = np.array(
    [[1, 0.02, 0.02], [0.02, 1, 0.02], [0.02, 0.02, 1], [1, 0.02, 1], [0.02, 1, 1], [1, 1, 0.02]]
)


def block_pattern(size: int = 256, blocks: int = 8, seed: int = 5) -> NDArray[np.float32]:
    """Saturated colour blocks, no two alike side by side: (size, size, 3) relative radiance."""
    rng = np.random.default_rng(seed)
    colour = np.zeros((blocks, blocks), int)
    for i in range(blocks):
        for j in range(blocks):
            taken = {colour[i - 1, j] if i else -1, colour[i, j - 1] if j else -1}
            colour[i, j] = rng.choice([k for k in range(len(_PALETTE)) if k not in taken])
    index = (np.arange(size) * blocks) // size
    return _PALETTE[colour[np.ix_(index, index)]].astype(np.float32)


def default_pattern(size: int = 256) -> NDArray[np.float32]:
    """The pattern that invrender shows unless told otherwise, (size, size, 3) in [0, 1]."""
    return resize_pattern(_shipped(), size)


@cache
def _shipped() -> NDArray[np.float32]:
    with resources.as_file(resources.files("invrender") / "data" / "pattern.png") as path:
        pattern = read_image(path)
    pattern.setflags(write=False)
    return pattern


def resize_pattern(pattern: NDArray[Any], size: int) -> NDArray[np.float32]:
    """A square pattern (P, P, 3) at (size, size, 3): bilinear to more pixels, means over the new
    pixels' areas to fewer."""
    weights = _resampling(len(pattern), size)
    out = np.einsum("ir,jc,rcd->ijd", weights, weights, pattern, optimize=True)
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


def mirrored(pattern: NDArray[Any]) -> NDArray[Any]:
    """The pattern as the device must display it: who looks at the screen sees it from below."""
    return pattern[:, ::-1]
