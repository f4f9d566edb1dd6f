"""Colour encodings."""

from __future__ import annotations

import numpy as np

from invrender.types import Array

# Axes of a residual in log RGB: what all channels share, and two of its colour.
AXES = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]).T / np.sqrt([3, 2, 6])


def srgb_to_linear(x: Array) -> Array:
    """IEC 61966-2-1 decoding of values in [0, 1]."""
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(x: Array) -> Array:
    """IEC 61966-2-1 encoding, clipped to [0, 1]."""
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)
