"""Colour encodings: curves between codes and light, primaries, and matrices between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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


# x and y of red, green, blue and white, by the word that colour interop IDs have for them
# (https://github.com/AcademySoftwareFoundation/ColorInterop); the last four: ITU-T H.273.
_D65 = (0.3127, 0.3290)
_ACES = (0.32168, 0.33767)
PRIMARIES = {
    "rec709": (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65),
    "p3d65": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, *_D65),
    "rec2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "adobergb": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65),
    "ap0": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, *_ACES),
    "ap1": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES),
    "470m": (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.310, 0.316),
    "470bg": (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *_D65),
    "smpte170m": (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *_D65),
    "p3dci": (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351),
}
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def to_xyz(chromaticities: Sequence[float]) -> NDArray[np.float64]:
    """Matrix (3, 3) from linear RGB to CIE XYZ, white having Y = 1.

    chromaticities: x and y of red, green, blue and white. Raises `ValueError` where these span no
    colours.
    """
    xy = np.asarray(chromaticities, np.float64).reshape(4, 2)
    with np.errstate(all="ignore"):
        # As a fraction Y need not be above zero: the primaries of XYZ itself have no luminance.
        columns = np.stack([xy[:, 0], xy[:, 1], 1 - xy.sum(1)])
        white = columns[:, 3] / xy[3, 1]
    primaries = columns[:, :3]
    if not (np.all(np.isfinite(white)) and abs(np.linalg.det(primaries)) > 1e-4):
        raise ValueError(f"primaries and white {chromaticities} span no colours")
    return np.asarray(primaries * np.linalg.solve(primaries, white))


def adaptation(white: Array, to: Array) -> NDArray[np.float64]:
    """Bradford's matrix (3, 3) from XYZ seen under one white (XYZ) to XYZ under another."""
    cone, wanted = _BRADFORD @ np.asarray(white), _BRADFORD @ np.asarray(to)
    return np.asarray(np.linalg.inv(_BRADFORD) @ np.diag(wanted / cone) @ _BRADFORD)


def white_xyz(x: float, y: float) -> NDArray[np.float64]:
    """XYZ of a white with the chromaticity x, y, Y = 1."""
    return np.array([x / y, 1.0, (1 - x - y) / y])


def to_rec709(chromaticities: Sequence[float]) -> NDArray[np.float64]:
    """Matrix (3, 3) from linear RGB of these primaries and white to linear Rec. 709.

    White stays white (Bradford). Raises as `to_xyz` does.

    >>> np.round(to_rec709(PRIMARIES["p3d65"]) @ [1, 0, 0], 4)
    array([ 1.2249, -0.0421, -0.0196])
    """
    there = to_xyz(chromaticities)
    adapted = adaptation(white_xyz(*chromaticities[6:8]), white_xyz(*_D65))
    matrix = xyz_to_rec709() @ adapted @ there
    if not np.all(np.abs(matrix) < 100):
        raise ValueError(f"primaries and white {chromaticities} span no colours")
    return np.asarray(matrix)


def xyz_to_rec709() -> NDArray[np.float64]:
    """Matrix (3, 3) from CIE XYZ, whose white is D65, to linear Rec. 709."""
    return np.asarray(np.linalg.inv(to_xyz(PRIMARIES["rec709"])))


def pq_to_linear(x: Array) -> Array:
    """SMPTE ST 2084 decoding of values in [0, 1]; 1 is 203 cd/m², ITU-R BT.2408's white."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = np.clip(np.asarray(x, np.float64), 0, 1) ** (1 / m2)
    nits = 10_000 * (np.maximum(power - c1, 0) / (c2 - c3 * power)) ** (1 / m1)
    return np.asarray(nits / 203, np.float32)


def hlg_to_linear(x: Array) -> Array:
    """Scene light of values in [0, 1], the inverse of ITU-R BT.2100's HLG OETF; 1 is its peak."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    x = np.clip(np.asarray(x, np.float64), 0, 1)
    return np.where(x <= 0.5, x * x / 3, (np.exp((x - c) / a) + b) / 12).astype(np.float32)


def bt709_to_linear(x: Array) -> Array:
    """Scene light of values in [0, 1], the inverse of ITU-R BT.709's OETF."""
    x = np.clip(x, 0, 1)
    return np.where(x < 0.081, x / 4.5, ((x + 0.099) / 1.099) ** (1 / 0.45)).astype(np.float32)
