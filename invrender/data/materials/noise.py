"""The noise that procedural materials are made of, the same at every resolution.

Every pattern here and in `invrender.data.materials.patterns` is a function of position, evaluated
at the pixel centres of a `Canvas` whose longer side has length 1, from random numbers that do not
depend on the number of pixels: the same seed at twice the resolution gives the same pattern with
finer detail. All fields are (H, W) float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from invrender.types import Array

Ints = NDArray[np.integer[Any]]
Points = tuple[Array, Array]


class Canvas:
    """Pixel centres of an H × W image: ``u`` to the right, ``v`` down, in units of the longer side.

    ``points`` is the pair (u, v) of (H, W) fields, ``pixel`` the size of a pixel.
    """

    def __init__(self, height: int, width: int) -> None:
        self.height, self.width = height, width
        self.scale = max(height, width)
        self.pixel = 1.0 / self.scale
        self.x = ((np.arange(width) + 0.5) / self.scale).astype(np.float32)
        self.y = ((np.arange(height) + 0.5) / self.scale).astype(np.float32)
        self.u: Array = np.broadcast_to(self.x[None, :], (height, width))
        self.v: Array = np.broadcast_to(self.y[:, None], (height, width))

    @property
    def points(self) -> Points:
        """(u, v)."""
        return self.u, self.v

    def turned(self, angle: float) -> Points:
        """The points in axes turned by an angle in radians about the centre."""
        u, v = self.u - 0.5, self.v - 0.5
        c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        return c * u + s * v + np.float32(0.5), c * v - s * u + np.float32(0.5)


def generator(rng: np.random.Generator) -> np.random.Generator:
    """A generator of its own for one pattern, so that how much it draws changes nothing else."""
    return np.random.default_rng(rng.integers(0, 2**63))


# --- noise --------------------------------------------------------------------------------------


def noise(
    canvas: Canvas,
    rng: np.random.Generator,
    frequency: float | tuple[float, float],
    octaves: int = 1,
    gain: float = 0.5,
    ridged: bool = False,
    at: Points | None = None,
) -> Array:
    """Fractal noise of zero mean and about unit variance, (H, W).

    Each octave is white noise on a lattice smoothed by a cubic B-spline, so it has no visible grid.
    ``frequency``: lattice points along a length of 1, or (across, down) for streaks. Octaves finer
    than a pixel are left out. ``ridged`` folds each octave into sharp crests. ``at`` are other
    points (turned or warped) to evaluate it at.
    """
    seed = int(rng.integers(0, 2**63))
    fx, fy = frequency if isinstance(frequency, tuple) else (frequency, frequency)
    # Octaves double in frequency, and a spline on a lattice is one on a lattice twice as fine:
    # so all are added up as coefficients and evaluated once, but ridges octave by octave.
    used = 1
    while used < octaves and max(fx, fy) * 2**used <= canvas.scale:
        used += 1
    power = float(np.sqrt(sum(gain ** (2 * k) for k in range(octaves))))
    place = _Place(canvas, rng.random(2), fx, fy, at)
    coefficients = place.white(seed, 0)
    if not ridged:
        for k in range(1, used):
            coefficients = _refined(coefficients) + place.white(seed, k) * np.float32(gain**k)
        return place.values(coefficients, used - 1) / np.float32(0.479 * power)
    total = np.zeros(canvas.u.shape, np.float32)
    for k in range(used):
        octave = place.values(place.white(seed, k), k) / np.float32(0.479)
        total += np.float32(gain**k) * (np.float32(1.32) - np.float32(1.66) * np.abs(octave))
    return total / np.float32(power)


class _Place:
    """Where the points of a canvas, or others, lie on a lattice and on its refinements."""

    def __init__(self, canvas: Canvas, phase: Array, fx: float, fy: float, at: Points | None):
        self.at, self.scale, self.frequency = at, canvas.scale, max(fx, fy)
        x, y = at or (canvas.x, canvas.y)
        self.x = x * np.float32(fx) + np.float32(phase[0])
        self.y = y * np.float32(fy) + np.float32(phase[1])
        self.left, self.top = int(np.floor(self.x.min())), int(np.floor(self.y.min()))
        self.x -= np.float32(self.left)
        self.y -= np.float32(self.top)
        self.shape = int(self.y.max()) + 4, int(self.x.max()) + 4

    def white(self, seed: int, level: int) -> Array:
        """White noise of unit variance on the lattice refined ``level`` times."""
        rows, columns = ((n - 3) * 2**level + 3 for n in self.shape)
        bits = hashed(
            np.arange(rows) + self.top * 2**level,
            np.arange(columns) + self.left * 2**level,
            seed + level,
        )
        flat = bits.astype(np.float32)
        flat -= np.float32(2.0**31)
        flat *= np.float32(12**0.5 / 2**32)
        return flat

    def values(self, c: Array, level: int) -> Array:
        """Values of the spline with coefficients c, (H, W)."""
        fine = np.float32(2**level)
        if self.at is None:
            row, row_weights = _spline(self.y * fine)
            column, column_weights = _spline(self.x * fine)
            # Four taps an axis. (No matrix product: BLAS threads would fight other workers.)
            half = c[row] * row_weights[0][:, None]
            for k in (1, 2, 3):
                half += c[row + k] * row_weights[k][:, None]
            full = half.take(column, 1) * column_weights[0]
            for k in (1, 2, 3):
                full += half.take(column + k, 1) * column_weights[k]
            return full
        order = 3
        if c.size < 2 * self.at[0].size:  # once or twice refined it is as good as linear
            order = 1
            while self.frequency * fine < self.scale / 2 and c.size < 2 * self.at[0].size:
                c, fine = _refined(c), fine * 2
        where = np.stack([self.y * fine, self.x * fine])
        where += 1
        return map_coordinates(c, where, order=order, prefilter=False, mode="nearest")


def hashed(rows: Ints, columns: Ints, seed: int) -> NDArray[np.uint32]:
    """32 random bits for each lattice point, from its place and not from the lattice's size."""
    key = np.uint32(seed * 2654435761 % 2**32)
    h = (rows.astype(np.uint32) * np.uint32(0x9E3779B1) ^ key)[:, None] * np.uint32(0x85EBCA6B)
    h = h + (columns.astype(np.uint32) * np.uint32(0xC2B2AE35) ^ (key >> np.uint32(7)))
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        h ^= h >> np.uint32(shift)
        h *= np.uint32(factor)
    h ^= h >> np.uint32(16)
    return h


def _spline(t: Array) -> tuple[Ints, Array]:
    """First coefficient and weights (4, len(t)) of a cubic B-spline."""
    i = t.astype(np.intp)
    t = t - i
    u = 1 - t
    w = np.empty((4, len(t)), np.float32)
    w[0], w[3] = u * u * u, t * t * t
    w[1], w[2] = (3 * t - 6) * t * t + 4, (3 * u - 6) * u * u + 4
    w /= 6
    return i, w


def _refined(c: Array) -> Array:
    """Coefficients of the same cubic spline on a lattice twice as fine, (2n - 3, 2m - 3)."""
    for axis in (0, 1):
        c = np.swapaxes(c, 0, 1) if axis else c
        fine = np.empty((2 * len(c) - 3, c.shape[1]), np.float32)
        fine[0::2] = c[:-1]
        fine[0::2] += c[1:]
        fine[0::2] *= 0.5
        fine[1::2] = fine[0:-1:2] + fine[2::2]
        fine[1::2] *= 0.25
        fine[1::2] += c[1:-1] * np.float32(0.5)
        c = np.swapaxes(fine, 0, 1) if axis else fine
    return c


def warped(
    canvas: Canvas,
    rng: np.random.Generator,
    frequency: float,
    amount: float,
    at: Points | None = None,
) -> Points:
    """Points displaced by noise of that frequency, by ``amount`` (rms, in units of length)."""
    u, v = at or canvas.points
    rms = np.float32(amount)
    return (
        u + rms * noise(canvas, rng, frequency, 2),
        v + rms * noise(canvas, rng, frequency, 2),
    )
