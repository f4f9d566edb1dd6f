"""Lamps: the few brightest texels of an environment, summed one by one.

A lamp is a texel's bilinear tent. For what varies slowly over it, diffuse light and lobes that are
wide or far away, it is a few points of Gauss's rule, and the screen's edge covers each of them bit
by bit. In a narrow lobe close to its mirror image it is read where the lobe's samples meet it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from invrender.render.backend import dr, vector
from invrender.render.scene import Scene, ScreenFrame, aligned, equirect_uv, hit_screen

HOT_SHARE = 0.004  # a texel whose flux exceeds this share of the environment's is a lamp of its own
MAX_HOT = 64  # as many as a word has bits
MIN_COS = 0.3  # of the angle of incidence, where the width of a lamp in half vectors is bounded
LAMP_SIDES = 4  # at most so many points a side in a lamp


@dataclass
class Lamps:
    """Points, texels, radiance (flat RGB) and number of the lamps that the screen does not always
    hide.

    texels: row and column of each in an environment of ``height`` rows. The first ``open`` lamps
    are hidden from no part of the sample.
    """

    points: Any
    texels: Any
    radiance: Any
    count: int
    open: int
    height: int

    def at(
        self, screen: ScreenFrame | None, lamp: Any, k: Any = 0, side: Any = 1
    ) -> tuple[Any, Any]:
        """Point k of side² of a lamp: (direction, radiance × solid angle that reaches x)."""
        scalar = type(self.points)
        vec3, vec4 = vector(scalar, 3), vector(scalar, 4)
        # Points of the coarser subdivisions come before: 0, 1, 1 + 4, 1 + 4 + 9 a lamp.
        before = (side - 1) * side * (2 * side - 1) // 6 * dr.opaque(type(lamp), self.count)
        i = before + lamp * (side * side) + k
        point = dr.gather(vec4, self.points, 2 * i)
        d = vec3(point.x, point.y, point.z)
        light = dr.gather(vec3, self.radiance, lamp)
        light = light * dr.select(d.z > 0, point.w, 0)
        if screen is None or self.open == self.count:
            return d, light
        # The screen's edge covers the point's tent bit by bit: project its widths to (s, t).
        extent = dr.gather(vec4, self.points, 2 * i + 1)
        ps, pt, r, cos, ahead = screen.hit(d)
        cos = dr.select(ahead, cos, 1)
        inverse_sin2 = dr.rcp(dr.maximum(1 - d.z * d.z, 1e-6))

        def inside(p: Any, along: Any) -> Any:
            slope = dr.fma(screen.normal, -dr.dot(d, along) / cos, along)  # ⟂ d, times r
            across = dr.square(slope.y * d.x - slope.x * d.y) * inverse_sin2
            down = dr.maximum(dr.squared_norm(slope) - across, 0)
            width = r * dr.sqrt(
                dr.fma(dr.square(extent.x), down, dr.square(extent.y) * across) + _TINY
            )
            return _tent_below(p / width) - _tent_below((p - 1) / width)

        covered = inside(ps, screen.along_s) * inside(pt, screen.along_t)
        return d, light * (1 - dr.select(ahead, covered, 0))

    def points_a_side(self, lamp: Any, to_camera: Any, normal: Any, alpha: Any, n: Any) -> Any:
        """Points a side for the integral of a lobe over a lamp, 0 for the lobe's own n samples.

        Gauss's rule with k points errs by ρ^-2k where the lobe's poles, at tan θ_h = iα, lie on the
        ellipse about the lamp whose foci are its edges and whose axes, in half-widths of the lamp,
        add up to 2ρ. It is to err by less than 1/n.
        """
        uint = dr.uint32_array_t(type(alpha))
        d, _ = self.at(None, lamp)
        h = dr.normalize(d + to_camera)
        width = self._half_width(dr.dot(h, to_camera))
        cos = dr.dot(h, normal)
        x, y2 = dr.safe_sqrt(1 - cos * cos) / width, dr.square(alpha / width)
        to_foci = dr.sqrt(dr.fma(x - 1, x - 1, y2)) + dr.sqrt(dr.fma(x + 1, x + 1, y2))
        side = uint(1)
        for k in range(1, LAMP_SIDES + 1):
            more = k + 1 if k < LAMP_SIDES else 0
            side = dr.select(to_foci < _foci_sum(n, k, type(alpha)), more, side)
        # Two or three points cover a lamp in steps that the screen's edge shows.
        cut = lamp >= dr.opaque(uint, self.open)
        return dr.select(cut & (side > 1), LAMP_SIDES, side)

    def may_need_samples(self, alpha: Any, n: Any) -> Any:
        """Whether `points_a_side` can be 0: only for a narrow lobe."""
        y2 = dr.square(alpha / self._half_width(type(alpha)(MIN_COS)))
        return 2 * dr.sqrt(1 + y2) < _foci_sum(n, LAMP_SIDES, type(alpha))

    def _half_width(self, cos: Any) -> Any:
        """Of a lamp as half vectors see it, radians; cos: of the angle of incidence on them."""
        return (0.5 * dr.pi / self.height) / dr.maximum(cos, MIN_COS)

    def tent(self, lamp: Any, d: Any) -> Any:
        """Radiance of a lamp along unit directions d."""
        scalar, uint = type(self.points), type(lamp)
        u, v = equirect_uv(d)
        row = dr.gather(scalar, self.texels, 2 * lamp)
        column = dr.gather(scalar, self.texels, 2 * lamp + 1)
        y = dr.abs(dr.clip(v * self.height - 0.5, 0, self.height - 1) - row)
        x = dr.abs(u * (2 * self.height) - 0.5 - column)
        x = dr.minimum(x, 2 * self.height - x)
        weight = dr.maximum(1 - x, 0) * dr.maximum(1 - y, 0)
        return dr.gather(vector(scalar, 3), self.radiance, uint(lamp)) * weight


def _foci_sum(n: Any, k: int, scalar: type) -> Any:
    """ρ + 1/ρ of the ellipse where Gauss's rule with k points errs by 1/n."""
    rho = scalar(n) ** (0.5 / k)
    return rho + 1 / rho


def split_lamps(scene: Scene) -> tuple[Lamps | None, Any]:
    """(lamps, what is left of the environment when they are taken out).

    A texel above the table whose flux exceeds `HOT_SHARE` of the whole keeps that share; what is
    above becomes a lamp. The split is a constant factor a texel, so both parts stay linear in the
    environment. Lamps that the screen hides from the whole sample are left out.
    """
    scalar = scene.scalar
    uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
    h = scene.env_height
    w = 2 * h
    env = np.asarray(dr.detach(scene.environment)).reshape(h, w, 3).astype(np.float64)
    theta = (np.arange(h) + 0.5) / h * np.pi
    flux = env.mean(-1) * np.sin(theta)[:, None]
    flux[theta > np.pi / 2] = 0
    limit = HOT_SHARE * flux.sum()
    hot = np.flatnonzero(flux > limit)
    hot = hot[np.argsort(-flux.ravel()[hot], kind="stable")][:MAX_HOT]
    if not len(hot):
        return None, scene.environment
    keep = np.ones(h * w)
    keep[hot] = limit / flux.ravel()[hot]
    rest = scene.environment * scalar(aligned(np.repeat(keep, 3), scalar))
    theta, phi = (hot // w + 0.5) * np.pi / h, (hot % w + 0.5) * np.pi / h
    directions = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    d = vec3(*(scalar(aligned(c, scalar)) for c in directions))
    hidden, partly = (
        np.broadcast_to(np.array(m), len(hot)) for m in corner_hits(dr.detach(scene), d, np.pi / h)
    )
    hot = np.concatenate([hot[~partly], hot[partly & ~hidden]])
    if not len(hot):
        return None, rest
    flat = (3 * hot[:, None] + np.arange(3)).ravel()
    radiance = dr.gather(scalar, scene.environment, uint(aligned(flat, uint))) * scene.scale
    radiance = radiance * scalar(aligned(1 - np.repeat(keep[hot], 3), scalar))
    points = scalar(aligned(_points(hot, h), scalar))
    texels = scalar(aligned(np.stack([hot // w, hot % w], -1).ravel(), scalar))
    return Lamps(points, texels, radiance, len(hot), int((~partly).sum()), h), rest


def corner_hits(scene: Scene, d: Any, margin: float) -> tuple[Any, Any]:
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
    half = scene.half
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


def _points(hot: np.ndarray, h: int) -> np.ndarray:
    """Each lamp's points: Gauss's rule for its bilinear tent, 1 to `LAMP_SIDES` points a side.

    A point: direction and solid angle, then half-widths in radians along θ and φ, for the screen's
    edge to cover it bit by bit.
    """
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
    return np.concatenate(blocks)


def _gauss_tent(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of the n-point Gauss rule for the weight 1 - |x| on [-1, 1]."""
    # Golub and Welsch: the recurrence's coefficients from the moments 2/((k+1)(k+2)), k even.
    moments = [0 if k % 2 else 2 / ((k + 1) * (k + 2)) for k in range(2 * n + 1)]
    hankel = np.array([[moments[i + j] for j in range(n + 1)] for i in range(n + 1)])
    r = np.linalg.cholesky(hankel).T
    off = [r[k + 1, k + 1] / r[k, k] for k in range(n - 1)]
    nodes, vectors = np.linalg.eigh(np.diag(off, 1) + np.diag(off, -1))
    return nodes, vectors[0] ** 2


_TINY = 1e-30  # keeps the square root's slope finite


def _tent_below(x: Any) -> Any:
    """Integral of the tent 1 - |x| from -1 to x."""
    x = dr.clip(x, -1, 1)
    return 0.5 + x - 0.5 * x * dr.abs(x)
