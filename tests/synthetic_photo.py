"""A small analytic photographer: table, mirror hemisphere, screen and sky, traced in numpy.

Independent of the package's own unfolding on purpose: it shares only the rig's numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from invrender.rig import Rig

Shade = Callable[[Any], Any]


def sky(direction: Any) -> Any:
    """Smooth coloured light from above with two soft lamps, (..., 3) to (..., 3)."""
    d = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    base = (
        0.25 + 0.15 * d[..., 2:] + np.stack([0.1 * d[..., 0], 0.05 * d[..., 1], 0 * d[..., 0]], -1)
    )
    for axis, width, colour in (
        ((0.5, 0.6, 0.62), 0.03, (9.0, 8.0, 6.0)),
        ((0.6, -0.5, 0.62), 0.08, (2.0, 2.5, 3.0)),
    ):
        cosine = d @ (np.array(axis) / np.linalg.norm(axis))
        base = base + np.exp((cosine - 1) / width)[..., None] * np.array(colour)
    return base


def grey_table(point: Any) -> Any:
    """A plain table, a little lighter on one side."""
    x, y = np.clip(point[..., 0], -0.3, 0.3), np.clip(point[..., 1], -0.3, 0.3)
    return np.stack([0.30 + 0.4 * x, 0.30 + 0.3 * y, 0.32 - 0.2 * x], -1)


def textured_table(point: Any) -> Any:
    """Planks and speckles: strong edges in one direction, and detail finer than the ball."""
    x, y = point[..., 0], point[..., 1]
    planks = 0.5 + 0.5 * np.sign(np.sin(x * 190))
    grain = 0.5 + 0.5 * np.sin(y * 600 + 3 * np.sin(x * 300)) * np.sin(x * 800)
    value = 0.08 + 0.25 * planks + 0.25 * grain
    return value[..., None] * np.array([1.0, 0.8, 0.6])


def blocks(count: int = 8, size: int = 64, seed: int = 5) -> Any:
    """A pattern of coloured blocks, (size, size, 3)."""
    colours = np.array([[0.04, 0.02, 0.98], [0.04, 0.96, 0.22], [0.75, 0.02, 0.98]])
    chosen = np.random.default_rng(seed).integers(0, 3, (count, count))
    return np.repeat(np.repeat(colours[chosen], size // count, 0), size // count, 1)


def light_from(
    rig: Rig, origin: Any, d: Any, environment: Shade, pattern: Any, gain: Any, falloff: float = 0
) -> Any:
    """Radiance arriving along upward directions: the screen if it is hit, else the sky."""
    out = environment(d)
    if not rig.has_screen:
        return out
    e_x, e_y = rig.screen_edges
    n = np.cross(e_x, e_y)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((rig.screen_corner - origin) @ n) / (d @ n)
        q = origin + t[..., None] * d - rig.screen_corner
        a, b = q @ e_x / (e_x @ e_x), q @ e_y / (e_y @ e_y)
    hit = (t > 0) & (a >= 0) & (a < 1) & (b >= 0) & (b < 1)
    row = ((1 - b[hit]) * pattern.shape[0]).astype(int).clip(0, pattern.shape[0] - 1)
    column = (a[hit] * pattern.shape[1]).astype(int)
    out[hit] = pattern[row, column] * gain
    if falloff:
        out[hit] *= (np.abs(d[hit] @ n) / np.linalg.norm(n))[:, None] ** falloff
    return out


def table_seen(rig: Rig, point: Any, table: Shade, centre: Any) -> Any:
    """The table's radiance with a soft contact shadow around the ball."""
    d2 = ((point[..., :2] - centre[:2]) ** 2).sum(-1) / rig.ball_radius**2
    return table(point) * (1 - 0.45 / np.maximum(d2, 1) ** 1.5)[..., None]


def photograph(
    rig: Rig,
    height: int,
    width: int,
    environment: Shade = sky,
    table: Shade = grey_table,
    pattern: Any = None,
    gain: Any = (2.0, 2.1, 1.9),
    ball: Any = (0.0, 0.0),
    samples: int = 4,
    falloff: float = 0,
) -> Any:
    """Linear photo (H, W, 3). ``ball``: its shift on the table in metres; None leaves it out."""
    pattern = blocks() if pattern is None else pattern
    centre = rig.ball_centre + np.array([*(ball or (0.0, 0.0)), 0.0])

    def shade(pixels: Any, with_ball: bool) -> Any:
        ray = rig.rays(pixels, height, width)
        ground = rig.camera - ray * (rig.camera[2] / ray[..., 2:])
        out = table_seen(rig, ground, table, centre if ball is not None else centre + 1e3)
        if not with_ball:
            return out
        oc = rig.camera - centre
        b = ray @ oc
        disc = b * b - oc @ oc + rig.ball_radius**2
        t = -b - np.sqrt(np.maximum(disc, 0))
        point = rig.camera + t[..., None] * ray
        hit = (disc > 0) & (point[..., 2] > 0)
        p, r = point[hit], ray[hit]
        n = (p - centre) / rig.ball_radius
        m = r - 2 * (r * n).sum(-1, keepdims=True) * n
        up = m[:, 2] > 0
        seen = np.zeros_like(p)
        seen[up] = light_from(rig, p[up], m[up], environment, pattern, np.asarray(gain), falloff)
        down = p[~up] - m[~up] * (p[~up, 2:] / np.minimum(m[~up, 2:], -1e-9))
        seen[~up] = table_seen(rig, down, table, centre)
        out[hit] = seen * np.asarray(rig.ball_reflectance)
        return out

    def block(y0: int, y1: int, x0: int, x1: int, k: int, with_ball: bool) -> Any:
        ys = y0 + (np.arange((y1 - y0) * k) + 0.5) / k
        xs = x0 + (np.arange((x1 - x0) * k) + 0.5) / k
        image = shade(np.stack(np.broadcast_arrays(xs[None, :], ys[:, None]), -1), with_ball)
        return image.reshape(y1 - y0, k, x1 - x0, k, 3).mean((1, 3))

    image = block(0, height, 0, width, 1, False)
    if ball is not None:
        x, y = rig.project(centre, height, width)
        r = rig.focal(width) * rig.ball_radius / rig.screen_height * 2.5 + 3
        y0, y1 = max(0, int(y - r)), min(height, int(y + r))
        x0, x1 = max(0, int(x - r)), min(width, int(x + r))
        if y1 > y0 and x1 > x0:
            image[y0:y1, x0:x1] = block(y0, y1, x0, x1, samples, True)
    return image.astype(np.float32)
