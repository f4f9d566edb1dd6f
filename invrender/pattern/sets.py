"""Sets of patterns, shown one after another: the default one first, which networks know
(docs/research-log/2026-11-29-several-photos.md)."""

from __future__ import annotations

import numpy as np

from invrender.pattern.default import default_pattern
from invrender.types import Array, InputError

DARKEST = 0.02  # of a display's white, with the room's light on its glass
# Of each set, as `invrender.pattern.design.sets.best_set` finds it for the default rig: a shape and
# a direction, in degrees counter-clockwise from +x.
SET_PATTERNS: tuple[tuple[str, float], ...] = (
    ("default", 0), ("default", 180), ("stripes", 0), ("half", 180), ("half", 90),
    ("half", 270), ("default", 90), ("default", 270),
)  # fmt: skip
COUNTS = (2, 3, 5, 8)


def pattern_set(count: int, size: int = 256) -> list[Array]:
    """The set of 2, 3, 5 or 8 patterns, each (size, size, 3) relative radiance, row 0 at +y.

    A smaller set begins a larger one. Raises `InputError` for another number.
    """
    if count not in COUNTS:
        raise InputError(f"sets have {', '.join(map(str, COUNTS))} patterns, not {count}")
    return [_pattern(shape, angle, size) for shape, angle in SET_PATTERNS[:count]]


def _pattern(shape: str, angle: float, size: int) -> Array:
    if shape == "default":
        return np.ascontiguousarray(np.rot90(default_pattern(size), round(angle / 90)))
    return half(size, angle) if shape == "half" else stripes(size, angle, 0)


def half(size: int, angle: float) -> Array:
    """White on the side of the screen that lies in a direction, dark on the other."""
    return _grey(np.clip(_along(size, angle) * size + 0.5, 0, 1))


def gradient(size: int, angle: float) -> Array:
    """Ever brighter in a direction."""
    along = _along(size, angle)
    return _grey((along - along.min()) / (along.max() - along.min()))


def stripes(size: int, angle: float, phase: float) -> Array:
    """One period of a cosine in a direction; the phase in periods."""
    return _grey(0.5 + 0.5 * np.cos(2 * np.pi * (_along(size, angle) - phase)))


def _along(size: int, angle: float) -> Array:
    """Places along a direction, in sides of the screen from its centre, (size, size)."""
    u = (np.arange(size) + 0.5) / size - 0.5
    turn = np.radians(angle)
    return np.asarray(u[None, :] * np.cos(turn) - u[:, None] * np.sin(turn))


def _grey(value: Array) -> Array:
    out = DARKEST + (1 - DARKEST) * value[..., None]
    return np.repeat(out, 3, -1).astype(np.float32)
