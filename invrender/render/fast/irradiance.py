"""Irradiance without noise: T(n) of the sky on a table of normals, and V(x), the vector irradiance
that the screen adds, on a grid over the sample. E = T(n) + n·V(x) where the screen is wholly above
the normal's horizon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from invrender.render.backend import dr, vector, while_loop
from invrender.render.fast.pyramid import Pyramid, disc, disc_direction, disc_level, level_offset
from invrender.render.scene import Scene, dimming

NORMALS = 24  # a side in the table of T
EXTENT = 1.1  # of its square beyond the unit disc, so that the rim is interpolated too
DIRECTIONS = 64  # a side of the disc that T sums over
POINTS = 16  # of the sample a side in the grid of V
CELLS = 16  # of the screen a side that V sums over, twice that where there is a sky behind it


@dataclass
class SkyIrradiance:
    """T(n) = ∫ L (n·l)+ dl over z > 0, on size² normals of the disc; flat RGBA."""

    values: Any
    size: int

    @staticmethod
    def build(sky: Pyramid, scalar: type, detail: int = 1) -> SkyIrradiance:
        """From the sky's pyramid; ``detail`` multiplies normals and directions a side."""
        uint, vec3, vec4 = dr.uint32_array_t(scalar), vector(scalar, 3), vector(scalar, 4)
        size = NORMALS * detail
        level = max((sky.n // (DIRECTIONS * detail)).bit_length() - 1, 0)
        m = sky.n >> level
        # The table reaches past the rim, so that interpolation near it reads sensible normals.
        # A lane sums a row of directions for a normal: the table alone would keep few cores busy.
        lane = dr.arange(uint, size * size * m)
        row = lane % m
        i = lane // m
        x, y = scalar(i % size) + 0.5, scalar(i // size) + 0.5
        x, y = (x * (2 / size) - 1) * EXTENT, (y * (2 / size) - 1) * EXTENT
        scale = dr.minimum(1, 1.3 * dr.rsqrt(dr.maximum(x * x + y * y, 1e-12)))
        normal = disc_direction(x * scale, y * scale, vec3)

        def body(column: Any, total: Any) -> tuple[Any, Any]:
            px = (scalar(column) + 0.5) * (2 / m) - 1
            py = 1 - (scalar(row) + 0.5) * (2 / m)
            inside = px * px + py * py < 1.02
            d = dr.normalize(disc_direction(px, py, vec3))
            texel = level_offset(sky.n, level) + (row + 1) * (m + 2) + column + 1
            radiance = dr.gather(vec4, sky.texels, texel, inside)
            cos = dr.maximum(dr.dot(normal, d), 0)
            return column + 1, total + cos * vec3(radiance.x, radiance.y, radiance.z)

        _, total = while_loop(
            (dr.zeros(uint, len(lane)), dr.zeros(vec3, len(lane))),
            lambda column, _: column < dr.opaque(uint, m),
            body,
            max_iterations=-1,
            label="sky irradiance",
        )
        dr.eval(total)
        r, g, b = (dr.block_sum(c, m) * (8 / (m * m)) for c in total)
        return SkyIrradiance(dr.ravel(vec4(r, g, b, 0)), size)

    def __call__(self, n: Any) -> Any:
        """T(n) by Catmull–Rom interpolation: smooth, so that its gradient is one too."""
        scalar = type(n.x)
        uint, sint = dr.uint32_array_t(scalar), dr.int32_array_t(scalar)
        vec3, vec4 = vector(scalar, 3), vector(scalar, 4)
        x, y = disc(n)
        size = self.size
        px = dr.fma(x, 0.5 / EXTENT * size, 0.5 * size - 0.5)
        py = dr.fma(y, 0.5 / EXTENT * size, 0.5 * size - 0.5)
        ix, iy = sint(dr.floor(px)), sint(dr.floor(py))
        wx, wy = _catmull_rom(px - scalar(ix)), _catmull_rom(py - scalar(iy))
        total = vec4(0)
        for j in range(4):
            row = dr.clip(iy + (j - 1), 0, size - 1) * size
            line = vec4(0)
            for i in range(4):
                column = dr.clip(ix + (i - 1), 0, size - 1)
                line = dr.fma(dr.gather(vec4, self.values, uint(row + column)), wx[i], line)
            total = dr.fma(line, wy[j], total)
        return vec3(total.x, total.y, total.z)


def _catmull_rom(f: Any) -> list[Any]:
    f2, f3 = f * f, f * f * f
    return [
        0.5 * (-f + 2 * f2 - f3),
        0.5 * (2 - 5 * f2 + 3 * f3),
        0.5 * (f + 4 * f2 - 3 * f3),
        0.5 * (f3 - f2),
    ]


def screen_cell(
    scene: Scene, screen: Pyramid | None, sky: Pyramid | None, x: Any, i: Any, side: int
) -> tuple[Any, Any, Any]:
    """Cell i of a side × side grid over the screen, seen from x: (unit direction of its centre,
    solid angle, radiance that the screen adds to the sky there)."""
    scalar = scene.scalar
    uint, vec3, vec4 = dr.uint32_array_t(scalar), vector(scalar, 3), vector(scalar, 4)
    row = i // side
    column = i - row * side
    s, t = (scalar(column) + 0.5) / side, 1 - (scalar(row) + 0.5) / side
    to = scene.corner + s * scene.edge_x + t * scene.edge_y - x
    area = dr.cross(scene.edge_x, scene.edge_y) * (1 / (side * side))
    d = dr.normalize(to)
    facing = dr.maximum(dr.dot(area, d), 0)
    # The small-angle formula, kept below the half space for cells that are close by.
    omega = facing / dr.fma(facing, 0.5 / dr.pi, dr.squared_norm(to))
    radiance = vec3(0)
    if screen is not None:
        level = (screen.n // side).bit_length() - 1
        place = level_offset(screen.n, level) + (row + 1) * (side + 2) + column + 1
        texel = dr.gather(vec4, screen.texels, uint(place))
        radiance = vec3(texel.x, texel.y, texel.z)
        if scene.falloff is not None:
            radiance = radiance * dimming(scene, facing * dr.rsqrt(dr.squared_norm(area)))
    if sky is not None:
        x, y = disc(d)
        level = disc_level(sky.n, omega) - 0.5
        behind = sky(dr.fma(x, 0.5, 0.5), dr.fma(y, -0.5, 0.5), level)
        radiance = radiance - vec3(behind.x, behind.y, behind.z)
    return d, omega, radiance


def _cell_vector(scene: Scene, x: Any, i: Any, side: int) -> Any:
    """∫ l dl over cell i, exact for any distance: Lambert's sum over its edges."""
    scalar = scene.scalar
    row = i // side
    column = i - row * side
    corners = []
    for ds, dt in ((0, 0), (0, 1), (1, 1), (1, 0)):
        s, t = scalar(column + ds) / side, 1 - scalar(row + dt) / side
        corners.append(dr.normalize(scene.corner + s * scene.edge_x + t * scene.edge_y - x))
    total = type(x)(0)
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        # angle/sin(angle), from the chord: precise for the small angles that cells have
        chord2 = 0.25 * dr.squared_norm(a - b)
        half = dr.safe_asin(dr.sqrt(dr.maximum(chord2, 1e-12)))
        ratio = half * dr.rsqrt(dr.maximum(chord2 * (1 - chord2), 1e-12))
        total = dr.fma(dr.cross(a, b), 0.5 * ratio, total)
    return total


@dataclass
class VectorIrradiance:
    """V(x) = ∫ (L_screen - L_sky) l dl over the screen: 12 values a point of the sample's grid.

    Nodes are at the sample's corners and between, so that no point of it is extrapolated.
    """

    values: Any
    size: int
    half: Any  # half-width of the sample, metres

    @staticmethod
    def build(
        scene: Scene, screen: Pyramid | None, sky: Pyramid | None, detail: int = 1
    ) -> VectorIrradiance:
        """From the pyramids of screen and sky; ``detail`` multiplies points and cells a side."""
        scalar = scene.scalar
        uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
        size = (POINTS - 1) * detail + 1
        side = CELLS * detail * (1 if sky is None else 2)
        cells = side * side
        lane = dr.arange(uint, size * size * cells)
        i = lane // cells
        u, v = scalar(i % size) / (size - 1), scalar(i // size) / (size - 1)
        x = vec3((2 * u - 1) * scene.half, (1 - 2 * v) * scene.half, scalar(0))
        _, _, light = screen_cell(scene, screen, sky, x, lane % cells, side)
        direction = _cell_vector(scene, x, lane % cells, side)
        terms = [light * direction[k] for k in range(3)]
        dr.eval(terms)
        parts = [vec3(*(dr.block_sum(c, cells) for c in term)) for term in terms]
        flat = dr.zeros(scalar, 12 * size * size)
        i = dr.arange(uint, size * size) * 3
        vec4 = vector(scalar, 4)
        for k, part in enumerate(parts):
            dr.scatter(flat, vec4(part.x, part.y, part.z, 0), i + k, mode=dr.ReduceMode.NoConflicts)
        return VectorIrradiance(flat, size, scene.half)

    def __call__(self, x: Any) -> tuple[Any, Any, Any]:
        """V(x) by bilinear interpolation: the RGB factors of n.x, n.y and n.z."""
        scalar = type(x.x)
        uint, vec3, vec4 = dr.uint32_array_t(scalar), vector(scalar, 3), vector(scalar, 4)
        size = self.size
        last = size - 1
        scale = 0.5 * last / self.half
        px = dr.clip(dr.fma(x.x, scale, 0.5 * last), 0, last)
        py = dr.clip(dr.fma(x.y, -scale, 0.5 * last), 0, last)
        ix, iy = dr.minimum(uint(px), last - 1), dr.minimum(uint(py), last - 1)
        fx, fy = px - scalar(ix), py - scalar(iy)
        i = iy * size + ix
        parts = []
        for k in range(3):
            fetch = lambda j, k=k: dr.gather(vec4, self.values, 3 * j + k)  # noqa: E731
            value = dr.lerp(
                dr.lerp(fetch(i), fetch(i + 1), fx),
                dr.lerp(fetch(i + size), fetch(i + size + 1), fx),
                fy,
            )
            parts.append(vec3(value.x, value.y, value.z))
        return parts[0], parts[1], parts[2]
