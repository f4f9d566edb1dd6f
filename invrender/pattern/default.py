"""The light pattern that the screen shows.

The default is the outcome of `python -m invrender.pattern.design` (docs/explain/pattern.md).
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.files.images import read_image
from invrender.sampling import resize_pattern

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
    """The default pattern, (size, size, 3) relative radiance in [0, 1], row 0 at +y."""
    return resize_pattern(_shipped(), size)


@cache
def _shipped() -> NDArray[np.float32]:
    with resources.as_file(resources.files("invrender") / "pattern" / "default.png") as path:
        pattern = read_image(path)
    pattern.setflags(write=False)
    return pattern


def mirrored(pattern: NDArray[Any]) -> NDArray[Any]:
    """The pattern as the device must display it: who looks at the screen sees it from below."""
    return pattern[:, ::-1]
