"""Where the screen hangs and what it shows, read from its image in the mirror ball.

The known pattern is registered with the ball's image: the screen's shift and tilt, the display's
curve (a gamma a channel), its gain and the camera's blur are fitted together, by damped
Gauss–Newton from coarse to fine. Each pixel is compared with what it should average of the pattern.
Pixels on the screen's edge hold a share of the room beside it; the more, the less certain they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.errors import InputError
from invrender.images import Photo
from invrender.mirror import Ball
from invrender.pattern import resize_pattern
from invrender.rig import Rig
from invrender.unfold import pixel_grid, screen_coordinates, trace_ball, window

Array = NDArray[np.floating[Any]]
SHIFT_PRIOR = 6e-3 / 0.09  # standard deviation of the screen's shift, in sizes of the sample
TILT_PRIOR = 6.0  # of its tilt, degrees
GAMMA_PRIOR, CHANNEL_PRIOR = 0.5, 0.03  # of log gamma, and of the channels' differences in it
FINEST = 100.0  # a ball of more pixels in radius is shrunk for the fit
CELLS = 128  # of the pattern in the fit
POOR = 0.01  # residual of the screen as it should be from which it is in doubt
BETTER = 0.7  # of it, from which another pose or curve is believed
SATURATED = 0.01  # share of saturated pixels from which it is told, and the screen fitted with care
NO_CURVE = 0.2  # share of saturated pixels from which gain and gamma cannot be told apart
EDGE = 3  # pixels outside the screen's image that are compared as well


@dataclass(frozen=True)
class Screen:
    """The screen as the ball shows it.

    ``rig``: with the screen's shift and tilt; ``shown`` (h, w, 3): the pattern through the
    display's curve, ``gamma`` (3,); its radiance is ``gain`` (3,) times that. ``blur`` is the
    camera's in pixels, ``residual`` the fit's RMS over the mean gain, ``ideal_residual`` that of
    the screen as it should be, ``deviation`` the standard deviations that the fit expects of the
    shift (metres) and the tilt (degrees), ``pixels`` the number that lie on the screen and are not
    saturated, ``saturated`` the share that is.
    """

    rig: Rig
    shown: Array
    gain: Array
    gamma: Array
    blur: float
    residual: float
    ideal_residual: float
    deviation: tuple[float, float]
    pixels: int
    saturated: float


def fit_screen(photo: Photo, rig: Rig, ball: Ball, pattern: Array) -> Screen:
    """Register the ``pattern`` (h, w, 3), relative radiance, with the ball's image of the screen.

    Gain and blur first, for the screen as it should be. Where that fits worse than to `POOR`, or
    the screen is saturated, its pose and the display's curve are fitted too; where more than
    `NO_CURVE` is saturated the curve cannot be told from the gain and is taken as straight. Raises
    `InputError` if the ball cannot show the screen, or shows it saturated or dark.
    """
    fit = _Fit(photo, rig, ball, pattern)
    ideal = fit.result(fit.solve(fit.start(), 0.0, 6))
    if ideal.residual < POOR and ideal.saturated < SATURATED:
        return ideal
    fit.free[:] = True
    fit.free[_GAMMA] = ideal.saturated < NO_CURVE
    u = fit.start()
    for blur, turns in ((2.5, 8), (1.0, 8), (0.0, 14)):
        u = fit.solve(u, blur * max(1.0, fit.radius / 60), turns)
    moved = replace(fit.result(u), ideal_residual=ideal.residual)
    # A saturated pixel had at least so much light, which the ideal screen alone may not explain.
    better = moved.residual < BETTER * ideal.residual or ideal.saturated > SATURATED
    return moved if better else ideal


# Places of the unknowns: shift and tilt in units of their priors, log gamma and log gain a channel,
# blur in pixels.
_SHIFT, _TILT, _GAMMA, _GAIN, _BLUR = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12
_STEP = 0.02  # of finite differences


class _Fit:
    """The ball's image around the screen, the rays that its sub-pixels see, and the fit's steps."""

    def __init__(self, photo: Photo, rig: Rig, ball: Ball, pattern: Array) -> None:
        self.rig, self.full = rig, pattern
        self.free = np.zeros(13, bool)
        self.free[_GAIN], self.free[_BLUR] = True, True
        self.step = step = max(1, round(ball.radius / FINEST))
        self.radius = ball.radius / step
        self.samples = n = 4 if self.radius < 50 else 3 if self.radius < 80 else 2
        rows, columns = self._area(rig, ball, step)
        area = photo.image[rows, columns]
        h, w = area.shape[0] // step, area.shape[1] // step
        pool = area[: h * step, : w * step].reshape(h, step, w, step, 3)
        reflectance = np.asarray(rig.ball_reflectance, np.float32)
        self.image = pool.mean((1, 3)) / reflectance
        self.level = np.full(3, photo.clip_level or np.inf) / reflectance
        self.clipped = pool.max((1, 3)) / reflectance >= self.level
        y = rows.start + (np.arange(h * n) + 0.5) * step / n
        x = columns.start + (np.arange(w * n) + 0.5) * step / n
        pixels = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)
        point, mirrored, seen = trace_ball(rig, ball, pixels)
        self.point, self.mirrored, self.seen = point, mirrored, seen & (mirrored[..., 2] > 0.02)
        self.pattern = np.maximum(resize_pattern(pattern, min(CELLS, len(pattern))), 1e-3)
        self.blurred = 0.0

    @staticmethod
    def _area(rig: Rig, ball: Ball, step: int) -> tuple[slice, slice]:
        """Rows and columns of the photo that may show the screen, wherever it hangs."""
        rows, columns = window(ball)
        coarse = max(1, round(ball.radius / 40))
        pixels = pixel_grid(rows, columns)[coarse // 2 :: coarse, coarse // 2 :: coarse]
        point, mirrored, seen = trace_ball(rig, ball, pixels)
        s, t, _ = screen_coordinates(rig, point, mirrored)
        with np.errstate(invalid="ignore"):
            near = seen & (mirrored[..., 2] > 0.05) & (abs(s - 0.5) < 0.75) & (abs(t - 0.5) < 0.75)
        if not near.any():
            raise InputError("the ball cannot show the screen: check the rig's sizes")
        y, x = np.nonzero(near)
        margin = math.ceil(0.06 * ball.radius) + (EDGE + 4) * step
        return (
            slice(max(rows.start, rows.start + coarse * y.min() - margin),
                  min(rows.stop, rows.start + coarse * (y.max() + 1) + margin)),
            slice(max(columns.start, columns.start + coarse * x.min() - margin),
                  min(columns.stop, columns.start + coarse * (x.max() + 1) + margin)),
        )  # fmt: skip

    def moved(self, u: Array) -> Rig:
        """The rig with the screen where ``u`` puts it."""
        shift = u[_SHIFT] * SHIFT_PRIOR * self.rig.sample_size
        tilt = u[_TILT] * TILT_PRIOR
        return replace(
            self.rig,
            screen_shift=tuple(np.add(self.rig.screen_shift, shift)),
            screen_tilt=tuple(np.add(self.rig.screen_tilt, tilt)),
        )

    def look(self, u: Array, *images: Array) -> tuple[Array, ...]:
        """What the pixels average of images (n, n, C) on the screen, and the screen's share."""
        s, t, _ = screen_coordinates(self.moved(u), self.point, self.mirrored)
        n, count = self.samples, len(images[0])
        ds, dt = (np.maximum(sum(np.abs(g) for g in np.gradient(a)), 1e-6) for a in (s, t))
        cover = np.clip(0.5 + (0.5 - abs(s - 0.5)) / ds, 0, 1)
        cover = cover * np.clip(0.5 + (0.5 - abs(t - 0.5)) / dt, 0, 1) * self.seen
        on = cover > 0
        x = np.clip(s[on] * count - 0.5, 0, count - 1.001)
        y = np.clip((1 - t[on]) * count - 0.5, 0, count - 1.001)
        i, j = y.astype(int), x.astype(int)
        fy, fx = ((y - i)[:, None]).astype(np.float32), ((x - j)[:, None]).astype(np.float32)
        weight = cover[on][:, None].astype(np.float32)
        k = i * count + j
        corners = (
            (k, (1 - fx) * (1 - fy)), (k + 1, fx * (1 - fy)),
            (k + count, (1 - fx) * fy), (k + count + 1, fx * fy),
        )  # fmt: skip
        flat = np.concatenate([image.reshape(count * count, -1) for image in images], 1)
        values = np.zeros((*s.shape, flat.shape[1] + 1), np.float32)
        values[on, :-1] = sum(flat[k] * f for k, f in corners) * weight
        values[..., -1] = cover
        h, w = s.shape[0] // n, s.shape[1] // n
        out = np.zeros((h, w, values.shape[-1]), np.float32)
        for a in range(n):
            for b in range(n):
                out += values[a::n, b::n] / np.float32(n * n)
        sigma = math.hypot(max(float(u[_BLUR]), 0.0), self.blurred)
        if sigma > 0.05:
            out = ndimage.gaussian_filter(out, (sigma, sigma, 0), truncate=3)
        ends = np.cumsum([image.shape[2] for image in images])
        return (*np.split(out[..., :-1], ends[:-1], -1), out[..., -1])

    def start(self) -> Array:
        """The nominal pose, a straight curve and the gain that fits them best."""
        u = np.zeros(13)
        u[_BLUR] = 0.5
        shown, share = self.look(u, self.pattern)
        inside = share > 0.98
        if inside.sum() < 12:
            raise InputError(
                "the ball's image shows too little of the screen: check the rig's sizes"
            )
        light = self.image[inside].mean(0) / shown[inside].mean(0)
        if not (light > 0).all():
            raise InputError("the screen is dark in the ball's image: is the pattern displayed?")
        u[_GAIN] = np.log(light)
        return u

    def background(self, image: Array, share: Array) -> tuple[Array, Array]:
        """The room's radiance (H, W, 3) continued behind the screen, and how much it varies."""
        margin = 2 + EDGE / 2 + 2 * self.blurred
        room = ndimage.distance_transform_edt(share < 0.003) > margin
        if not room.any():
            level = np.broadcast_to(np.median(image, (0, 1)), image.shape)
            return level, level
        weight = ndimage.uniform_filter(room.astype(np.float32), 5) + 1e-6
        mean, square = (
            ndimage.uniform_filter(a * room[..., None], (5, 5, 1)) / weight[..., None]
            for a in (image, image * image)
        )
        spread = np.sqrt(np.maximum(square - mean * mean, 0)) + 0.1 * mean
        y, x = ndimage.distance_transform_edt(~room, return_distances=False, return_indices=True)
        return image[y, x], spread[y, x]

    def solve(self, u: Array, blurred: float, turns: int) -> Array:
        """Damped Gauss–Newton steps from ``u`` on images that are ``blurred`` further."""
        self.blurred = blurred
        image = (
            ndimage.gaussian_filter(self.image, (blurred, blurred, 0)) if blurred else self.image
        )
        clipped = self.clipped
        if blurred:
            clipped = ndimage.maximum_filter(clipped, (3, 3, 1))
        damping = 1e-2
        free = self.free
        for _ in range(turns):
            shown = self.pattern ** np.exp(u[_GAMMA]).astype(np.float32)
            slope = shown * np.log(self.pattern) * np.exp(u[_GAMMA]).astype(np.float32)
            p, dp, share = self.look(u, shown, slope)
            gain = np.exp(u[_GAIN]).astype(np.float32)
            room, spread = self.background(image, share)
            use = ndimage.distance_transform_edt(share < 0.003) <= EDGE
            deviation, error = self.errors(image, clipped, p * gain, share, room, spread, gain)
            self.error, self.share, self.scale = error, share, deviation

            def columns(step: float, part: Array, other: Array) -> Array:
                out = (part - p) * gain - (other - share)[..., None] * room  # noqa: B023
                return np.asarray(out[use] / deviation[use] / step)  # noqa: B023

            jacobian = np.zeros((int(use.sum()), 3, 13), np.float32)
            for k in [*range(6), _BLUR]:
                if free[k]:
                    moved = u.copy()
                    moved[k] += _STEP if k < 6 else 0.1
                    jacobian[..., k] = columns(moved[k] - u[k], *self.look(moved, shown))
            for c in range(3):
                jacobian[:, c, 6 + c] = (dp * gain / deviation)[use][:, c]
                jacobian[:, c, 9 + c] = (p * gain / deviation)[use][:, c]
            r = error[use]
            # Saturated pixels say only that there is at least so much light.
            jacobian[clipped[use] & (r == 0)] = 0
            weight = 1 / (1 + (r / 2.5) ** 2)
            j = jacobian.reshape(-1, 13)[:, free]
            wj = j * weight.reshape(-1, 1)
            prior, pull = self.prior(u)
            matrix = (j.T @ wj + prior[np.ix_(free, free)]).astype(float)
            right = (wj.T @ r.reshape(-1) - pull[free]).astype(float)
            matrix[np.diag_indices_from(matrix)] *= 1 + damping
            delta = np.zeros(13)
            delta[free] = np.linalg.solve(matrix, right)
            delta *= min(1, 0.5 / max(np.abs(delta).max(), 1e-12))
            u = u + delta
            u[_BLUR] = np.clip(u[_BLUR], 0, 3)
            self.information = matrix
            if np.abs(delta).max() < (0.01 if blurred else 2e-3):
                break
        return u

    def errors(
        self, image: Array, clipped: NDArray[np.bool_], light: Array, share: Array, room: Array,
        spread: Array, gain: Array,
    ) -> tuple[Array, Array]:  # fmt: skip
        """The pixels' expected deviation, and their errors over it (H, W, 3), observed - model."""
        model = light + (1 - share)[..., None] * room
        error = image - model
        error = np.where(clipped, np.maximum(self.level - model, 0), error)
        level = float(gain.mean())
        shot = np.sqrt(level * (model + 0.02 * level))
        inside = (share > 0.98)[..., None] & ~clipped
        relative = np.abs(error / shot)[inside]
        a = 1.48 * float(np.median(relative)) if relative.size else 0.1
        deviation = np.hypot(max(a, 0.003) * shot, (1 - share)[..., None] * spread)
        return deviation, error / deviation

    def rest(self, seen: NDArray[np.bool_]) -> float:
        """Root mean square of what pixels differ by from the model, with Huber's weights."""
        if not seen.any():
            return 0.0
        error = np.abs(self.error * self.scale)[seen]
        weight = np.minimum(1, 2 * np.median(error, 0) / np.maximum(error, 1e-12))
        return float(np.sqrt(((weight * error**2).sum(0) / weight.sum(0)).mean()))

    def prior(self, u: Array) -> tuple[Array, Array]:
        """The prior's information (13, 13) and its gradient at ``u``."""
        matrix = np.zeros((13, 13))
        matrix[np.arange(6), np.arange(6)] = 1
        apart = np.eye(3) - 1 / 3
        matrix[_GAMMA, _GAMMA] = apart / CHANNEL_PRIOR**2 + 1 / 9 / GAMMA_PRIOR**2
        target = np.zeros(13)
        matrix[_BLUR, _BLUR] = 1.0
        target[_BLUR] = 0.4
        return matrix, matrix @ (u - target)

    def result(self, u: Array) -> Screen:
        """What the fit says, with the pattern through the display's curve."""
        gamma, gain = np.exp(u[_GAMMA]), np.exp(u[_GAIN])
        inside = self.share > 0.98
        seen = inside & ~self.clipped.any(-1)
        residual = self.rest(seen) / float(gain.mean())
        spread = np.zeros(6)
        if self.free[0]:
            spread = np.sqrt(np.diag(np.linalg.inv(self.information))[:6])
        units = SHIFT_PRIOR * self.rig.sample_size, TILT_PRIOR
        return Screen(
            rig=self.moved(u),
            shown=np.maximum(self.full, 0) ** gamma,
            gain=gain,
            gamma=gamma,
            blur=float(u[_BLUR]) * self.step,
            residual=residual,
            ideal_residual=residual,
            deviation=(
                float(np.linalg.norm(spread[:3])) * units[0],
                float(np.linalg.norm(spread[3:])) * units[1],
            ),
            pixels=int(seen.sum()) * self.step**2,
            saturated=float(1 - seen.sum() / max(inside.sum(), 1)),
        )
