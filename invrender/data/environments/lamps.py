"""Lamps on an equirectangular environment, and the colour of their light."""

from __future__ import annotations

from typing import Any

import numpy as np

from invrender.sphere import solid_angles
from invrender.types import Array


def white_balance(kelvin: float) -> Array:
    """Linear RGB (3,) of a black body, mean 1: 2000 K candle, 2800 K bulb, 6500 K day, 12000 K."""
    t = kelvin / 100  # a fit in sRGB, then decoded
    red = 1.0 if t <= 66 else 1.2929 * (t - 60) ** -0.1332
    green = 0.3901 * np.log(t) - 0.6318 if t <= 66 else 1.1299 * (t - 60) ** -0.0755
    blue = 1.0 if t >= 66 else (0.0 if t <= 19 else 0.5432 * np.log(t - 10) - 1.1963)
    rgb = np.clip([red, green, blue], 0.01, 1) ** 2.2
    return (rgb / rgb.mean()).astype(np.float32)


def _axes(centre: Array, roll: float) -> tuple[Array, Array]:
    """Two unit vectors across a direction: level and upright at roll 0."""
    level = np.cross([0.0, 0.0, 1.0], centre)
    if np.linalg.norm(level) < 1e-4:
        level = np.array([1.0, 0.0, 0.0])
    level = level / np.linalg.norm(level)
    upright = np.cross(centre, level)
    c, s = np.cos(roll), np.sin(roll)
    return c * level + s * upright, c * upright - s * level


def add_light(
    env: Array,
    centre: Any,
    size: tuple[float, float],
    radiance: Any,
    disc: bool = False,
    roll: float = 0.0,
    vignette: float = 0.0,
) -> None:
    """Paint a flat lamp onto an environment, in place, keeping its flux however small it is.

    ``centre``: direction; ``size``: half sizes across and upright as tangents of angles;
    ``radiance`` (3,) or a number; ``vignette``: by how much it is darker at its rim.
    """
    height, width = env.shape[:2]
    c = np.asarray(centre, np.float64)
    c = c / np.linalg.norm(c)
    across, upright = _axes(c, roll)
    pixel = np.pi / height
    # Samples on the lamp, at least four to a pixel each way, each with its exact solid angle.
    n = [int(np.clip(np.ceil(8 * np.arctan(s) / pixel), 9, 400)) for s in size]
    a, b = np.meshgrid(*[(np.arange(k) + 0.5) / k * 2 - 1 for k in n], indexing="ij")
    r2 = a * a + b * b
    inside = r2 <= 1 if disc else np.ones_like(r2, bool)
    a, b, r2 = a[inside], b[inside], r2[inside]
    p = c + (a * size[0])[:, None] * across + (b * size[1])[:, None] * upright
    length = np.linalg.norm(p, axis=1)
    area = np.pi * size[0] * size[1] if disc else 4 * size[0] * size[1]
    omega = area / len(a) / length**3 * (1 - vignette * np.minimum(r2, 1))
    p /= length[:, None]
    # Shared between the four nearest pixels, in angle.
    x = np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) * width - 0.5
    y = np.arccos(np.clip(p[:, 2], -1, 1)) / pixel - 0.5
    x0, y0 = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    flux = np.zeros(height * width)
    for dy in (0, 1):
        for dx in (0, 1):
            share = np.abs(1 - dx - (x - x0)) * np.abs(1 - dy - (y - y0))
            row, column = np.clip(y0 + dy, 0, height - 1), (x0 + dx) % width
            flux += np.bincount(row * width + column, omega * share, height * width)
    flux = _even_at_poles(flux.reshape(height, width), solid_angles(height, width))
    env += flux[..., None].astype(np.float32) * np.float32(radiance)


def _even_at_poles(flux: Array, omega: Array) -> Array:
    """From flux to radiance; rows near the poles, narrower than the samples, are smoothed along."""
    height, width = flux.shape
    for row in [*range(min(8, height // 4)), *range(height - min(8, height // 4), height)]:
        if not flux[row].any():
            continue
        sine = np.sin((row + 0.5) / height * np.pi)
        n = int(np.clip(np.ceil(1 / sine), 1, width))
        kernel = np.zeros(width)
        kernel[np.arange(n) - n // 2] = 1 / n
        flux[row] = np.maximum(np.fft.irfft(np.fft.rfft(flux[row]) * np.fft.rfft(kernel), width), 0)
    return flux / omega[:, None]
