"""Directions, integrals and resampling of equirectangular environments."""

from __future__ import annotations

from typing import Any

import numpy as np

from invrender.types import Array, InputError


def directions(height: int, width: int, sub: tuple[float, float] = (0.5, 0.5)) -> Array:
    """Unit vectors (H, W, 3) through the pixels; ``sub`` is the (row, column) place in a pixel."""
    theta = (np.arange(height) + sub[0]) / height * np.pi
    phi = (np.arange(width) + sub[1]) / width * 2 * np.pi
    d = np.empty((height, width, 3), np.float32)
    d[..., 0] = np.sin(theta)[:, None] * np.cos(phi)
    d[..., 1] = np.sin(theta)[:, None] * np.sin(phi)
    d[..., 2] = np.cos(theta)[:, None]
    return d


def solid_angles(height: int, width: int) -> Array:
    """Solid angle of the pixels of each row, (H,), in steradian. They add to 4π / W."""
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    return (edges[:-1] - edges[1:]) * (2 * np.pi / width)


def irradiance(env: Array, normal: Any = (0.0, 0.0, 1.0)) -> Array:
    """Irradiance (3,) of a surface with that normal from the sky above the table (z > 0).

    E = ∫ L (n·ω) dω, each pixel's radiance constant and its ∫ ω dω exact, so a constant L gives π·L
    for the normal (0, 0, 1). Pixels are counted whole or not at all at the normal's own horizon.
    """
    height, width = env.shape[:2]
    n = np.asarray(normal, np.float64)
    n = n / np.linalg.norm(n)
    theta = np.minimum(np.linspace(0, np.pi, height + 1), np.pi / 2)
    phi = np.linspace(0, 2 * np.pi, width + 1)
    # ∫ sin²θ dθ and ∫ cosθ sinθ dθ over the rows, ∫ (cosφ, sinφ, 1) dφ over the columns
    flat = np.diff(theta / 2 - np.sin(2 * theta) / 4)
    up = np.diff(np.sin(theta) ** 2 / 2)
    weight = flat[:, None] * (n[0] * np.diff(np.sin(phi)) - n[1] * np.diff(np.cos(phi)))
    weight = weight + up[:, None] * (n[2] * np.diff(phi))
    return np.einsum("hw,hwc->c", np.maximum(weight, 0), env.astype(np.float64))


def scale_environment(env: Array, level: Any) -> Array:
    """Scale an environment so that its irradiance on the table is ``level``.

    ``level``: the mean over RGB that is wanted (colours kept), or an RGB triple (white-balanced).
    Raises `InputError` for an environment that is black above the table.
    """
    now = irradiance(env)
    level = np.asarray(level, np.float64)
    now = now if level.shape == (3,) else now.mean()
    if not np.all(now > 0):
        raise InputError("the environment is black above the table and cannot be scaled")
    return (env * (level / now)).astype(np.float32)


def rotate_environment(env: Array, angle: float) -> Array:
    """Turn the surroundings by ``angle`` radians about z, counter-clockwise seen from above.

    What lay in azimuth φ lies in φ + angle. Parts of a column are shared between two columns, so
    each row's sum stays.
    """
    width = env.shape[1]
    shift = angle / (2 * np.pi) * width
    whole = int(np.floor(shift + 1e-6))
    part = np.float32(max(shift - whole, 0.0))
    turned = np.roll(env, whole, axis=1)
    if part > 1e-5:
        turned = (1 - part) * turned + part * np.roll(env, whole + 1, axis=1)
    return turned.astype(np.float32)


def resample_environment(env: Array, height: int) -> Array:
    """Resample to (height, 2·height, 3), each new pixel the mean over its solid angle.

    The integral over the sphere stays, however small and bright the lamps are.
    """
    if env.shape[:2] == (height, 2 * height):
        return env
    rows = _overlaps(
        np.cos(np.linspace(0, np.pi, env.shape[0] + 1)), np.cos(np.linspace(0, np.pi, height + 1))
    )
    columns = _overlaps(np.linspace(0, 1, env.shape[1] + 1), np.linspace(0, 1, 2 * height + 1))
    half = np.tensordot(rows, env.astype(np.float64), (1, 0))
    return (columns @ half).astype(np.float32)


def mitsuba_rows(env: Array) -> Array:
    """The same bilinear function as Mitsuba's envmap interpolates it, (2·H + 1, W, 3).

    It places row i of R at θ = π·i/(R - 1): with 2·H + 1 rows it has a knot at each of our texel
    centres. Its azimuth runs the other way round a y-up axis.
    """
    h = env.shape[0]
    v = np.clip(np.arange(2 * h + 1) / 2 - 0.5, 0, h - 1)
    low = np.minimum(v.astype(int), max(h - 2, 0))
    f = (v - low)[:, None, None]
    rows = env[low] * (1 - f) + env[np.minimum(low + 1, h - 1)] * f
    return np.ascontiguousarray(rows[:, ::-1], np.float32)


def _overlaps(old: Array, new: Array) -> Array:
    """Weights (n_new, n_old) of the mean over new intervals of a function constant on the old."""
    sign = 1 if old[-1] > old[0] else -1
    old, new = old * sign, new * sign
    low = np.maximum(new[:-1, None], old[None, :-1])
    high = np.minimum(new[1:, None], old[None, 1:])
    return np.maximum(high - low, 0) / np.diff(new)[:, None]


def sky_flux(environment: Array) -> tuple[Array, Array]:
    """Directions (m, 3) above the horizon of an environment's texels (H, 2H, 3), and what each
    sends through an upward face of unit area (m, 3)."""
    height = len(environment)
    half = height // 2
    d = directions(height, 2 * height)[:half].reshape(-1, 3).astype(float)
    weight = np.repeat(solid_angles(height, 2 * height)[:half], 2 * height) * d[:, 2]
    return d, environment[:half].reshape(-1, 3) * weight[:, None]
