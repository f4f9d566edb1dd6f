"""The ball to some hundredths of a pixel: its rim against the table that it mirrors.

A plane through the camera and the ball's centre holds the whole way of its rays: the photo shows
it as one line, what the ball mirrors stays in it, and it cuts the table in a line through one
point: the foot, where the line from the camera through the centre meets the table. (A hemisphere's
centre is its own foot.) On each such line the table outside the ball and its image inside are one
unknown function of the distance from the foot. Near the ball it is solved
for by linear least squares, at every step anew (variable projection: Golub and Pereyra 1973, with
Kaufman's derivative, 1975); farther out the photo shows it. The ball is where the residuals are
least: at its outline the radiance drops by the mirror's reflectance, and inside it runs backwards.

The camera's tilt moves the horizon's image by a hundredth of the radius a degree and the outline
not at all, so that the two together determine it.
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
from invrender.capture.least_squares import minimise
from invrender.capture.mirror import ball_centre
from invrender.capture.robust import spread as robust_spread
from invrender.capture.settings import LUMINANCE, RIM_FIT
from invrender.rig import Rig
from invrender.types import Array, Mask

# The unknowns: x, y, radius in metres; the camera's tilt in degrees about x and y; the logarithms
# of its blur in the view's pixels and of the mirror's reflectance over the rig's.
_RIM_TILT, _RIM_BLUR, _MIRROR = slice(3, 5), 5, 6


@dataclass(frozen=True)
class Rim:
    """``circle``: x, y, radius in metres in ``rig``, whose camera is tilted as fitted.

    ``deviation``: what the fit expects of the radius's error, relative (a standard deviation);
    ``tilt_deviation``: the same of the camera's tilt in its worst direction, degrees.
    """

    circle: Array
    rig: Rig
    deviation: float
    tilt_deviation: float


def fit_rim(
    view: View,
    rig: Rig,
    circle: Array,
    thorough: bool = True,
    tilt_deviation: float = RIM_FIT.tilt_deviation,
    reflectance_deviation: float = RIM_FIT.reflectance_deviation,
) -> Rim:
    """The ball near ``circle``: x, y, radius in metres, some hundredths of the radius off.

    ``view``: the photo out to about three radii, the ball some 60 pixels in radius. Levenberg's and
    Marquardt's steps, coarse to fine, with Cauchy's weights on the lines' residuals and on the
    distances from the horizon to the strongest edges near it. ``thorough``: from all of a stage's
    starts, not only from those that fit best as they are. ``tilt_deviation``: expected error of the
    rig's camera tilt, degrees. ``reflectance_deviation``: of the logarithm of the rig's mirror.
    """
    p = np.array([*circle, 0.0, 0.0, math.log(RIM_FIT.expected_blur), 0.0])
    light = _without_outliers(view.image @ np.array(LUMINANCE, np.float32))
    for count, blur, limit, turns, scales in RIM_FIT.stages:
        lines = _Lines(
            view, light, rig, p, count, blur, limit, tilt_deviation, reflectance_deviation
        )
        starts = [p * [1, 1, k, 1, 1, 1, 1] for k in scales]
        spread, edge = np.min([lines.spreads(q) for q in starts], axis=0)
        if len(starts) > RIM_FIT.starts and not thorough:
            costs = [lines.solve(q, spread, edge, None).cost for q in starts]
            starts = [starts[i] for i in np.argsort(costs)[: RIM_FIT.starts]]
        found = [lines.descend(q, turns, spread, edge) for q in starts]
        _, p, information = min(found, key=lambda f: f[0])
    covariance = lines.units.T @ np.linalg.inv(information) @ lines.units
    tilt = math.sqrt(float(np.linalg.eigvalsh(covariance[_RIM_TILT, _RIM_TILT])[-1]))
    return Rim(p[:3], _tilted(rig, p), math.sqrt(covariance[2, 2]) / float(p[2]), tilt)


def _tilted(rig: Rig, p: Array) -> Rig:
    return _turned(rig, *p[_RIM_TILT])


@lru_cache(maxsize=64)
def _turned(rig: Rig, x: float, y: float) -> Rig:
    return replace(rig, camera_tilt=tuple(np.add(rig.camera_tilt, [x, y, 0])))


def _single(x: Any) -> Array:
    """Single precision: for what is as large as lines times points, which is what takes time."""
    return np.asarray(x, np.float32)


@dataclass(frozen=True)
class _Trace:
    """What the points of the lines see, (lines, points).

    ``mirrored`` and ``direct``: where they see the table, by the mirror and past it, as distances
    from the foot over that at which the ball's outline hides it, about one radius; ``inside``:
    their share of the ball; ``far``: the table's radiance where it is mirrored from beyond the
    unknown part; ``hidden``: where the photo does not show that. ``seen``: (lines, samples), the
    photo along the lines.
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

    ``table``: (lines, nodes), over ``scale`` (lines, 1), the median radiance; ``matrix`` (lines,
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
    """The lines of one stage, from `RIM_FIT.nearest` radii to where the table is known."""

    def __init__(
        self, view: View, light: Array, rig: Rig, p: Array, count: int, blur: float, limit: float,
        tilt_deviation: float, reflectance_deviation: float = RIM_FIT.reflectance_deviation,
    ) -> None:  # fmt: skip
        self.view, self.rig, self.blur, self.limit = view, rig, blur, limit
        self.light = ndimage.gaussian_filter(light, blur) if blur else light
        self.farther = ndimage.gaussian_filter(light, blur + 1)
        outline = outline_curve(view, _tilted(rig, p), p, 2)
        self.radius = float(np.linalg.norm(outline[1] - outline[0])) / 2
        angle = np.arange(count) * (2 * math.pi / count)
        self.along = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], -1)
        low, high = RIM_FIT.nearest * self.radius, limit * self.radius - 1
        self.samples = np.arange(math.ceil(low), math.floor(high) + 1.0)
        fine, margin = RIM_FIT.points_a_pixel, RIM_FIT.margin
        self.points = _single(np.arange(low - margin + 0.5 / fine, high + margin, 1 / fine))
        self.nodes = max(4, round(1 + (limit - 1) / (RIM_FIT.node_spacing * (1 + blur))))
        bend = np.diff(np.eye(self.nodes), 2, axis=0)
        self.bend = bend.T @ bend / RIM_FIT.roughness**2
        self.mirror = float(np.asarray(rig.ball_reflectance) @ LUMINANCE)
        # Steps of the unknowns. A tilt moves the whole image: the ball goes along with it.
        steps = np.array(RIM_FIT.steps)
        steps[:3] *= p[2]
        self.units = np.diag(steps)
        aim = steps[3] * rig.camera[2] * math.radians(1)
        self.units[3, 1], self.units[4, 0] = aim, -aim
        deviation = [tilt_deviation] * 2 + [RIM_FIT.blur_deviation, reflectance_deviation]
        self.prior = np.array([RIM_FIT.position_precision] * 3 + [1 / d**2 for d in deviation])
        self.expected = np.array([0, 0, 0, 0, 0, math.log(RIM_FIT.expected_blur), 0])

    def trace(self, p: Array) -> _Trace:
        """Rays in the planes of the lines: x along the table, from the foot; y up."""
        rig, view, radius = _tilted(self.rig, p), self.view, p[2]
        centre = ball_centre(rig, p)
        share = centre[2] / rig.camera[2]  # of the way from the foot to the camera
        foot = (centre - share * rig.camera) / (1 - share)
        to_camera = rig.camera - foot
        camera_x = self.along @ to_camera
        up = to_camera - camera_x[:, None] * self.along
        camera_y = np.sqrt((up * up).sum(-1))
        up /= camera_y[:, None]
        # A view's position is linear in the ray (x, y, -1) of the camera.
        middle = view.at(centre, rig)
        line = view.at(foot + RIM_FIT.toward * radius * self.along, rig) - middle
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
        from_centre = (1 - share) / radius
        moment = _single(from_centre * camera_x)[:, None] * ray_y
        moment -= _single(from_centre * camera_y)[:, None] * ray_x
        half = np.sqrt(np.maximum(1 - moment * moment, 0))
        direct = np.abs(moment / ray_y)
        x, y = moment * ray_y - half * ray_x, -moment * ray_x - half * ray_y
        back_x, back_y = ray_x + 2 * half * x, ray_y + 2 * half * y
        # From the centre's to the foot's coordinates; where it is a hemisphere, nothing changes.
        x, y = (q + _single(share * c / radius)[:, None] for q, c in ((x, camera_x), (y, camera_y)))
        mirrored = np.abs(x - back_x * (y / np.minimum(back_y, -RIM_FIT.least_downward)))
        mirrored *= np.float32(1 - share)
        mirrored[back_y > -RIM_FIT.downward] = np.inf
        # The outline: where a ray touches the circle, or a hemisphere's rim, if that is seen.
        cosine = 1 / (from_centre * np.hypot(camera_x, camera_y))
        touch = np.arctan2(camera_y, camera_x) - np.arccos(cosine)
        touch = (touch if share else np.maximum(touch, 0))[:, None]
        edge = np.cos(touch) * self.along + np.sin(touch) * up
        outline = view.at(centre + radius * edge, rig) - middle
        outline = np.sqrt((outline * outline).sum(-1))[:, None]
        inside = (_single(outline) - self.points) * RIM_FIT.points_a_pixel + 0.5
        inside = np.clip(inside, 0, 1)

        seen = sample_image(self.light, middle + self.samples[:, None] * line[:, None])
        beyond = (mirrored > self.limit) & (inside > 0)
        far, hidden = np.zeros_like(mirrored), np.zeros(beyond.shape, bool)
        reach = np.minimum(mirrored[beyond], RIM_FIT.farthest) / from_centre
        place = view.at(foot + reach[:, None] * self.along[np.nonzero(beyond)[0]], rig)
        shown = (place > 0).all(-1) & (place < self.light.shape[::-1]).all(-1)
        hidden[beyond] = ~shown | (mirrored[beyond] > RIM_FIT.farthest)
        far[beyond] = sample_image(self.farther, place)
        return _Trace(mirrored, direct, inside, far, hidden, seen)

    def kernel(self, p: Array) -> Array:
        """Weights (samples, points) of the camera's blur along a line."""
        sigma = math.hypot(math.exp(p[_RIM_BLUR]), self.blur)
        weight = np.exp(-0.5 * ((self.samples[:, None] - self.points) / sigma) ** 2)
        return _single(weight / weight.sum(1, keepdims=True))

    def node(self, distance: Array) -> Array:
        """Where the unknown table has a distance from the centre, in nodes."""
        last = self.nodes - 1
        scale = last / (self.limit - RIM_FIT.last_node)
        return np.clip((distance - 1) * scale, 0, last - RIM_FIT.inside_last)

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
        valid = (known * t.hidden) @ kernel.T < RIM_FIT.hidden_share
        near = (t.inside - known) * mirror
        hats = self.hats(t.mirrored, near) + self.hats(t.direct, 1 - t.inside)
        matrix = kernel @ hats
        dark, black = RIM_FIT.dark
        scale = np.median(t.seen, 1, keepdims=True) + dark * t.seen.mean() + black
        right = (t.seen - (known * t.far * mirror) @ kernel.T) / scale
        weight = _single(valid) if weight is None else valid * _single(weight)
        weighted = (matrix * weight[..., None]).transpose(0, 2, 1)
        smooth = spread**2 * self.bend + RIM_FIT.ridge * np.eye(self.nodes)
        solver = _single(np.linalg.solve(weighted @ matrix + smooth, weighted))
        table = (solver @ right[..., None])[..., 0]
        error = right - (matrix @ table[..., None])[..., 0]
        robust, correlated = RIM_FIT.robust, RIM_FIT.correlated
        relative = (error / (robust * spread)) ** 2
        # A sample whose table the photo does not show costs what a typical one does.
        relative_or_typical = np.where(valid, relative, RIM_FIT.unseen_cost)
        cost = float(np.log1p(relative_or_typical).sum()) * robust**2 / correlated
        cost += float(np.sum((table @ self.bend) * table)) / correlated
        horizon = self.horizon(p)
        *_, off, strength = horizon
        cost += float((strength * np.log1p((off / edge) ** 2)).sum()) / RIM_FIT.edges_correlated
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
        return (p - self.expected) * (np.arange(len(p)) >= 3)

    def horizon(self, p: Array) -> tuple[Array, Array, Array, Array]:
        """The horizon (n, 2), its normals, the signed distances to its edge, and their weights."""
        curve = horizon_curve(self.view, _tilted(self.rig, p), p, RIM_FIT.horizon_points)
        normal = normals(curve)
        pixels, radii = RIM_FIT.horizon_reach
        reach = max(pixels, radii * self.radius * 0.5 ** (3 - self.blur))
        return curve, normal, *edges(self.view, curve, normal, reach)

    def spreads(self, p: Array) -> tuple[float, float]:
        """The spread of the lines' residuals with the ball at ``p``, and of the horizon's edge."""
        fit = self.solve(p, RIM_FIT.first_spread, 1.0, None)
        errors = fit.error[fit.weight > 0]
        *_, off, strength = fit.horizon
        strong = off[strength > RIM_FIT.strong_edge]
        edge = float(robust_spread(strong)) if strong.size else 0.0
        spread = float(robust_spread(errors if errors.size else np.ones(1)))
        return max(RIM_FIT.least_spread, spread), max(RIM_FIT.horizon_spread, edge)

    def descend(
        self, p: Array, turns: int, spread: float, edge: float
    ) -> tuple[float, Array, Array]:
        """Steps from ``p`` on: the cost, the unknowns, their information in `units`."""

        def evaluate(steps: Array, fit: _Fit | None) -> tuple[float, _Fit]:
            at = p + steps @ self.units
            weight = self.solve(at, spread, edge, None).weight if fit is None else fit.weight
            new = self.solve(at, spread, edge, weight)
            return new.cost, new

        def equations(steps: Array, fit: _Fit) -> tuple[Array, Array]:
            matrix, gradient = self.normal_equations(p + steps @ self.units, fit, spread, edge)
            return matrix, -gradient

        found = minimise(
            np.zeros(len(p)),
            evaluate,
            equations,
            steps=turns,
            longest=RIM_FIT.longest_step,
            enough=lambda gained, cost: gained < RIM_FIT.least_gain,
        )
        information, _ = equations(found.unknowns, found.state)
        return found.cost, p + found.unknowns @ self.units, information

    def normal_equations(
        self, p: Array, fit: _Fit, spread: float, edge: float
    ) -> tuple[Array, Array]:
        """Gauss–Newton's matrix (7, 7) and the gradient (7,), in `units`."""
        base = self.residual(p, fit.trace, fit)
        curve, normal, off, strength = fit.horizon
        lines, horizon = np.zeros((len(p), *base.shape)), np.zeros((len(p), len(curve)))
        for k, unit in enumerate(self.units):
            trace = fit.trace
            if k < _RIM_BLUR:  # blur and reflectance move no ray
                trace = self.trace(p + unit)
                moved = horizon_curve(self.view, _tilted(self.rig, p + unit), p + unit, len(curve))
                horizon[k] = np.sum((moved - curve) * normal, -1)
            lines[k] = self.residual(p + unit, trace, fit) - base
        slope = lines - (fit.matrix @ (fit.solver @ lines[..., None]))[..., 0]
        slope = slope.reshape(len(p), -1)
        weighted = slope * (fit.weight.reshape(-1) / spread**2 / RIM_FIT.correlated)
        matrix = self.units @ np.diag(self.prior) @ self.units.T + weighted @ slope.T
        gradient = self.units @ (self.prior * self.off(p)) + weighted @ fit.error.reshape(-1)
        weight = strength / (1 + (off / edge) ** 2)
        weighted = horizon * (weight / edge**2 / RIM_FIT.edges_correlated)
        return matrix + weighted @ horizon.T, gradient - weighted @ off


def _without_outliers(image: Array) -> Array:
    """The image (h, w) with single pixels replaced that differ from the eight around them."""
    smooth = ndimage.median_filter(image, 3)
    off = image - smooth
    return np.where(np.abs(off) > RIM_FIT.outlier * robust_spread(off), smooth, image)
