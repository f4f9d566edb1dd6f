"""Filtered look-ups: a box-filtered pyramid, and the equal-area disc that it holds the sky on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from invrender.backend import dr, vector


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
            i = dr.arange(uint, m * m)
            row = i // m
            place = level_offset(n, level) + (row + 1) * (m + 2) + (i - row * m) + 1
            dr.scatter(texels, image, place, mode=dr.ReduceMode.NoConflicts)
            if m == 1:
                return Pyramid(texels, n)
            m //= 2
            level += 1
            i = dr.arange(uint, m * m)
            row = i // m
            j = 4 * m * row + 2 * (i - row * m)
            image = 0.25 * (
                dr.gather(vec4, dr.ravel(image), j)
                + dr.gather(vec4, dr.ravel(image), j + 1)
                + dr.gather(vec4, dr.ravel(image), j + 2 * m)
                + dr.gather(vec4, dr.ravel(image), j + 2 * m + 1)
            )

    def _level(self, k: Any, x: Any, y: Any) -> Any:
        scalar = type(x)
        uint = dr.uint32_array_t(scalar)
        vec4 = vector(scalar, 4)
        m = uint(self.n) >> k
        mf = scalar(m)
        px = dr.clip(dr.fma(x, mf, 0.5), 0, mf + 0.999)
        py = dr.clip(dr.fma(y, mf, 0.5), 0, mf + 0.999)
        ix, iy = uint(px), uint(py)
        fx, fy = px - scalar(ix), py - scalar(iy)
        width = m + 2
        i = level_offset(self.n, k) + iy * width + ix
        fetch = lambda j: dr.gather(vec4, self.texels, j)  # noqa: E731
        return dr.lerp(
            dr.lerp(fetch(i), fetch(i + 1), fx),
            dr.lerp(fetch(i + width), fetch(i + width + 1), fx),
            fy,
        )

    def __call__(self, x: Any, y: Any, level: Any) -> Any:
        """RGBA at (x, y) in [0, 1]², row 0 at y = 0, trilinear in the level."""
        scalar = type(x)
        uint = dr.uint32_array_t(scalar)
        top = self.n.bit_length() - 1
        level = dr.clip(level, 0, top)
        k = dr.minimum(uint(level), max(top - 1, 0))
        return dr.lerp(self._level(k, x, y), self._level(k + min(top, 1), x, y), level - scalar(k))


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
