"""The ball to some hundredths of a pixel: its rim against the table that it mirrors.

The hemisphere's centre lies on the table. So a plane through the camera and that centre holds the
whole way of its rays: the photo shows it as one line, what the ball mirrors stays in it, and it
cuts the table in a line through the centre. On each such line the table outside the ball and its
image inside are one unknown function of the distance from the centre. Near the ball it is solved
for by linear least squares, at every step anew (variable projection: Golub and Pereyra 1973, with
Kaufman's derivative, 1975); farther out the photo shows it. The ball is where the rest is least:
at its outline the radiance drops by the mirror's reflectance, and inside it runs backwards.

The camera's tilt moves the horizon's image by a hundredth of the radius a degree and the outline
not at all, so that the two together tell it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import ndimage

from invrender.capture.ball_image import sample_image
from invrender.capture.ball_view import View, edges, horizon_curve, normals, outline_curve
from invrender.rig import Rig
from invrender.types import Array, Mask

FINE = 3  # points of a line to each of the view's pixels
SPACING = 0.014  # of the unknown table's nodes, in radii
ROUGH = 0.03  # usual second difference from one to the next, of the radiance's median
NEAREST, FARTHEST = 0.80, 3.0  # radii where the lines begin, and to which the table is looked up
# Lines, blur in the view's pixels, radii to which the table is unknown, steps, radii to start from.
STAGES = (
    (48, 2.0, 1.08, 4, (0.95, 0.975, 1.0, 1.025, 1.05)),
    (64, 1.0, 1.15, 6, (1.0,)),
    (144, 0.0, 1.25, 10, (1.0,)),
)
LIKELIEST = 2  # of a stage's starts, where the fit is not thorough
LUMA = (0.2126, 0.7152, 0.0722)  # a JPEG has its colours at half the resolution
# The unknowns: x, y, radius in metres; the camera's tilt in degrees about x and y; the logarithms
# of its blur in the view's pixels and of the mirror's reflectance over the rig's.
_TILT, _BLUR, _MIRROR = slice(3, 5), 5, 6
TILT_PRIOR, BLUR_PRIOR, MIRROR_PRIOR = 1.5, 0.15, 0.01
USUAL_BLUR = 0.8
OUT = 4.0  # spreads
ROBUST = 1.25  # spreads from which a residual counts less
GUESS = 0.01  # of the radiance: its spread, before it is known
FAITH = 0.004  # of the radiance: the least spread
HORIZON = 0.5  # of a pixel: the least spread of the horizon's edge
CORRELATED, EDGES_CORRELATED = 12.0, 10.0  # residuals side by side that tell the same


@dataclass(frozen=True)
class Rim:
    """``theta``: x, y, radius in metres in ``rig``, whose camera is tilted as fitted.

    ``deviation``: what the fit expects of the radius, relative (a standard deviation).
    """

    theta: Array
    rig: Rig
    deviation: float


def fit_rim(
    view: View, rig: Rig, theta: Array, thorough: bool = True, tilt: float = TILT_PRIOR
) -> Rim:
    """The ball near ``theta``: x, y, radius in metres, some hundredths of the radius off.

    ``view``: the photo out to about three radii, the ball some 60 pixels in radius. Levenberg's and
    Marquardt's steps, coarse to fine, with Cauchy's weights on the lines' residuals and on the
    distances from the horizon to the strongest edges near it. ``thorough``: from all of a stage's
    starts, not only from those that fit best as they are. ``tilt``: deviation of the camera's from
    what the rig tells, degrees.
    """
    p = np.array([*theta, 0.0, 0.0, math.log(USUAL_BLUR), 0.0])
    light = _mend(view.image @ np.array(LUMA, np.float32))
    for count, blur, limit, turns, scales in STAGES:
        lines = _Lines(view, light, rig, p, count, blur, limit, tilt)
        starts = [p * [1, 1, k, 1, 1, 1, 1] for k in scales]
        spread, edge = np.min([lines.spreads(q) for q in starts], axis=0)
        if len(starts) > LIKELIEST and not thorough:
            costs = [lines.solve(q, spread, edge, None).cost for q in starts]
            starts = [starts[i] for i in np.argsort(costs)[:LIKELIEST]]
        found = [lines.descend(q, turns, spread, edge) for q in starts]
        _, p, information = min(found, key=lambda f: f[0])
    spread = math.sqrt(np.linalg.inv(information)[2, 2])
    return Rim(p[:3], _tilted(rig, p), spread * float(lines.units[2, 2] / p[2]))


def _tilted(rig: Rig, p: Array) -> Rig:
    return _turned(rig, *p[_TILT])


@lru_cache(maxsize=64)
def _turned(rig: Rig, x: float, y: float) -> Rig:
    return replace(rig, camera_tilt=tuple(np.add(rig.camera_tilt, [x, y, 0])))


def _single(x: Any) -> Array:
    """Single precision: for what is as large as lines times points, which is what takes time."""
    return np.asarray(x, np.float32)


@dataclass(frozen=True)
class _Trace:
    """What the points of the lines see, (lines, points).

    ``mirrored`` and ``direct``: where they see the table, in radii from the ball's centre, by the
    mirror and past it; ``inside``: their share of the ball; ``far``: the table's radiance where it
    is mirrored from beyond the unknown part; ``hidden``: where the photo does not show that.
    ``seen``: (lines, samples), the photo along the lines.
    """

    mirrored: Array
    direct: Array
    inside: Array
    far: Array
    hidden: Mask
    seen: Array


@dataclass(frozen=True)
class _Fit:
    """A state of the fit: ``cost``, relative ``error`` and its robust ``weight`` (lines, samples),
    and the ``trace`` and ``horizon`` that it was made from.

    ``table``: (lines, nodes), over ``scale`` (lines, 1), the usual radiance; ``matrix`` (lines,
    samples, nodes) and ``solver``, its weighted pseudo-inverse.
    """

    cost: float
    error: Array
    weight: Array
    trace: _Trace
    horizon: tuple[Array, Array, Array, Array]
    table: Array
    matrix: Array
    solver: Array
    scale: Array


class _Lines:
    """The lines of one stage, from ``NEAREST`` radii to where the table is known."""

    def __init__(
        self, view: View, light: Array, rig: Rig, p: Array, count: int, blur: float, limit: float,
        tilt: float,
    ) -> None:  # fmt: skip
        self.view, self.rig, self.blur, self.limit = view, rig, blur, limit
        self.light = ndimage.gaussian_filter(light, blur) if blur else light
        self.farther = ndimage.gaussian_filter(light, blur + 1)
        outline = outline_curve(view, _tilted(rig, p), p, 2)
        self.radius = float(np.linalg.norm(outline[1] - outline[0])) / 2
        angle = np.arange(count) * (2 * math.pi / count)
        self.along = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], -1)
        low, high = NEAREST * self.radius, limit * self.radius - 1
        self.samples = np.arange(math.ceil(low), math.floor(high) + 1.0)
        self.points = _single(np.arange(low - 4 + 0.5 / FINE, high + 4, 1 / FINE))
        self.nodes = max(4, round(1 + (limit - 1) / (SPACING * (1 + blur))))
        bend = np.diff(np.eye(self.nodes), 2, axis=0)
        self.bend = bend.T @ bend / ROUGH**2
        self.mirror = float(np.asarray(rig.ball_reflectance) @ LUMA)
        # Steps of the unknowns. A tilt moves the whole image: the ball goes along with it.
        self.units = np.diag([*np.full(3, p[2] * 2e-3), 0.1, 0.1, 0.05, 0.01])
        aim = 0.1 * rig.camera[2] * math.radians(1)
        self.units[3, 1], self.units[4, 0] = aim, -aim
        deviation = [tilt, tilt, BLUR_PRIOR, MIRROR_PRIOR]
        self.prior = np.array([*np.full(3, 1e-9), *(1 / np.square(deviation))])
        self.usual = np.array([0, 0, 0, 0, 0, math.log(USUAL_BLUR), 0])

    def trace(self, p: Array) -> _Trace:
        """Rays in the planes of the lines: x along the table, from the ball's centre; y up."""
        rig, view, radius = _tilted(self.rig, p), self.view, p[2]
        centre = np.array([p[0], p[1], 0.0])
        to_camera = rig.camera - centre
        camera_x = self.along @ to_camera
        up = to_camera - camera_x[:, None] * self.along
        camera_y = np.sqrt((up * up).sum(-1))
        up /= camera_y[:, None]
        # A view's position is linear in the ray (x, y, -1) of the camera.
        middle = view.at(centre, rig)
        line = view.at(centre + 1.3 * radius * self.along, rig) - middle
        line /= np.sqrt((line * line).sum(-1))[:, None]
        focal = rig.focal(view.size[1]) / view.step
        start = -to_camera / (to_camera @ rig.camera_axes[2])
        turn = (line * [1 / focal, -1 / focal]) @ rig.camera_axes[:2]
        ray_x, ray_y = (
            _single(a @ start)[:, None] + _single((turn * a).sum(-1))[:, None] * self.points
            for a in (self.along, up)
        )
        length = np.sqrt(ray_x * ray_x + ray_y * ray_y)
        ray_x, ray_y = ray_x / length, ray_y / length
        # In radii: the ray's moment about the centre, and half its way through the circle.
        moment = _single(camera_x / radius)[:, None] * ray_y
        moment -= _single(camera_y / radius)[:, None] * ray_x
        half = np.sqrt(np.maximum(1 - moment * moment, 0))
        direct = np.abs(moment / ray_y)
        x, y = moment * ray_y - half * ray_x, -moment * ray_x - half * ray_y
        back_x, back_y = ray_x + 2 * half * x, ray_y + 2 * half * y
        mirrored = np.abs(x - back_x * (y / np.minimum(back_y, -1e-3)))
        mirrored[back_y > -0.03] = np.inf
        # The outline: where a ray touches the circle, or the rim on the table, if it is seen.
        touch = np.arctan2(camera_y, camera_x) - np.arccos(radius / np.hypot(camera_x, camera_y))
        touch = np.maximum(touch, 0)[:, None]
        edge = np.cos(touch) * self.along + np.sin(touch) * up
        outline = view.at(centre + radius * edge, rig) - middle
        outline = np.sqrt((outline * outline).sum(-1))[:, None]
        inside = np.clip((_single(outline) - self.points) * FINE + 0.5, 0, 1)

        seen = sample_image(self.light, middle + self.samples[:, None] * line[:, None])
        beyond = (mirrored > self.limit) & (inside > 0)
        far, hidden = np.zeros_like(mirrored), np.zeros(beyond.shape, bool)
        reach = np.minimum(mirrored[beyond], FARTHEST) * radius
        place = view.at(centre + reach[:, None] * self.along[np.nonzero(beyond)[0]], rig)
        shown = (place > 0).all(-1) & (place < self.light.shape[::-1]).all(-1)
        hidden[beyond] = ~shown | (mirrored[beyond] > FARTHEST)
        far[beyond] = sample_image(self.farther, place)
        return _Trace(mirrored, direct, inside, far, hidden, seen)

    def kernel(self, p: Array) -> Array:
        """Weights (samples, points) of the camera's blur along a line."""
        sigma = math.hypot(math.exp(p[_BLUR]), self.blur)
        weight = np.exp(-0.5 * ((self.samples[:, None] - self.points) / sigma) ** 2)
        return _single(weight / weight.sum(1, keepdims=True))

    def node(self, distance: Array) -> Array:
        """Where the unknown table has a distance from the centre, in nodes."""
        last = self.nodes - 1
        return np.clip((distance - 1) * (last / (self.limit - 0.98)), 0, last - 1e-3)

    def hats(self, distance: Array, weight: Array) -> Array:
        """The nodes' shares of a distance, times ``weight``: (lines, points, nodes)."""
        q = self.node(distance)
        i = q.astype(np.intp)
        out = np.zeros((q.size, self.nodes), np.float32)
        flat, row = out.reshape(-1), i.ravel() + self.nodes * np.arange(q.size)
        flat[row + 1] = (weight * (q - i)).ravel()
        flat[row] = weight.ravel() - flat[row + 1]
        return out.reshape(*q.shape, self.nodes)

    def solve(self, p: Array, spread: float, edge: float, weight: Array | None) -> _Fit:
        """The table that fits best with the ball at ``p``, and how well; ``spread`` and ``edge``:
        of the lines' residuals and of the horizon's, ``weight``: the samples' for the table."""
        t, kernel = self.trace(p), self.kernel(p)
        mirror = self.mirror * math.exp(p[_MIRROR])
        known = t.inside * (t.mirrored > self.limit)
        valid = (known * t.hidden) @ kernel.T < 0.02
        near = (t.inside - known) * mirror
        hats = self.hats(t.mirrored, near) + self.hats(t.direct, 1 - t.inside)
        matrix = kernel @ hats
        scale = np.median(t.seen, 1, keepdims=True) + 1e-3 * t.seen.mean() + 1e-9
        right = (t.seen - (known * t.far * mirror) @ kernel.T) / scale
        weight = _single(valid) if weight is None else valid * _single(weight)
        weighted = (matrix * weight[..., None]).transpose(0, 2, 1)
        smooth = spread**2 * self.bend + 1e-6 * np.eye(self.nodes)
        solver = _single(np.linalg.solve(weighted @ matrix + smooth, weighted))
        table = (solver @ right[..., None])[..., 0]
        error = right - (matrix @ table[..., None])[..., 0]
        relative = (error / (ROBUST * spread)) ** 2
        # A sample that the photo leaves open costs what a usual one does.
        cost = float(np.log1p(np.where(valid, relative, 0.25)).sum()) * ROBUST**2 / CORRELATED
        cost += float(np.sum((table @ self.bend) * table)) / CORRELATED
        horizon = self.horizon(p)
        *_, off, strength = horizon
        cost += float((strength * np.log1p((off / edge) ** 2)).sum()) / EDGES_CORRELATED
        cost += float(self.prior @ (self.off(p) ** 2))
        return _Fit(cost, error, valid / (1 + relative), t, horizon, table, matrix, solver, scale)

    def residual(self, p: Array, t: _Trace, fit: _Fit) -> Array:
        """The photo along the lines less what it should be with the ball at ``p``, relative."""
        table = fit.table
        row = np.arange(len(table))[:, None]

        def look(distance: Array) -> Array:
            q = self.node(distance)
            i = q.astype(int)
            return np.asarray(table[row, i] + (table[row, i + 1] - table[row, i]) * (q - i))

        inside = np.where(t.mirrored > self.limit, t.far / fit.scale, look(t.mirrored))
        light = t.inside * self.mirror * math.exp(p[_MIRROR]) * inside
        light += (1 - t.inside) * look(t.direct)
        return np.asarray(t.seen / fit.scale - light @ self.kernel(p).T)

    def off(self, p: Array) -> Array:
        """How far the unknowns are from what the prior expects; nought for the ball itself."""
        return (p - self.usual) * (np.arange(len(p)) >= 3)

    def horizon(self, p: Array) -> tuple[Array, Array, Array, Array]:
        """The horizon (n, 2), its normals, the signed distance to its edge, and that's weight."""
        curve = horizon_curve(self.view, _tilted(self.rig, p), p, 120)
        normal = normals(curve)
        reach = max(2.0, 0.05 * self.radius * 0.5 ** (3 - self.blur))
        return curve, normal, *edges(self.view, curve, normal, reach)

    def spreads(self, p: Array) -> tuple[float, float]:
        """The usual residual of the lines with the ball at ``p``, and of the horizon's edge."""
        fit = self.solve(p, GUESS, 1.0, None)
        rest = np.abs(fit.error[fit.weight > 0])
        *_, off, strength = fit.horizon
        strong = np.abs(off[strength > 0.1])
        edge = float(np.median(strong)) if strong.size else 0.0
        spread = float(np.median(rest)) if rest.size else 1.0
        return max(FAITH, 1.48 * spread), max(HORIZON, 1.48 * edge)

    def descend(
        self, p: Array, turns: int, spread: float, edge: float
    ) -> tuple[float, Array, Array]:
        """Steps from ``p`` on: the cost, the unknowns, their information in `units`."""
        start = self.solve(p, spread, edge, None)
        fit = self.solve(p, spread, edge, start.weight)
        damping = 1e-3
        information, gradient = self.normal_equations(p, fit, spread, edge)
        for _ in range(turns):
            for _ in range(4):
                damped = information + np.diag(np.diag(information)) * damping
                step = -np.linalg.solve(damped, gradient)
                step *= min(1, 8 / max(np.abs(step).max(), 1e-12))
                tried = self.solve(p + step @ self.units, spread, edge, fit.weight)
                if tried.cost < fit.cost:
                    break
                damping *= 8
            else:
                break
            gained = fit.cost - tried.cost
            p, fit, damping = p + step @ self.units, tried, max(damping / 5, 1e-4)
            information, gradient = self.normal_equations(p, fit, spread, edge)
            if gained < 0.05:
                break
        return fit.cost, p, information

    def normal_equations(
        self, p: Array, fit: _Fit, spread: float, edge: float
    ) -> tuple[Array, Array]:
        """Gauss–Newton's matrix (7, 7) and the gradient (7,), in `units`."""
        base = self.residual(p, fit.trace, fit)
        curve, normal, off, strength = fit.horizon
        lines, horizon = np.zeros((len(p), *base.shape)), np.zeros((len(p), len(curve)))
        for k, unit in enumerate(self.units):
            trace = fit.trace
            if k < _BLUR:  # blur and reflectance move no ray
                trace = self.trace(p + unit)
                moved = horizon_curve(self.view, _tilted(self.rig, p + unit), p + unit, len(curve))
                horizon[k] = np.sum((moved - curve) * normal, -1)
            lines[k] = self.residual(p + unit, trace, fit) - base
        slope = lines - (fit.matrix @ (fit.solver @ lines[..., None]))[..., 0]
        slope = slope.reshape(len(p), -1)
        weighted = slope * (fit.weight.reshape(-1) / spread**2 / CORRELATED)
        matrix = self.units @ np.diag(self.prior) @ self.units.T + weighted @ slope.T
        gradient = self.units @ (self.prior * self.off(p)) + weighted @ fit.error.reshape(-1)
        weighted = horizon * (strength / (1 + (off / edge) ** 2) / edge**2 / EDGES_CORRELATED)
        return matrix + weighted @ horizon.T, gradient - weighted @ off


def _mend(image: Array) -> Array:
    """The image (h, w) with single pixels replaced that stand out from the eight around them."""
    usual = ndimage.median_filter(image, 3)
    off = np.abs(image - usual)
    return np.where(off > OUT * 1.48 * np.median(off), usual, image)
