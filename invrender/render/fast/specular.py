"""Samples of the specular lobe, each with the light that the tables hold for its footprint.

A sample stands for the share 1/(N·pdf) of the lobe's directions; what it reads is the mean over
that much of the screen and of the sky. Directions move smoothly with roughness and normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from invrender.render import brdf
from invrender.render.backend import dr, vector
from invrender.render.fast.pyramid import disc, disc_level, square_level
from invrender.render.fast.tables import Tables
from invrender.render.scene import ScreenFrame, View, dimming, unit

SCREEN_BIAS, SKY_BIAS = 0.0, -0.5  # levels added to a look-up whose footprint is a sample's share
MIN_COVER = 0.02  # of a sky footprint that the screen does not always hide


@dataclass
class Sample:
    """A sample of the specular lobe: what is looked up where, or a derivative of that.

    weight: G2/G1, or zero where nothing is reflected. screen: (s, 1 - t, level). sky: (x, y, level)
    on the disc's square. dimming: of the display towards the sample, where it dims sideways.
    """

    weight: Any
    fresnel: Any
    screen: Any
    sky: Any
    dimming: Any = ()

    def flat(self) -> tuple[Any, ...]:
        return (self.weight, self.fresnel, *self.screen, *self.sky, *self.dimming)

    @staticmethod
    def of(tables: Tables, flat: Any) -> Sample:
        """Inverse of `flat`."""
        weight, fresnel, *rest = flat
        n = 3 if tables.screen is not None else 0
        m = n + 3 if tables.sky is not None else n
        return Sample(weight, fresnel, list(rest[:n]), list(rest[n:m]), list(rest[m:]))


def sample_lobe(
    tables: Tables,
    screen: ScreenFrame | None,
    view: View,
    i: Any,
    inv_n: Any,
    alpha: Any,
    n: Any,
) -> Sample:
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
    on_screen, on_sky, dims = [], [], []
    if screen is not None and tables.screen is not None:
        ps, pt, r, cos, ahead = screen.hit(d)
        area = omega * r * r / (dr.select(ahead, cos, 1) * screen.area)
        # What does not meet the plane reads far outside.
        on_screen = [
            dr.select(ahead, ps, -8),
            dr.select(ahead, 1 - pt, -8),
            square_level(tables.screen.n, area) + SCREEN_BIAS,
        ]
        if tables.scene.falloff is not None:
            dims = [dimming(tables.scene, dr.select(ahead, cos, 1))]
    if tables.sky is not None:
        x, y = disc(d)
        level = disc_level(tables.sky.n, omega) + SKY_BIAS
        on_sky = [dr.fma(x, 0.5, 0.5), dr.fma(y, -0.5, 0.5), level]
    return Sample(dr.select(valid, weight, 0), brdf.schlick(v_h), on_screen, on_sky, dims)


def _rgb(v: Any) -> Any:
    return vector(type(v.x), 3)(v.x, v.y, v.z)


def reflected(tables: Tables, sample: Sample) -> list[Any]:
    """Terms of B and A: screen, and sky where the screen does not cover the footprint."""
    light: Any = 0
    share: Any = 1
    if tables.screen is not None:
        rgba = tables.screen(*sample.screen)
        light, share = _rgb(rgba), 1 - rgba.w
        for dims in sample.dimming:
            light = light * dims
    if tables.sky is not None:
        rgba = tables.sky(*sample.sky)
        light = light + _rgb(rgba) * (share / dr.maximum(rgba.w, MIN_COVER))
    light = light * sample.weight
    return [light * (1 - sample.fresnel), light * sample.fresnel]


def reflected_rows(tables: Tables, sample: Sample, tangents: list[Sample]) -> list[list[Any]]:
    """`reflected` and its tangents by the chain rule: one set of texels serves all of them."""

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
            for dims, slope in zip(sample.dimming, t.dimming, strict=True):
                d_light[k] = d_light[k] * dims + light * slope
        for dims in sample.dimming:
            light = light * dims
    if tables.sky is not None:
        rgba, *slopes = tables.sky.slopes(*sample.sky)
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
