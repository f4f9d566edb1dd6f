"""The fast estimator: few filtered samples, no noise in the diffuse term.

Diffuse light comes from tables of irradiance; specular light from visible-normal samples whose
look-ups are filtered to each sample's share of the lobe; lamps are summed one by one. Everything is
smooth in the maps and the pose: the screen's edge is as soft as the sample's footprint. The bias is
that of the footprints and goes to zero as samples grow.
"""

from __future__ import annotations

from typing import Any

from invrender import brdf
from invrender.backend import dr, vector
from invrender.scene import Scene, View, hit_screen, unit
from invrender.shading import Shading, Sums
from invrender.tables import (
    LAMP_SIDES,
    Tables,
    lamp_point,
    screen_at,
    screen_cell,
    sky_at,
    sky_irradiance_at,
    vector_irradiance_at,
)

SCREEN_BIAS, SKY_BIAS = 0.0, -0.5  # levels added to a look-up whose footprint is a sample's share

STEEP_SIDE = 16  # screen cells a side where a normal's horizon cuts the screen
# screen cells a side where a normal's horizon cuts the screen


def shade_fast(
    tables: Tables, view: View, rho: Any, normal: Any, samples: int, jacobian: bool = False
) -> Shading:
    """The fast estimator. normal: unit. samples: of the specular lobe, any number without
    recompiling."""
    scene = tables.scene
    scalar = scene.scalar
    uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
    width = max(dr.width(view.x), dr.width(rho), dr.width(normal))
    sums = Sums(vec3, width, jacobian)
    sums.add(lambda r, m: (_smooth_irradiance(tables, view, m),), (0,), rho, normal)
    if tables.screen is not None:
        cells = dr.select(_is_steep(scene, view, normal), uint(STEEP_SIDE**2), uint(0))
        steep = lambda i, r, m: (_steep_sample(tables, view, i, m),)  # noqa: E731
        sums.run(dr.detach(cells), steep, (0,), "steep", rho, normal)
    if tables.screen is not None or tables.sky is not None:
        n_samples = dr.opaque(uint, samples)
        inv_n = 1 / scalar(n_samples)
        lobe = lambda i, r, m: _specular_sample(tables, view, i, inv_n, r * r, m)  # noqa: E731
        sums.run(n_samples, lobe, (1, 2), "specular", rho, normal)
    if tables.lamp_count:
        # Points a side in each lamp: more where the lobe is narrower than the lamp.
        texel = dr.pi / scene.env_height
        side = dr.clip(dr.ceil(0.75 * texel / dr.maximum(rho * rho, 1e-6)), 1, LAMP_SIDES[-1])
        side = dr.detach(uint(side))
        first = dr.zeros(uint, width)
        for stop, occluded in ((tables.lamp_open, False), (tables.lamp_count, True)):
            last = side * side * dr.opaque(uint, stop)
            if stop and not (occluded and stop == tables.lamp_open):
                lamp = lambda i, r, m, occluded=occluded: _lamp_sample(  # noqa: E731
                    tables, view, i, side, r * r, m, occluded
                )
                sums.run(last, lamp, (0, 1, 2), "lamps", rho, normal, start=first)
            first = last
    return sums.shading()


def _specular_sample(
    tables: Tables, view: View, i: Any, inv_n: Any, alpha: Any, n: Any
) -> tuple[Any, Any]:
    """Sample i of N of the specular integral, filtered to its share 1/(N·pdf) of the lobe.

    Returns its terms of B and A. Smooth in α and n: directions move with the parameters.
    """
    scalar = type(alpha)
    vec3 = vector(scalar, 3)
    s, t = brdf.frame(n)
    v = brdf.to_local(view.to_camera, s, t, n)
    v.z = dr.maximum(v.z, 1e-4)  # normals that face away from the camera show their horizon
    # Rank-1 lattice (golden ratio) with a random rotation a pixel.
    u1 = unit(i * 2654435769 + view.hash, scalar)
    u2 = dr.fma(scalar(i), inv_n, 0.5 * inv_n)
    h = brdf.sample_vndf(v, alpha, u1, u2)
    v_h = dr.dot(v, h)
    local = dr.fma(h, 2 * v_h, -v)
    d = brdf.to_world(local, s, t, n)
    valid = (local.z > 1e-6) & (d.z > -0.2)
    lz = dr.select(valid, local.z, 1)
    a2 = alpha * alpha
    root_l = dr.sqrt(dr.fma(a2, local.x * local.x + local.y * local.y, lz * lz))
    root_v = dr.sqrt(dr.fma(a2, v.x * v.x + v.y * v.y, v.z * v.z))
    weight = lz * (v.z + root_v) / dr.fma(v.z, root_l, lz * root_v)  # G2 / G1(v)
    pdf = brdf.ggx_d(h, alpha) / (2 * (v.z + root_v))
    omega = dr.minimum(inv_n / pdf, 2 * dr.pi)
    radiance = vec3(0)
    cover = None
    if tables.screen is not None:
        ps, pt, r, cos, _ = hit_screen(tables.scene, view.x, d)
        ahead = cos > 1e-3
        cos = dr.select(ahead, cos, 1)
        size = dr.norm(dr.cross(tables.scene.edge_x, tables.scene.edge_y))
        rgba = screen_at(tables, ps, pt, omega * r * r / (cos * size), SCREEN_BIAS)
        rgba = dr.select(ahead, rgba, 0)
        radiance = vec3(rgba.x, rgba.y, rgba.z)
        cover = rgba.w
    if tables.sky is not None:
        rgba = sky_at(tables, d, omega, SKY_BIAS)
        open_share = 1 if cover is None else 1 - cover
        open_share = open_share / dr.maximum(rgba.w, 0.02)
        radiance = radiance + vec3(rgba.x, rgba.y, rgba.z) * open_share
    radiance = radiance * dr.select(valid, weight * inv_n, 0)
    fresnel = brdf.schlick(v_h)
    return radiance * (1 - fresnel), radiance * fresnel


def _lamp_sample(
    tables: Tables, view: View, i: Any, side: Any, alpha: Any, n: Any, occluded: bool
) -> tuple[Any, Any, Any]:
    """Point i of the lamps' side² each. Returns its terms of E, B and A."""
    scene = tables.scene
    d, solid_angle, light = lamp_point(tables, i, side)
    light = light * dr.select(d.z > 0, solid_angle, 0)
    if occluded:
        # A point stands for its solid angle: the screen's edge hides it bit by bit.
        ps, pt, r, cos, _ = hit_screen(scene, view.x, d)
        ahead = cos > 1e-3
        size = dr.norm(dr.cross(scene.edge_x, scene.edge_y))
        width = r * dr.sqrt(solid_angle / (dr.select(ahead, cos, 1) * size)) + 1e-6
        light *= 1 - dr.select(ahead, _inside(ps, width) * _inside(pt, width), 0)
    s, t = brdf.frame(n)
    local = brdf.to_local(d, s, t, n)
    v = brdf.to_local(view.to_camera, s, t, n)
    v.z = dr.maximum(v.z, 1e-4)
    value, fresnel = brdf.specular(local, v, alpha)
    return (
        light * dr.maximum(local.z, 0),
        light * (value * (1 - fresnel)),
        light * (value * fresnel),
    )


def _inside(s: Any, width: Any) -> Any:
    """Share of [s - w/2, s + w/2] in [0, 1]."""
    return (dr.clip(dr.fma(width, 0.5, s), 0, 1) - dr.clip(dr.fma(width, -0.5, s), 0, 1)) / width


def _smooth_irradiance(tables: Tables, view: View, n: Any) -> Any:
    """Irradiance E without lamps for a screen wholly above the normal's horizon."""
    total = vector(tables.scene.scalar, 3)(0)
    if tables.sky_irradiance is not None:
        total = total + sky_irradiance_at(tables, n)
    if tables.vector_irradiance is not None and tables.screen is not None:
        a, b, c = vector_irradiance_at(tables, view.x)
        total = total + a * n.x + b * n.y + c * n.z
    return total


def _steep_sample(tables: Tables, view: View, i: Any, n: Any) -> Any:
    """Screen cell i's correction to E where it lies below the normal's horizon."""
    d, omega, radiance = screen_cell(tables, view.x, i, STEEP_SIDE)
    return radiance * (omega * dr.maximum(-dr.dot(n, d), 0))


def _is_steep(scene: Scene, view: View, n: Any) -> Any:
    """Whether the normal's horizon cuts the screen: then one of its corners is below."""
    lowest = dr.dot(scene.corner - view.x, n)
    sx, sy = dr.dot(scene.edge_x, n), dr.dot(scene.edge_y, n)
    return lowest + dr.minimum(sx, 0) + dr.minimum(sy, 0) < 0
