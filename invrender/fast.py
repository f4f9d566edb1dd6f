"""The fast estimator: few filtered samples, no noise in the diffuse term.

Diffuse light comes from tables of irradiance; specular light from visible-normal samples whose
look-ups are filtered to each sample's share of the lobe; lamps are summed one by one. The screen's
edge is as soft as the sample's footprint, so that pose and maps have gradients without edges. The
bias is that of the footprints and falls as samples grow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from invrender import brdf
from invrender.backend import dr, vector
from invrender.irradiance import screen_cell
from invrender.lamps import LAMP_SIDES, MAX_HOT
from invrender.pyramid import disc, disc_direction, disc_level, square_level
from invrender.scene import Scene, ScreenFrame, View, screen_frame, unit
from invrender.shading import Shading, Sums, with_tangents
from invrender.tables import Tables

SCREEN_BIAS, SKY_BIAS = 0.0, -0.5  # levels added to a look-up whose footprint is a sample's share
LAMP_SAMPLES = 256  # at least so many where a narrow lobe meets a lamp
STEEP_SIDE = 16  # screen cells a side where a normal's horizon cuts the screen


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
    screen = screen_frame(scene, view.x) if tables.screen is not None else None
    sums.add(sums.derive(lambda _, n: (_smooth_irradiance(tables, view, n),), rho, normal), (0,))
    if screen is not None:
        side = STEEP_SIDE * tables.detail
        cells = dr.select(_is_steep(scene, view, normal), uint(side * side), uint(0))

        def steep(i: Any) -> list[list[Any]]:
            d, omega, light = screen_cell(scene, tables.screen, tables.sky, view.x, i, side)
            return _along_normal(sums, normal, light * omega, d, -1)

        sums.run(dr.detach(cells), steep, (0,), "steep")

    n_samples = dr.opaque(uint, samples)
    inv_n = 1 / scalar(n_samples)
    if tables.lamps is not None:
        most = dr.maximum(n_samples, LAMP_SAMPLES)
        _add_lamps(sums, tables, screen, view, rho, normal, most)
    if tables.screen is not None or tables.sky is not None:

        def specular(i: Any) -> list[list[Any]]:
            f = lambda r, n: _sample(tables, screen, view, i, inv_n, r * r, n).flat()  # noqa: E731
            if not jacobian:
                return [_specular(tables, _Sample.of(tables, f(rho, normal)))]
            values, tangents = with_tangents(f, rho, normal)
            return _specular_rows(
                tables, _Sample.of(tables, values), [_Sample.of(tables, t) for t in tangents]
            )

        sums.run(n_samples, specular, (1, 2), "specular", inv_n)
    shading = sums.shading()
    # The sky behind the screen is subtracted: where that is nearly all of it, rounding may show.
    shading.irradiance = dr.maximum(shading.irradiance, 0)
    return shading


def _along_normal(sums: Sums, n: Any, light: Any, d: Any, sign: int = 1) -> list[list[Any]]:
    """Rows of light · max(±n·d, 0)."""
    cos = sign * dr.dot(n, d)
    rows = [light * dr.maximum(cos, 0)]
    if sums.jacobian:
        s, t = brdf.frame(n)
        light = light * dr.select(cos > 0, type(cos)(sign), 0)
        rows += [type(light)(0), light * dr.dot(s, d), light * dr.dot(t, d)]
    return [[r] for r in rows]


def _add_lamps(
    sums: Sums,
    tables: Tables,
    screen: ScreenFrame | None,
    view: View,
    rho: Any,
    normal: Any,
    samples: Any,
) -> None:
    """Lamps one by one, by Gauss's rule or, close to a narrow lobe's core, by its samples."""
    lamps = tables.lamps
    assert lamps is not None
    uint = type(samples)
    word = dr.uint64_array_t(uint)
    count = dr.opaque(uint, lamps.count)
    alpha, core, viewer = dr.detach((rho * rho, normal, view.to_camera))
    side_of = lambda lamp: lamps.points_a_side(lamp, viewer, core, alpha, samples)  # noqa: E731

    def irradiance(i: Any) -> list[list[Any]]:
        d, light = lamps.at(screen, i)
        return _along_normal(sums, normal, light, d)

    sums.run(count, irradiance, (0,), "lamp irradiance")

    points = LAMP_SIDES**2

    def lobe(i: Any) -> list[list[Any]]:
        lamp = i // points
        side = side_of(lamp)
        d, light = lamps.at(screen, lamp, i - lamp * points, dr.maximum(side, 1))
        light = dr.select(side > 0, light, 0)
        rows = sums.derive(lambda r, n: _lobe(view, r * r, n, d), rho, normal)
        return [[light * x for x in row] for row in rows]

    def next_point(i: Any) -> Any:
        lamp = i // points
        last = i - lamp * points + 1 >= dr.square(side_of(lamp))
        return dr.select(last, (lamp + 1) * points, i + 1)

    sums.run(count * points, lobe, (1, 2), "lamp lobes", following=next_point)

    def mark(lamp: Any, near: Any) -> tuple[Any, Any]:
        bit = word(1) << word(lamp)
        return lamp + 1, near | dr.select(side_of(lamp) == 0, bit, 0)

    narrow = dr.select(lamps.may_need_samples(alpha, samples), count, 0)
    _, near = dr.while_loop(
        (dr.zeros(uint, sums.width), dr.zeros(word, sums.width)),
        lambda lamp, _: lamp < narrow,
        mark,
        label="lamps in the lobe's core",
    )
    inv_n = 1 / type(alpha)(samples)

    def lamp_after(lamp: Any) -> Any:
        """The next marked lamp from this one on, 64 if there is none."""
        return uint(dr.tzcnt(dr.select(lamp < MAX_HOT, near & ~((word(1) << word(lamp)) - 1), 0)))

    def image(i: Any) -> list[list[Any]]:
        lamp = i // samples

        def terms(r: Any, n: Any) -> tuple[Any, Any]:
            sample = _sample(tables, screen, view, i - lamp * samples, inv_n, r * r, n)
            x, y, _ = sample.sky
            d = disc_direction(2 * x - 1, 1 - 2 * y, type(normal))
            light = lamps.tent(lamp, d) * dr.select(d.z > 0, sample.weight, 0)
            if tables.screen is not None and lamps.open < lamps.count:
                light = light * (1 - tables.screen(*sample.screen).w)
            return light * (1 - sample.fresnel), light * sample.fresnel

        return sums.derive(terms, rho, normal)

    def next_sample(i: Any) -> Any:
        lamp = i // samples
        last = i - lamp * samples + 1 >= samples
        return dr.select(last, lamp_after(lamp + 1) * samples, i + 1)

    first, stop = lamp_after(uint(0)) * samples, MAX_HOT * samples
    sums.run(stop, image, (1, 2), "lamp images", inv_n, next_sample, first)


@dataclass
class _Sample:
    """A sample of the specular lobe: what is looked up where, or a derivative of that.

    weight: G2/G1, or zero where nothing is reflected. screen: (s, 1 - t, level). sky: (x, y, level)
    on the disc's square.
    """

    weight: Any
    fresnel: Any
    screen: Any
    sky: Any

    def flat(self) -> tuple[Any, ...]:
        return (self.weight, self.fresnel, *self.screen, *self.sky)

    @staticmethod
    def of(tables: Tables, flat: Any) -> _Sample:
        """Inverse of `flat`."""
        weight, fresnel, *rest = flat
        n = 3 if tables.screen is not None else 0
        return _Sample(weight, fresnel, list(rest[:n]), list(rest[n:]))


def _sample(
    tables: Tables,
    screen: ScreenFrame | None,
    view: View,
    i: Any,
    inv_n: Any,
    alpha: Any,
    n: Any,
) -> _Sample:
    """Sample i of N of the specular integral, filtered to its share 1/(N·pdf) of the lobe.

    Smooth in α and n: directions move with the parameters.
    """
    scalar = type(alpha)
    s, t = brdf.frame(n)
    v = brdf.to_viewer(view.to_camera, s, t, n)
    # Rank-1 lattice (golden ratio) with a random rotation a pixel.
    u1 = unit(i * 2654435769 + view.hash, scalar)
    u2 = dr.fma(scalar(i), inv_n, 0.5 * inv_n)
    h = brdf.sample_vndf(v, alpha, u1, u2)
    v_h = dr.dot(v, h)
    local = dr.fma(h, 2 * v_h, -v)
    d = brdf.to_world(local, s, t, n)
    valid = (local.z > 0) & (d.z > -0.2)
    lz = dr.select(valid, local.z, 1)
    a2 = alpha * alpha
    root_l = dr.sqrt(dr.fma(a2, local.x * local.x + local.y * local.y, lz * lz))
    root_v = dr.sqrt(dr.fma(a2, v.x * v.x + v.y * v.y, v.z * v.z))
    weight = lz * (v.z + root_v) / dr.fma(v.z, root_l, lz * root_v)  # G2 / G1(v)
    pdf = brdf.ggx_d(h, alpha) / (2 * (v.z + root_v))
    omega = dr.minimum(inv_n / pdf, 2 * dr.pi)
    on_screen, on_sky = [], []
    if screen is not None and tables.screen is not None:
        ps, pt, r, cos, ahead = screen.hit(d)
        area = omega * r * r / (dr.select(ahead, cos, 1) * screen.area)
        # What does not meet the plane reads far outside.
        on_screen = [
            dr.select(ahead, ps, -8),
            dr.select(ahead, 1 - pt, -8),
            square_level(tables.screen.n, area) + SCREEN_BIAS,
        ]
    if tables.sky is not None:
        x, y = disc(d)
        level = disc_level(tables.sky.n, omega) + SKY_BIAS
        on_sky = [dr.fma(x, 0.5, 0.5), dr.fma(y, -0.5, 0.5), level]
    return _Sample(dr.select(valid, weight, 0), brdf.schlick(v_h), on_screen, on_sky)


MIN_COVER = 0.02  # of a sky footprint that the screen does not always hide


def _rgb(v: Any) -> Any:
    return vector(type(v.x), 3)(v.x, v.y, v.z)


def _specular(tables: Tables, sample: _Sample) -> list[Any]:
    """Terms of B and A."""
    light: Any = 0
    share: Any = 1
    if tables.screen is not None:
        rgba = tables.screen(*sample.screen)
        light, share = _rgb(rgba), 1 - rgba.w
    if tables.sky is not None:
        x, y, level = sample.sky
        rgba = tables.sky(x, y, level)
        light = light + _rgb(rgba) * (share / dr.maximum(rgba.w, MIN_COVER))
    light = light * sample.weight
    return [light * (1 - sample.fresnel), light * sample.fresnel]


def _specular_rows(tables: Tables, sample: _Sample, tangents: list[_Sample]) -> list[list[Any]]:
    """`_specular` and its tangents by the chain rule: one set of texels serves all of them."""

    def chain(slopes: list[Any], t: list[Any]) -> Any:
        return slopes[0] * t[0] + slopes[1] * t[1] + slopes[2] * t[2]

    light: Any = 0
    share: Any = 1
    d_light: list[Any] = [0] * 3
    d_share: list[Any] = [0] * 3
    if tables.screen is not None:
        rgba, *slopes = tables.screen.slopes(*sample.screen)
        light, share = _rgb(rgba), 1 - rgba.w
        for k, t in enumerate(tangents):
            d = chain(slopes, t.screen)
            d_light[k], d_share[k] = _rgb(d), -d.w
    if tables.sky is not None:
        x, y, level = sample.sky
        rgba, *slopes = tables.sky.slopes(x, y, level)
        inverse = 1 / dr.maximum(rgba.w, MIN_COVER)
        sky, share = _rgb(rgba), share * inverse
        light = light + sky * share
        for k, t in enumerate(tangents):
            d = chain(slopes, t.sky)
            change = dr.select(rgba.w > MIN_COVER, d.w, 0) * share
            d_light[k] = d_light[k] + _rgb(d) * share + sky * ((d_share[k] - change) * inverse)
    rows = [
        [light * (sample.weight * (1 - sample.fresnel)), light * (sample.weight * sample.fresnel)]
    ]
    for k, t in enumerate(tangents):
        slope = d_light[k] * sample.weight + light * t.weight
        bent = light * (sample.weight * t.fresnel)
        f = sample.fresnel
        rows.append([slope * (1 - f) - bent, slope * f + bent])
    return rows


def _lobe(view: View, alpha: Any, n: Any, d: Any) -> tuple[Any, Any]:
    """Factors of B and A of light from direction d."""
    s, t = brdf.frame(n)
    local = brdf.to_local(d, s, t, n)
    value, fresnel = brdf.specular(local, brdf.to_viewer(view.to_camera, s, t, n), alpha)
    return value * (1 - fresnel), value * fresnel


def _smooth_irradiance(tables: Tables, view: View, n: Any) -> Any:
    """Irradiance E without lamps for a screen wholly above the normal's horizon."""
    total = vector(tables.scene.scalar, 3)(0)
    if tables.sky_irradiance is not None:
        total = total + tables.sky_irradiance(n)
    if tables.vector_irradiance is not None:
        a, b, c = tables.vector_irradiance(view.x)
        total = total + a * n.x + b * n.y + c * n.z
    return total


def _is_steep(scene: Scene, view: View, n: Any) -> Any:
    """Whether the normal's horizon cuts the screen: then one of its corners is below."""
    lowest = dr.dot(scene.corner - view.x, n)
    sx, sy = dr.dot(scene.edge_x, n), dr.dot(scene.edge_y, n)
    return lowest + dr.minimum(sx, 0) + dr.minimum(sy, 0) < 0
