"""Filtered look-ups: a box-filtered pyramid, and the equal-area disc that it holds the sky on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from invrender.render.backend import dr, vector


@dataclass
class Pyramid:
    """Box-filtered levels of an n × n RGBA image, each with a border of zeros, in one flat array.

    Level k has m = n/2^k texels a side and starts after those before it. Reading beyond the image
    fades to zero within one texel, so that A is the share of a footprint that the image covers.
    """

    texels: Any
    n: int

    @staticmethod
    def build(image: Any, n: int) -> Pyramid:
        """From an Array4 of n² values in row order."""
        vec4 = type(image)
        uint = dr.uint32_array_t(dr.value_t(vec4))
        total = level_offset(n, n.bit_length())
        texels = dr.zeros(dr.value_t(vec4), 4 * total)
        m, level = n, 0
        while True:
            # One flat copy, that a level is stored from and the next one averaged from.
            flat = dr.ravel(image)
            i = dr.arange(uint, m * m)
            row = i // m
            place = level_offset(n, level) + (row + 1) * (m + 2) + (i - row * m) + 1
            stored = dr.gather(vec4, flat, i)
            dr.scatter(texels, stored, place, mode=dr.ReduceMode.NoConflicts)
            if m == 1:
                return Pyramid(texels, n)
            m //= 2
            level += 1
            i = dr.arange(uint, m * m)
            row = i // m
            j = 4 * m * row + 2 * (i - row * m)
            a, b, c, d = (dr.gather(vec4, flat, j + k) for k in (0, 1, 2 * m, 2 * m + 1))
            image = 0.25 * (a + b + c + d)

    def _level(self, k: Any, x: Any, y: Any, slopes: bool) -> list[Any]:
        """[value] on level k, or [value, ∂/∂x, ∂/∂y]."""
        scalar = type(x)
        uint = dr.uint32_array_t(scalar)
        vec4 = vector(scalar, 4)
        m = uint(self.n) >> k
        mf = scalar(m)
        px, py = dr.fma(x, mf, 0.5), dr.fma(y, mf, 0.5)
        qx, qy = dr.clip(px, 0, mf + 1), dr.clip(py, 0, mf + 1)
        ix, iy = dr.minimum(uint(qx), m), dr.minimum(uint(qy), m)
        fx, fy = qx - scalar(ix), qy - scalar(iy)
        width = m + 2
        i = level_offset(self.n, k) + iy * width + ix
        a, b, c, d = (dr.gather(vec4, self.texels, i + j) for j in (0, 1, width, width + 1))
        upper, lower = dr.fma(b - a, fx, a), dr.fma(d - c, fx, c)
        value = dr.fma(lower - upper, fy, upper)
        if not slopes:
            return [value]
        in_x, in_y = dr.select(qx == px, mf, 0), dr.select(qy == py, mf, 0)
        return [value, dr.lerp(b - a, d - c, fy) * in_x, (lower - upper) * in_y]

    def _trilinear(self, x: Any, y: Any, level: Any, slopes: bool) -> list[Any]:
        scalar = type(x)
        uint = dr.uint32_array_t(scalar)
        top = self.n.bit_length() - 1
        clipped = dr.clip(level, 0, top)
        k = dr.minimum(uint(clipped), max(top - 1, 0))
        f = clipped - scalar(k)
        fine = self._level(k, x, y, slopes)
        coarse = self._level(k + min(top, 1), x, y, slopes)
        out = [dr.fma(q - p, f, p) for p, q in zip(fine, coarse, strict=True)]
        if slopes:
            out.append(dr.select(clipped == level, coarse[0] - fine[0], 0))
        return out

    def __call__(self, x: Any, y: Any, level: Any) -> Any:
        """RGBA at (x, y) in [0, 1]², row 0 at y = 0, trilinear in the level."""
        return self._trilinear(x, y, level, False)[0]

    def slopes(self, x: Any, y: Any, level: Any) -> list[Any]:
        """[RGBA, ∂/∂x, ∂/∂y, ∂/∂level] at (x, y, level)."""
        return self._trilinear(x, y, level, True)


def level_offset(n: int, k: Any) -> Any:
    """Texels before level k, an int or a Dr.Jit integer: sum of (n/2^j + 2)² over j < k."""
    if isinstance(k, int):
        return sum(((n >> j) + 2) ** 2 for j in range(k))
    m = type(k)(n) >> k
    return (n * n - m * m) // 3 * 4 + 8 * (n - m) + 4 * k


def disc(d: Any) -> tuple[Any, Any]:
    """Lambert's equal-area map of the upper hemisphere to the unit disc: d.xy / sqrt(1 + d.z)."""
    q = dr.rsqrt(1 + dr.maximum(d.z, -0.75))
    return d.x * q, d.y * q


def disc_direction(x: Any, y: Any, vec3: type) -> Any:
    """Inverse of `disc` for x² + y² ≤ 1."""
    r2 = x * x + y * y
    q = dr.safe_sqrt(2 - r2)
    return vec3(x * q, y * q, 1 - r2)


def disc_level(n: int, solid_angle: Any) -> Any:
    """Level of an n × n image of the disc whose texels are about as large as ``solid_angle``."""
    # A texel of the disc has area (2/n)² and twice that in solid angle.
    return 0.5 * dr.log2(solid_angle * (n * n / 8))


def square_level(n: int, area: Any) -> Any:
    """Level of an n × n image of the unit square whose texels are about ``area``."""
    return 0.5 * dr.log2(area * (n * n))
