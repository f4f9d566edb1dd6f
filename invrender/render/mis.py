"""The unbiased estimator: multiple importance sampling of screen, environment and normals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter

from invrender.render import brdf
from invrender.render.backend import dr, vector
from invrender.render.renderer import Renderer
from invrender.render.scene import (
    Scene,
    View,
    aligned,
    dimming,
    environment_at,
    equirect_uv,
    hash_bits,
    pattern_at,
    screen_frame,
    unit,
)
from invrender.render.shading import Shading, Sums


@dataclass
class EnvironmentSampler:
    """Importance sampling of the environment above the table.

    The density follows the largest of each texel's 3 × 3 neighbours, so that it is nowhere zero
    where the bilinear radiance is not.
    """

    row_cdf: Any
    column_cdf: Any  # flat, a row each
    density: Any  # flat, over (u, v) in [0, 1]²
    height: int

    @staticmethod
    def build(scene: Scene) -> EnvironmentSampler | None:
        """None where there is no environment above the table."""
        if scene.environment is None:
            return None
        scalar, h = scene.scalar, scene.env_height
        env = np.asarray(dr.detach(scene.environment)).reshape(h, 2 * h, 3).astype(np.float64)
        mean = maximum_filter(env.mean(-1), size=3, mode=("nearest", "wrap"))
        edges = np.linspace(0, np.pi, h + 1)
        weight = mean * -np.diff(np.cos(edges))[:, None]
        weight[edges[:-1] >= np.pi / 2] = 0
        if weight.sum() <= 0:
            return None
        weight /= weight.sum()
        rows = weight.sum(1)
        columns = np.cumsum(weight, 1) / np.maximum(rows, 1e-300)[:, None]
        flat = lambda a: scalar(aligned(a.ravel(), scalar))  # noqa: E731
        return EnvironmentSampler(flat(rows.cumsum()), flat(columns), flat(weight * 2 * h * h), h)

    def sample(self, u1: Any, u2: Any) -> tuple[Any, Any]:
        """(unit direction, density in 1/sr) for uniform (u1, u2)."""
        scalar = type(u1)
        uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
        h, w = self.height, 2 * self.height

        def invert(cdf: Any, offset: Any, n: int, u: Any) -> tuple[Any, Any]:
            i = dr.binary_search(0, n - 1, lambda k: dr.gather(scalar, cdf, offset + k) < u)
            low = dr.select(i > 0, dr.gather(scalar, cdf, offset + i - 1, i > 0), 0)
            high = dr.gather(scalar, cdf, offset + i)
            within = (u - low) / dr.maximum(high - low, 1e-30)
            return i, dr.clip(within, 0, 1)

        row, fv = invert(self.row_cdf, uint(0), h, u1)
        column, fu = invert(self.column_cdf, row * w, w, u2)
        # Within a row, uniform in cos θ, that is in solid angle.
        top = dr.cos(scalar(row) * (dr.pi / h))
        bottom = dr.cos((scalar(row) + 1) * (dr.pi / h))
        cos_theta = dr.lerp(top, bottom, fv)
        sin_theta = dr.safe_sqrt(1 - cos_theta * cos_theta)
        sin_phi, cos_phi = dr.sincos((scalar(column) + fu) * (dr.pi / h))
        d = vec3(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)
        return d, self._pdf(row, row * w + column)

    def pdf(self, d: Any) -> Any:
        """Density of `sample` at unit directions d, 1/sr."""
        h = self.height
        uint = dr.uint32_array_t(type(d.x))
        u, v = equirect_uv(d)
        row = dr.minimum(uint(v * h), h - 1)
        return self._pdf(row, row * (2 * h) + dr.minimum(uint(u * (2 * h)), 2 * h - 1))

    def _pdf(self, row: Any, texel: Any) -> Any:
        scalar = type(self.density)
        h = self.height
        # cos a - cos b = 2 sin((a + b)/2) sin((b - a)/2), without cancellation
        band = 2 * dr.sin((scalar(row) + 0.5) * (dr.pi / h)) * math.sin(0.5 * math.pi / h)
        return dr.gather(scalar, self.density, texel) / (band * h * 2 * dr.pi)


class Mis(Renderer):
    """The unbiased estimator, prepared for a scene.

    sampler: of another scene whose environment has the same shares, where they must not change.
    """

    def __init__(self, scene: Scene, sampler: EnvironmentSampler | None = None) -> None:
        super().__init__(scene)
        self.sampler = sampler or EnvironmentSampler.build(scene)

    @property
    def traced(self) -> tuple[Any, ...]:
        return self.scene, self.sampler

    def _shade(
        self, view: View, roughness: Any, normal: Any, samples: int, jacobian: bool
    ) -> Shading:
        return shade_mis(self.scene, self.sampler, view, roughness, normal, samples, jacobian)


def shade_mis(
    scene: Scene,
    sampler: EnvironmentSampler | None,
    view: View,
    rho: Any,
    normal: Any,
    samples: int,
    jacobian: bool = False,
    proposal: tuple[Any, Any] | None = None,
) -> Shading:
    """The unbiased estimator: one sample of each technique in each of ``samples`` rounds.

    The screen's area, the environment (where the screen does not hide it) and the visible normals,
    combined by the balance heuristic; directions and densities are detached, and follow the
    roughness and normal of ``proposal`` where one is given (to hold them while those vary). Random
    numbers are rotated rank-1 lattices, so that errors fall faster than 1/√N.

    Where the screen's pose carries gradients, a direction that meets the screen is held at its
    (s, t) on the screen, and the environment behind is subtracted there and added in all
    directions: over (s, t) the domain is fixed, so no visibility edge is ever differentiated.
    """
    scalar = scene.scalar
    uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
    has_screen, has_env = scene.pattern is not None, sampler is not None
    moving = dr.grad_enabled(scene.corner, scene.edge_x, scene.edge_y, scene.camera)
    fixed = dr.detach(scene)
    x, to_camera = dr.detach(view.x), dr.detach(view.to_camera)
    screen = screen_frame(fixed, x)
    n_samples = dr.opaque(uint, samples)

    def lobe(d: Any, rho: Any, n: Any) -> tuple[Any, Any, Any]:
        """Cosine and the two specular terms at direction d."""
        s, t = brdf.frame(n)
        v = brdf.to_viewer(view.to_camera, s, t, n)
        local = brdf.to_local(d, s, t, n)
        value, fresnel = brdf.specular(local, v, rho * rho)
        return dr.maximum(local.z, 0), value * (1 - fresnel), value * fresnel

    def density(d: Any, frame: tuple[Any, Any, Any], v: Any, alpha: Any) -> Any:
        return brdf.pdf_vndf(brdf.to_local(d, *frame), v, alpha)

    def contribution(d: Any, alpha: Any, frame: Any, v: Any, rho: Any, n: Any, kind: str) -> Any:
        """Terms of E, B, A for a sampled direction d; kind names the technique it came from."""
        d = dr.detach(d)
        p_v = density(d, frame, v, alpha)
        terms = [vec3(0), vec3(0), vec3(0)]
        on_screen = dr.mask_t(scalar)(False)
        if has_screen:
            ps, pt, r, cos, ahead = screen.hit(d)
            on_screen = ahead & (ps >= 0) & (ps < 1) & (pt >= 0) & (pt < 1)
            p_s = r * r / (dr.select(on_screen, cos, 1) * screen.area)
            weight = dr.select(on_screen & (d.z > 0), 1 / (p_s + p_v), 0)
            if kind != "environment":
                if moving:
                    to = scene.corner + ps * scene.edge_x + pt * scene.edge_y - view.x
                    r2 = dr.squared_norm(to)
                    moved = to * dr.rsqrt(r2)
                    m = dr.cross(scene.edge_x, scene.edge_y)
                    g = dr.dot(m, moved)
                    cos = g * dr.rsqrt(dr.squared_norm(m))
                    g = g / r2
                    g = g / dr.select(on_screen, dr.detach(g), 1)
                else:
                    moved, g = d, scalar(1)
                light = pattern_at(scene, ps, pt)
                if scene.falloff is not None:
                    light = light * dimming(scene, cos)
                if moving and has_env:
                    light = light - environment_at(scene, moved)
                f = lobe(moved, rho, n)
                terms = [light * (k * weight * g) for k in f]
                if moving and has_env:
                    light = environment_at(scene, d)
                    terms = [
                        a + light * (k * weight)
                        for a, k in zip(terms, lobe(d, rho, n), strict=True)
                    ]
        if has_env and kind != "screen":
            assert sampler is not None
            p = sampler.pdf(d) + p_v
            weight = dr.select(~on_screen & (d.z > 0) & (p > 0), 1 / p, 0)
            light = environment_at(scene, d)
            terms = [a + light * (k * weight) for a, k in zip(terms, lobe(d, rho, n), strict=True)]
        return terms

    def sample(i: Any, rho: Any, n: Any) -> tuple[Any, ...]:
        rho0, n0 = (dr.detach(rho), dr.detach(n)) if proposal is None else proposal
        alpha = rho0 * rho0
        frame = (*brdf.frame(n0), n0)
        v = brdf.to_viewer(to_camera, *frame)
        # Roberts' R2 lattice in 32-bit integers, rotated by random bits a pixel and technique.
        a, b = i * 3242174889, i * 2447445414
        bits = view.hash
        total = [vec3(0), vec3(0), vec3(0)]

        def pair(bits: Any) -> tuple[Any, Any, Any]:
            second = hash_bits(bits, bits)
            return unit(a + bits, scalar), unit(b + second, scalar), second

        directions = {}
        if has_screen:
            u1, u2, bits = pair(bits)
            to = fixed.corner + u1 * fixed.edge_x + u2 * fixed.edge_y - x
            directions["screen"] = dr.normalize(to)
        if sampler is not None:
            u1, u2, bits = pair(hash_bits(bits, bits + 1))
            directions["environment"] = sampler.sample(u1, u2)[0]
        u1, u2, bits = pair(hash_bits(bits, bits + 2))
        h = brdf.sample_vndf(v, alpha, u1, u2)
        local = dr.fma(h, 2 * dr.dot(v, h), -v)
        directions["lobe"] = brdf.to_world(local, *frame)
        for kind, d in directions.items():
            terms = contribution(d, alpha, frame, v, rho, n, kind)
            total = [p + q for p, q in zip(total, terms, strict=True)]
        return tuple(total)

    width = max(dr.width(view.x), dr.width(rho), dr.width(normal))
    sums = Sums(vec3, width, jacobian)
    if has_screen or has_env:
        rows = lambda i: sums.derive(lambda r, n: sample(i, r, n), rho, normal)  # noqa: E731
        sums.run(n_samples, rows, (0, 1, 2), "mis", 1 / scalar(n_samples))
    return sums.shading()
