"""What the fast estimator reads: filtered lights, irradiance tables, lamps one by one.

Built from a `Scene` by Dr.Jit code, so that gradients pass through to the lights and the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from invrender.backend import dr, vector
from invrender.pyramid import Pyramid, disc, disc_direction, level_offset
from invrender.scene import Scene, ScreenFrame, environment_at, hit_screen, pattern_at

HOT_SHARE = 0.004  # a texel whose flux exceeds this share of the environment's is a lamp of its own
MAX_HOT = 64
LAMP_SIDES = 4  # at most so many points a side in a lamp, more of them as samples grow
SCREEN_TEXELS = 256  # at least so many a side on the screen, so that its edge is sharp
T_SIZE = 24  # normals a side in the table of T
T_EXTENT = 1.1  # of its square beyond the unit disc, so that the rim is interpolated too
V_SIZE = 16  # sample points a side in the table of V
SKY_TEXELS = 4  # of the disc a side for each row of the environment
QUAD = 32  # screen cells a side in V's quadrature


@dataclass
class Tables:
    """What the fast estimator reads; rebuilt when the lights or the screen's pose change.

    screen: RGBA pyramid of gain × pattern. sky: RGBA pyramid of the environment above the table on
    Lambert's disc, without its lamps and what the screen hides from the whole sample (A = 0 there);
    where there are lamps, a second one that holds them follows it.
    sky_irradiance: T(n), its irradiance on a disc of normals.
    vector_irradiance: V(x) of the screen minus that of the sky behind it, 9 values on a grid over
    the sample. Lamps: directions, polar extents and flux of the brightest texels.
    """

    scene: Scene
    screen: Pyramid | None
    sky: Pyramid | None
    sky_irradiance: Any | None
    vector_irradiance: Any | None
    lamp_points: Any | None
    lamp_radiance: Any | None
    lamp_count: int  # of those not hidden from the whole sample
    lamp_open: int  # the first so many are hidden from no part of it


def fast_tables(scene: Scene) -> Tables:
    """Build the `Tables` of a scene, differentiably with respect to all of its fields."""
    tables = Tables(scene, None, None, None, None, None, None, 0, 0)
    if scene.pattern is not None:
        tables.screen = _screen_pyramid(scene)
    if scene.environment is not None:
        _split_lamps(tables)
        tables.sky_irradiance = _sky_irradiance(tables)
    if scene.pattern is not None or scene.environment is not None:
        tables.vector_irradiance = _vector_irradiance(tables)
    return tables


def _power_of_two(n: int) -> int:
    return 1 << max(n - 1, 0).bit_length()


def _grid(uint: type, scalar: type, n: int) -> tuple[Any, Any]:
    """Centres of n × n cells in [0, 1]², row order."""
    i = dr.arange(uint, n * n)
    row = i // n
    return (scalar(i - row * n) + 0.5) / n, (scalar(row) + 0.5) / n


def _screen_pyramid(scene: Scene) -> Pyramid:
    scalar = scene.scalar
    n = max(_power_of_two(scene.pattern_size), SCREEN_TEXELS)
    x, y = _grid(dr.uint32_array_t(scalar), scalar, n)
    rgb = pattern_at(scene, x, 1 - y)
    return Pyramid.build(vector(scalar, 4)(rgb.x, rgb.y, rgb.z, 1), n)


def _split_lamps(tables: Tables) -> None:
    """Take the few brightest texels out of the environment and filter the rest.

    A texel above the table whose flux exceeds `HOT_SHARE` of the whole keeps that share; what is
    above becomes a lamp that is sampled by itself. The split is a constant factor a texel, so both
    parts stay linear in the environment.
    """
    scene = tables.scene
    scalar = scene.scalar
    uint, vec3, vec4 = dr.uint32_array_t(scalar), vector(scalar, 3), vector(scalar, 4)
    h = scene.env_height
    w = 2 * h
    env = np.asarray(dr.detach(scene.environment)).reshape(h, w, 3).astype(np.float64)
    theta = (np.arange(h) + 0.5) / h * np.pi
    flux = env.mean(-1) * np.sin(theta)[:, None]
    flux[theta > np.pi / 2] = 0
    limit = HOT_SHARE * flux.sum()
    hot = np.flatnonzero(flux > limit)
    hot = hot[np.argsort(-flux.ravel()[hot], kind="stable")][:MAX_HOT]
    keep = np.ones(h * w)
    keep[hot] = limit / flux.ravel()[hot] if len(hot) else 1
    rest = scene.environment
    if len(hot):
        rest = rest * scalar(np.repeat(keep, 3))
        theta, phi = (hot // w + 0.5) * np.pi / h, (hot % w + 0.5) * np.pi / h
        d = vec3(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
        hidden, partly = (
            np.broadcast_to(np.array(m), len(hot))
            for m in _corner_hits(dr.detach(scene), d, np.pi / h)
        )
        hot = np.concatenate([hot[~partly], hot[partly & ~hidden]])
        tables.lamp_count, tables.lamp_open = len(hot), int((~partly).sum())
    if len(hot):
        index = uint(hot.astype(np.uint32))
        lamp = dr.gather(vec3, scene.environment, index) * (1 - scalar(keep[hot]))
        tables.lamp_radiance = dr.ravel(lamp * scene.scale)
        _lamp_points(tables, hot)
    without = replace(scene, environment=rest)

    n = min(max(SKY_TEXELS * _power_of_two(h), 256), 1024)
    x, y = _grid(uint, scalar, n)
    px, py = x * 2 - 1, 1 - y * 2
    inside = px * px + py * py < 1
    d = disc_direction(dr.select(inside, px, 0), dr.select(inside, py, 0), vec3)
    hidden, _ = _corner_hits(dr.detach(scene), d, 0)

    def image(lit: Scene) -> Any:
        seen = dr.select(inside & ~hidden, environment_at(lit, d), 0)
        return vec4(seen.x, seen.y, seen.z, dr.select(inside & hidden, scalar(0), 1))

    images = [image(s) for s in ((without, scene) if len(hot) else (without,))]
    dr.eval(images)
    pyramids = [Pyramid.build(i, n).texels for i in images]
    tables.sky = Pyramid(dr.concat(pyramids) if len(hot) else pyramids[0], n)


def _corner_hits(scene: Scene, d: Any, margin: float) -> tuple[Any, Any]:
    """For far directions d: whether the screen hides them from all of the sample; whether it may
    hide them from some of it.

    The screen's shadow along d is a parallelogram and the sample is convex, so its corners decide.
    ``margin`` (radians) is the width of what lies in direction d.
    """
    if scene.pattern is None:
        no = dr.mask_t(scene.scalar)(False)
        return no, no
    vec3 = type(d)
    edge = dr.minimum(dr.norm(scene.edge_x), dr.norm(scene.edge_y))
    half = dr.opaque(scene.scalar, scene.half)
    hidden: Any = True
    sides: list[Any] = [True] * 4  # all corners beyond the same side of the screen
    for sx, sy in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        x = vec3(sx * half, sy * half, 0)
        s, t, r, cos, _ = hit_screen(scene, x, d)
        width = margin * r / (dr.maximum(cos, 1e-3) * edge)
        up = cos > 1e-3
        hidden &= up & (s > width) & (s < 1 - width) & (t > width) & (t < 1 - width)
        beyond = (s < -width, s > 1 + width, t < -width, t > 1 + width)
        sides = [a & (~up | b) for a, b in zip(sides, beyond, strict=True)]
    return hidden, ~(sides[0] | sides[1] | sides[2] | sides[3])


def _lamp_points(tables: Tables, hot: np.ndarray) -> None:
    """Precompute each lamp's points: Gauss's rule for its bilinear tent, 1 to 4 points a side.

    A point: direction and solid angle, then half-widths in radians along θ and φ, for the screen's
    edge to cover it bit by bit.
    """
    scene = tables.scene
    scalar = scene.scalar
    h = scene.env_height
    blocks = []
    for nodes, weights in (_gauss_tent(side) for side in range(1, LAMP_SIDES + 1)):
        width = np.pi / h / len(nodes)
        theta = (hot[:, None, None] // (2 * h) + 0.5 + nodes[None, :, None]) * (np.pi / h)
        phi = (hot[:, None, None] % (2 * h) + 0.5 + nodes[None, None, :]) * (np.pi / h)
        theta, phi = np.broadcast_arrays(theta, phi)
        sin = np.abs(np.sin(theta))
        weight = sin * (np.pi / h) ** 2 * (weights[:, None] * weights)
        direction = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
        zero = np.zeros_like(theta)
        point = [*direction, weight, zero + width, width * np.maximum(sin, 1e-3), zero, zero]
        blocks.append(np.stack(point, -1).reshape(-1))
    tables.lamp_points = scalar(np.concatenate(blocks))


def _gauss_tent(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of the n-point Gauss rule for the weight 1 - |x| on [-1, 1]."""
    # Golub and Welsch: the recurrence's coefficients from the moments 2/((k+1)(k+2)), k even.
    moments = [0 if k % 2 else 2 / ((k + 1) * (k + 2)) for k in range(2 * n + 1)]
    hankel = np.array([[moments[i + j] for j in range(n + 1)] for i in range(n + 1)])
    r = np.linalg.cholesky(hankel).T
    off = [r[k + 1, k + 1] / r[k, k] for k in range(n - 1)]
    nodes, vectors = np.linalg.eigh(np.diag(off, 1) + np.diag(off, -1))
    return nodes, vectors[0] ** 2


def lamp_at(
    tables: Tables, screen: ScreenFrame | None, lamp: Any, k: Any = 0, side: Any = 1
) -> tuple[Any, Any]:
    """Point k of side² of a lamp: (direction, radiance × solid angle that reaches x)."""
    scalar = tables.scene.scalar
    vec3, vec4 = vector(scalar, 3), vector(scalar, 4)
    # Points of the coarser subdivisions come before: 0, 1, 1 + 4, 1 + 4 + 9 a lamp.
    before = (side - 1) * side * (2 * side - 1) // 6 * dr.opaque(type(lamp), tables.lamp_count)
    i = before + lamp * (side * side) + k
    point = dr.gather(vec4, tables.lamp_points, 2 * i)
    d = vec3(point.x, point.y, point.z)
    light = dr.gather(vec3, tables.lamp_radiance, lamp)
    light = light * dr.select(d.z > 0, point.w, 0)
    if screen is None or tables.lamp_open == tables.lamp_count:
        return d, light
    # The screen's edge covers the point's tent bit by bit: project its widths to (s, t).
    extent = dr.gather(vec4, tables.lamp_points, 2 * i + 1)
    ps, pt, r, cos, ahead = screen.hit(d)
    cos = dr.select(ahead, cos, 1)
    inverse_sin2 = dr.rcp(dr.maximum(1 - d.z * d.z, 1e-6))

    def inside(p: Any, along: Any) -> Any:
        slope = dr.fma(screen.normal, -dr.dot(d, along) / cos, along)  # ⟂ d, times r
        across = dr.square(slope.y * d.x - slope.x * d.y) * inverse_sin2
        down = dr.maximum(dr.squared_norm(slope) - across, 0)
        width = r * dr.sqrt(dr.fma(dr.square(extent.x), down, dr.square(extent.y) * across) + _TINY)
        return _tent_below(p / width) - _tent_below((p - 1) / width)

    covered = inside(ps, screen.along_s) * inside(pt, screen.along_t)
    return d, light * (1 - dr.select(ahead, covered, 0))


_TINY = 1e-30  # keeps the square root's slope finite


def _tent_below(x: Any) -> Any:
    """Integral of the tent 1 - |x| from -1 to x."""
    x = dr.clip(x, -1, 1)
    return 0.5 + x - 0.5 * x * dr.abs(x)


def sky_level(tables: Tables, solid_angle: Any) -> Any:
    """Level of the sky pyramid whose texels are about as large as ``solid_angle``."""
    assert tables.sky is not None
    n = tables.sky.n
    # A texel of the disc has area (2/n)² and twice that in solid angle.
    return 0.5 * dr.log2(solid_angle * (n * n / 8))


def screen_level(tables: Tables, area: Any) -> Any:
    """Level of the screen's pyramid whose texels are about ``area``, of the unit square."""
    assert tables.screen is not None
    n = tables.screen.n
    return 0.5 * dr.log2(area * (n * n))


def _sky_irradiance(tables: Tables) -> Any:
    """T(n) = ∫ L (n·l)+ dl over z > 0, on T_SIZE² normals of the disc; flat RGBA."""
    assert tables.sky is not None
    scalar = tables.scene.scalar
    uint, vec3, vec4 = dr.uint32_array_t(scalar), vector(scalar, 3), vector(scalar, 4)
    sky = tables.sky
    level = max(sky.n.bit_length() - 7, 0)  # 64 × 64 directions
    m = sky.n >> level
    # The table reaches past the rim, so that interpolation near it reads sensible normals.
    # A lane sums a row of directions for a normal: the table alone would keep few cores busy.
    lane = dr.arange(uint, T_SIZE * T_SIZE * m)
    row = lane % m
    i = lane // m
    x, y = scalar(i % T_SIZE) + 0.5, scalar(i // T_SIZE) + 0.5
    x, y = (x * (2 / T_SIZE) - 1) * T_EXTENT, (y * (2 / T_SIZE) - 1) * T_EXTENT
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

    _, total = dr.while_loop(
        (dr.zeros(uint, len(lane)), dr.zeros(vec3, len(lane))),
        lambda column, _: column < dr.opaque(uint, m),
        body,
        max_iterations=-1,
        label="sky irradiance",
    )
    dr.eval(total)
    r, g, b = (dr.block_sum(c, m) * (8 / (m * m)) for c in total)
    return dr.ravel(vec4(r, g, b, 0))


def sky_irradiance_at(tables: Tables, n: Any) -> Any:
    """T(n) by Catmull–Rom interpolation: smooth, so that its gradient is one too."""
    scalar = tables.scene.scalar
    uint, sint = dr.uint32_array_t(scalar), dr.int32_array_t(scalar)
    vec3, vec4 = vector(scalar, 3), vector(scalar, 4)
    x, y = disc(n)
    size = T_SIZE
    px = dr.fma(x, 0.5 / T_EXTENT * size, 0.5 * size - 0.5)
    py = dr.fma(y, 0.5 / T_EXTENT * size, 0.5 * size - 0.5)
    ix, iy = sint(dr.floor(px)), sint(dr.floor(py))
    wx, wy = _catmull_rom(px - scalar(ix)), _catmull_rom(py - scalar(iy))
    total = vec4(0)
    for j in range(4):
        row = dr.clip(iy + (j - 1), 0, size - 1) * size
        line = vec4(0)
        for i in range(4):
            column = dr.clip(ix + (i - 1), 0, size - 1)
            line = dr.fma(dr.gather(vec4, tables.sky_irradiance, uint(row + column)), wx[i], line)
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


def screen_cell(tables: Tables, x: Any, i: Any, side: int) -> tuple[Any, Any, Any]:
    """Cell i of a side × side grid over the screen, seen from x: (unit direction of its centre,
    solid angle, radiance that the screen adds to the sky there)."""
    scene = tables.scene
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
    if tables.screen is not None:
        pyramid = tables.screen
        if pyramid.n >= side:
            level = (pyramid.n // side).bit_length() - 1
            width = side + 2
            place = level_offset(pyramid.n, level) + (row + 1) * width + column + 1
            texel = dr.gather(vec4, pyramid.texels, uint(place))
        else:
            texel = pyramid(s, 1 - t, scalar(0))
        radiance = vec3(texel.x, texel.y, texel.z)
    if tables.sky is not None:
        x, y = disc(d)
        level = sky_level(tables, omega) - 0.5
        sky = tables.sky(dr.fma(x, 0.5, 0.5), dr.fma(y, -0.5, 0.5), level)
        radiance = radiance - vec3(sky.x, sky.y, sky.z)
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


def _vector_irradiance(tables: Tables) -> Any:
    """V(x) = ∫ (L_screen - L_sky) l dl over the screen's solid angle; flat, 12 values a point."""
    scene = tables.scene
    scalar = scene.scalar
    uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
    half = dr.opaque(scalar, scene.half)
    cells = QUAD * QUAD
    lane = dr.arange(uint, V_SIZE * V_SIZE * cells)
    i = lane // cells
    # Nodes at the sample's corners and between, so that no point of it is extrapolated.
    u, v = scalar(i % V_SIZE) / (V_SIZE - 1), scalar(i // V_SIZE) / (V_SIZE - 1)
    x = vec3((2 * u - 1) * half, (1 - 2 * v) * half, scalar(0))
    _, _, light = screen_cell(tables, x, lane % cells, QUAD)
    direction = _cell_vector(scene, x, lane % cells, QUAD)
    terms = [light * direction[k] for k in range(3)]
    dr.eval(terms)
    parts = [vec3(*(dr.block_sum(c, cells) for c in term)) for term in terms]
    flat = dr.zeros(scalar, 12 * V_SIZE * V_SIZE)
    i = dr.arange(uint, V_SIZE * V_SIZE) * 3
    vec4 = vector(scalar, 4)
    for k, part in enumerate(parts):
        dr.scatter(flat, vec4(part.x, part.y, part.z, 0), i + k, mode=dr.ReduceMode.NoConflicts)
    return flat


def vector_irradiance_at(tables: Tables, x: Any) -> tuple[Any, Any, Any]:
    """V(x) by bilinear interpolation: the RGB factors of n.x, n.y and n.z."""
    scene = tables.scene
    scalar = scene.scalar
    uint, vec3, vec4 = dr.uint32_array_t(scalar), vector(scalar, 3), vector(scalar, 4)
    last = V_SIZE - 1
    scale = 0.5 * last / dr.opaque(scalar, scene.half)
    px = dr.clip(dr.fma(x.x, scale, 0.5 * last), 0, last)
    py = dr.clip(dr.fma(x.y, -scale, 0.5 * last), 0, last)
    ix, iy = dr.minimum(uint(px), last - 1), dr.minimum(uint(py), last - 1)
    fx, fy = px - scalar(ix), py - scalar(iy)
    i = iy * V_SIZE + ix
    parts = []
    for k in range(3):
        fetch = lambda j, k=k: dr.gather(vec4, tables.vector_irradiance, 3 * j + k)  # noqa: E731
        value = dr.lerp(
            dr.lerp(fetch(i), fetch(i + 1), fx),
            dr.lerp(fetch(i + V_SIZE), fetch(i + V_SIZE + 1), fx),
            fy,
        )
        parts.append(vec3(value.x, value.y, value.z))
    return parts[0], parts[1], parts[2]
