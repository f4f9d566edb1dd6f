"""Cells, weaves, scratches and small helpers that procedural materials are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.data.materials.noise import (
    Array,
    Canvas,
    Ints,
    Points,
    generator,
    hashed,
    noise,
    warped,
)

__all__ = [
    "WEAVES",
    "Array",
    "Canvas",
    "Cells",
    "Points",
    "bricks",
    "generator",
    "mixed",
    "noise",
    "normals_from_height",
    "ramp",
    "scratches",
    "slopes",
    "smoothstep",
    "voronoi",
    "warped",
    "weave",
]

_TABLE = 4096

# --- cells --------------------------------------------------------------------------------------


@dataclass
class Cells:
    """Where a pixel lies in a tiling: a number for its cell, and distances in units of length.

    ``inside``: distance to the cell's border; ``x``, ``y``: position relative to its centre.
    """

    number: Ints
    inside: Array
    x: Array
    y: Array

    def values(self, rng: np.random.Generator, *shape: int) -> Array:
        """A uniform random number in [0, 1) (or an array of them) for each cell."""
        return generator(rng).random((_TABLE, *shape), dtype=np.float32)[self.number]


def voronoi(
    canvas: Canvas,
    rng: np.random.Generator,
    frequency: float,
    jitter: float = 1.0,
    hexagonal: bool = False,
    at: Points | None = None,
) -> Cells:
    """Voronoi cells of a jittered lattice; jitter 0 and ``hexagonal`` give honeycombs."""
    seed = int(rng.integers(0, 2**63))
    u, v = at or canvas.points
    stretch = np.float32(2 / np.sqrt(3) if hexagonal else 1.0)
    x, y = u * np.float32(frequency), v * np.float32(frequency) * stretch
    column, line = np.floor(x), np.floor(y)
    x0, y0 = int(column.min()) - 1, int(line.min()) - 1
    n_y, n_x = int(line.max()) - y0 + 2, int(column.max()) - x0 + 2
    rows, columns = np.arange(n_y) + y0, np.arange(n_x) + x0
    bits = np.stack([hashed(rows, columns, seed + k) for k in range(3)])
    spots = 0.5 + np.float32(jitter) * (bits[:2].astype(np.float32) / np.float32(2**32) - 0.5)
    numbers = (bits[2] % _TABLE).ravel().astype(np.intp)
    spots[0] += columns[None, :]
    if hexagonal:
        spots[0] += (rows[:, None] % 2) / 2 - 0.25
    spots[1] = (spots[1] + rows[:, None]) / stretch
    spot_x, spot_y = spots[0].ravel(), spots[1].ravel()
    y = y / stretch
    home = ((line - y0) * n_x + (column - x0)).astype(np.intp)

    far = np.float32(1e9)
    d1 = np.full(u.shape, far, np.float32)
    d2 = d1.copy()
    i1 = np.zeros(u.shape, np.intp)
    i2 = i1.copy()
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            i = home + (dy * n_x + dx)
            d = (spot_x[i] - x) ** 2 + (spot_y[i] - y) ** 2
            nearest, second = d < d1, d < d2
            i2 = np.where(nearest, i1, np.where(second, i, i2))
            d2 = np.where(nearest, d1, np.where(second, d, d2))
            i1 = np.where(nearest, i, i1)
            d1 = np.where(nearest, d, d1)
    apart = np.hypot(spot_x[i1] - spot_x[i2], spot_y[i1] - spot_y[i2])
    inside = (d2 - d1) / (2 * np.maximum(apart, np.float32(1e-3)))
    unit = np.float32(1 / frequency)
    return Cells(numbers[i1], inside * unit, (x - spot_x[i1]) * unit, (y - spot_y[i1]) * unit)


def bricks(
    rng: np.random.Generator,
    points: Points,
    width: float,
    height: float,
    shift: float = 0.0,
    corner: float = 0.0,
) -> Cells:
    """Rectangles of that size, each row shifted by ``shift`` widths against the one above.

    ``corner`` rounds the corners of the distance ``inside`` (a radius in units of length).
    """
    rng = generator(rng)
    phase = rng.random(2, dtype=np.float32)
    y = points[1] / np.float32(height) + phase[1]
    line = np.floor(y)
    x = points[0] / np.float32(width) + phase[0] + np.float32(shift) * line
    column = np.floor(x)
    x = (x - column - np.float32(0.5)) * np.float32(width)
    y = (y - line - np.float32(0.5)) * np.float32(height)
    to_x = np.float32(width / 2) - np.abs(x)
    to_y = np.float32(height / 2) - np.abs(y)
    inside = np.minimum(to_x, to_y)
    if corner > 0:
        r = np.float32(corner)
        bend = np.hypot(np.maximum(r - to_x, 0), np.maximum(r - to_y, 0))
        inside = np.where(bend > 0, np.minimum(r - bend, inside), inside)
    number = (column.astype(np.int64) * 7919 + line.astype(np.int64) * 104729) % _TABLE
    return Cells(number, inside, x, y)


# --- threads and lines --------------------------------------------------------------------------

# Which of a repeat's crossings show the warp on top.
WEAVES: dict[str, list[str]] = {
    "plain": ["10", "01"],
    "basket": ["1100", "1100", "0011", "0011"],
    "twill": ["1100", "0110", "0011", "1001"],
    "denim": ["1110", "1101", "1011", "0111"],
    "satin": ["11110", "11011", "01111", "11101", "10111"],
    "herringbone": ["11000110", "01101100", "00111001", "10010011"],
}


def weave(
    points: Points, threads: float, kind: str = "plain", gap: float = 0.1
) -> tuple[Array, NDArray[np.bool_], Array, Array]:
    """A woven cloth of so many threads along a length of 1.

    Returns the height (0 in the gaps to 1 on the crowns, for threads of unit thickness), where the
    warp (the threads along v) lies on top, and the numbers of the warp and the weft thread.
    """
    draft = np.array([[c == "1" for c in row] for row in WEAVES[kind]])
    x, y = points[0] * np.float32(threads), points[1] * np.float32(threads)
    i, j = np.floor(x), np.floor(y)
    a, b = x - i - np.float32(0.5), y - j - np.float32(0.5)
    rows, columns = draft.shape
    up = draft[j.astype(np.intp) % rows, i.astype(np.intp) % columns]
    narrow = np.float32(2 / (1 - gap))

    def crown(across: Array, along: Array, run: Array) -> Array:
        round_ = np.sqrt(np.clip(1 - (across * narrow) ** 2, 0, 1))
        return round_ * (
            np.float32(0.55)
            + np.float32(0.45) * np.where(run, np.float32(1), np.cos(np.float32(np.pi) * along))
        )

    # A float over several crossings stays up; it dips where its neighbour along itself goes under.
    jj, ii = j.astype(np.intp), i.astype(np.intp)
    next_j = np.where(b > 0, jj + 1, jj - 1)
    next_i = np.where(a > 0, ii + 1, ii - 1)
    warp_run = draft[next_j % rows, ii % columns]
    weft_run = ~draft[jj % rows, next_i % columns]
    height = np.where(up, crown(a, b, warp_run), crown(b, a, weft_run))
    return height, up, i, j


def scratches(
    canvas: Canvas,
    rng: np.random.Generator,
    count: int,
    width: float = 0.002,
    angle: float | None = None,
    spread: float = 0.1,
) -> Array:
    """Slightly bent scratches, 1 in their middle and 0 elsewhere.

    All at about one ``angle`` in radians, or in all directions. Those thinner than a pixel fade.
    """
    rng = generator(rng)
    result = np.zeros((canvas.height, canvas.width), np.float32)
    for _ in range(count):
        x0, y0, free, length, bend, w, strength = rng.random(7)
        theta = np.float32(free * np.pi if angle is None else angle + spread * (free * 2 - 1))
        w = width * (0.5 + w)
        wide = max(w, 0.6 * canvas.pixel)
        c, s = np.cos(theta), np.sin(theta)
        half = 0.05 + 0.45 * length**2
        # Only the pixels around it: rows and columns of its bounding box.
        margin = 3 * wide + abs(bend) * 0.3 * half
        row = (np.abs(canvas.y - y0) < half * abs(s) + margin).nonzero()[0]
        column = (np.abs(canvas.x - x0) < half * abs(c) + margin).nonzero()[0]
        if not len(row) or not len(column):
            continue
        box = slice(row[0], row[-1] + 1), slice(column[0], column[-1] + 1)
        u = canvas.x[None, box[1]] - np.float32(x0)
        v = canvas.y[box[0], None] - np.float32(y0)
        t = (c * u + s * v) / np.float32(half)
        d = (c * v - s * u) + np.float32((bend - 0.5) * 0.3 * half) * t * t
        fade = np.clip((1 - np.abs(t)) * 4, 0, 1) * np.float32((0.3 + 0.7 * strength) * w / wide)
        line = fade * np.exp(-((d / np.float32(wide)) ** 2))
        result[box] = np.maximum(result[box], line)
    return result


# --- small helpers ------------------------------------------------------------------------------


def smoothstep(low: float, high: float, x: Array) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((x - np.float32(low)) / np.float32(high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mixed(a: Any, b: Any, t: Array) -> Array:
    """a where t is 0, b where it is 1; colours (3,) or (H, W, 3) mix under an (H, W) field."""
    a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
    if a.ndim in (1, 3) or b.ndim in (1, 3):
        t = t[..., None]
    return a + (b - a) * t


def ramp(field: Array, colours: Array) -> Array:
    """Colours (n, 3) along a field in [0, 1], linearly between, (H, W, 3)."""
    stops = np.linspace(0, 1, len(colours))
    return np.stack([np.interp(field, stops, colours[:, i]) for i in range(3)], -1).astype(
        np.float32
    )


def slopes(height: Array, pixel: float) -> Points:
    """Slopes of a height field to the right (+x) and up (+y, against the rows)."""
    if min(height.shape) < 2:
        return np.zeros_like(height), np.zeros_like(height)
    rows: Array = np.gradient(height, axis=0)
    columns: Array = np.gradient(height, axis=1)
    return columns / np.float32(pixel), -rows / np.float32(pixel)


def normals_from_height(height: Array, pixel: float) -> Array:
    """Unit normals (H, W, 3), OpenGL (x right, y up), of a height field in units of ``pixel``."""
    x, y = slopes(height, pixel)
    normal = np.stack([-x, -y, np.ones_like(x)], -1)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
