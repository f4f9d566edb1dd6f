"""Height from normals: Poisson integration that outliers cannot bend.

The slopes g = (-n_x/n_z, -n_y/n_z) of a surface h are its gradient; measured ones are not quite a
gradient. Least squares, min ∑|∇h - g|², is one Poisson equation, solved by cosine transforms
[Simchony, Chellappa and Shao 1990; Frankot and Chellappa 1988 for periodic maps, by Fourier
transforms], but spreads every wrong normal over the whole surface. min ∑|∇h - g|₁ leaves the errors
where they are [Reddy, Agrawal and Chellappa 2009; Quéau, Durou and Aujol 2018, "Normal integration:
a survey"]; it is solved by alternating directions (ADMM), a Poisson equation each step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from invrender.maps import Maps, unit_normals
from invrender.types import Array

STEEPEST = 10.0  # slope, 84°: what normals nearer to the horizon are taken for
HEIGHT_STEPS = 12  # more change the height by less than a hundredth of its error


@dataclass(frozen=True)
class Height:
    """height: (H, W) metres above the mean. residual: RMS of ∇h - g, a slope: what no surface
    explains. outliers: the share of slopes that were left unexplained by more than 0.1."""

    height: Array
    residual: float
    outliers: float


def height_from_normals(
    normal: Array, pixel: float, *, periodic: bool = False, robust: bool = True
) -> Height:
    """Integrate unit normals (H, W, 3), OpenGL, row 0 at +y, with pixels of ``pixel`` metres.

    periodic: the map tiles; its mean slope, which would not, is taken out.
    """
    n = np.asarray(normal, np.float32)
    z = np.maximum(n[..., 2], 1e-6)
    # Downwards is -y: both differences along rows and columns have the sign of the slopes' own.
    p = np.clip(-n[..., 0] / z, -STEEPEST, STEEPEST)
    q = np.clip(n[..., 1] / z, -STEEPEST, STEEPEST)
    gx, gy = _between(p, 1, periodic), _between(q, 0, periodic)
    if periodic:
        gx, gy = gx - gx.mean(), gy - gy.mean()
    solve = _Poisson(p.shape, periodic)
    h = solve(gx, gy)
    if robust:
        h = _least_absolute(h, gx, gy, solve)
    ex, ey = (d - g for d, g in zip(solve.gradient(h), (gx, gy), strict=True))
    errors = np.concatenate([ex.ravel(), ey.ravel()])
    return Height(
        ((h - h.mean()) * pixel).astype(np.float32),
        float(np.sqrt(np.mean(errors**2))) if errors.size else 0.0,
        float(np.mean(np.abs(errors) > 0.1)) if errors.size else 0.0,
    )


def displaced(maps: Maps, side: float) -> tuple[Array, Maps]:
    """Heights (H, W), metres about their mean, of a sample ``side`` metres wide with the maps'
    relief, and the maps with that surface's normals: of theirs, what a surface can have."""
    pixel = side / maps.shape[1]
    height = height_from_normals(maps.normal, pixel).height
    down, right = np.gradient(height / pixel) if min(maps.shape) > 1 else 2 * [0 * height]
    normal = np.stack([-right, down, np.ones_like(height)], -1).astype(np.float32)
    return height, replace(maps, normal=unit_normals(normal))


def _between(slope: Array, axis: int, periodic: bool) -> Array:
    """Slopes half-way between neighbours; periodic maps have one more pair."""
    after = np.roll(slope, -1, axis)
    mean = (slope + after) / 2
    return mean if periodic else np.delete(mean, -1, axis)


class _Poisson:
    """Least squares min |∇h - (gx, gy)|² in pixels, by the transform that makes it diagonal."""

    def __init__(self, shape: tuple[int, ...], periodic: bool) -> None:
        self.shape, self.periodic = shape, periodic
        period = 2 if periodic else 1
        rows, columns = (
            2
            - 2 * np.cos(np.pi * period * np.arange(n if not (periodic and i) else n // 2 + 1) / n)
            for i, n in enumerate(shape)
        )
        eigenvalues = rows[:, None] + columns[None, :]
        eigenvalues[0, 0] = 1
        self.inverse = (1 / eigenvalues).astype(np.float32)
        self.inverse[0, 0] = 0  # the mean height is free

    def gradient(self, h: Array) -> tuple[Array, Array]:
        if self.periodic:
            return np.roll(h, -1, 1) - h, np.roll(h, -1, 0) - h
        return np.diff(h, axis=1), np.diff(h, axis=0)

    def __call__(self, gx: Array, gy: Array) -> Array:
        if self.periodic:
            minus_div = np.roll(gx, 1, 1) - gx + np.roll(gy, 1, 0) - gy
            return fft.irfft2(fft.rfft2(minus_div) * self.inverse, s=self.shape)
        minus_div = np.zeros(self.shape, np.float32)
        minus_div[:, 1:] += gx
        minus_div[:, :-1] -= gx
        minus_div[1:] += gy
        minus_div[:-1] -= gy
        return fft.idctn(
            fft.dctn(minus_div, norm="ortho", workers=-1) * self.inverse, norm="ortho", workers=-1
        )


def _least_absolute(h: Array, gx: Array, gy: Array, solve: _Poisson) -> Array:
    """min ∑|∇h - g|₁ by ADMM: with e = ∇h - g, h and e are found in turns, u adds up their gap.

    The threshold shrinks from the least-squares residuals' own size, which takes few steps.
    """
    g = (gx, gy)
    u = [np.zeros_like(x) for x in g]
    slopes = zip(solve.gradient(h), g, strict=True)
    spread = np.concatenate([np.abs(d - x).ravel() for d, x in slopes])
    if not spread.size or spread.max() < 1e-6:
        return h
    threshold = np.float32(max(np.quantile(spread, 0.9), 1e-5))
    for _ in range(HEIGHT_STEPS):
        wanted = []
        for i, (d, x) in enumerate(zip(solve.gradient(h), g, strict=True)):
            gap = d - x + u[i]
            u[i] = np.clip(gap, -threshold, threshold)
            wanted.append(x + gap - 2 * u[i])  # g + e - u, since e = gap - u
        h = solve(*wanted)
    return h
