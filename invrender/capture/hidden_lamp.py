"""A lamp that the screen hides from the ball, as bright as the table around the sample says it is.

Behind the screen the room is only filled smoothly. But the screen hides less of it from the table
and the sample than from the ball, and a lamp there lights what the screen does not shade. Where the
table's shading is clearly better explained so, one part of the filling is made that bright.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import optimize

from invrender.capture.ball_image import screen_coordinates
from invrender.capture.mirror import Ball
from invrender.capture.robust import cauchy_residuals, spread
from invrender.capture.settings import HIDDEN_LAMP, TABLE_METER
from invrender.capture.table import LitTable, distant_pairs, hidden_by_screen
from invrender.colour import AXES
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sphere import directions, sky_flux
from invrender.types import TINY, Array, Mask


def add_hidden_lamp(
    photo: Photo, rig: Rig, ball: Ball, table: Callable[[], LitTable], environment: Array,
    coverage: Array,
) -> tuple[Array, float]:  # fmt: skip
    """The filled environment (H, 2H, 3) with the lamp behind the screen that the table's shading
    shows; and how many times as bright as the filling that is (1 where there is none).

    table: the photo's `lit_table` under the screen and that environment. In a JPEG no lamp is
    looked for: its colours are too coarse.
    """
    if photo.clip_level is not None:
        return environment, 1.0
    height, parts = len(coverage), HIDDEN_LAMP.parts
    d = directions(height, 2 * height).astype(float)
    s, t, _ = screen_coordinates(rig, np.asarray(ball.position), d)
    row, column = (np.clip(np.nan_to_num(a) * parts, 0, parts - 1).astype(int) for a in (t, s))
    part = np.where((coverage <= 0) & (d[..., 2] > 0), row * parts + column, -1)
    seen, at, use, lit, room = table()
    shading = _Shading(seen, use, lit + room)
    best = None
    for k, light in enumerate(_part_lights(rig, at, environment, part)):
        for x in shading.starts(light):
            cost = shading.cost(x, light)
            if best is None or cost < best[0]:
                best = cost, k, light, x
    if best is None:
        return environment, 1.0
    _, k, light, x = best
    x = shading.minimise(x, light)
    gained = shading.cost(np.zeros(3), light) - shading.cost(x, light)
    unexplained = shading.spread_ratio(x, light)
    if gained < HIDDEN_LAMP.gain or unexplained > HIDDEN_LAMP.spread_ratio:
        return environment, 1.0
    factor = np.where((part == k)[..., None], np.exp(x), 1)
    return np.asarray(environment * factor, np.float32), float(np.exp(x).mean())


def _part_lights(rig: Rig, at: Array, environment: Array, part: Array) -> Array:
    """Irradiance (parts, n, 3) of points on the table from each part of the room."""
    d, flux = sky_flux(environment)
    label = part[: len(part) // 2].ravel()
    behind = np.flatnonzero(label >= 0)
    seen = ~hidden_by_screen(rig, at, d[behind])
    own = (label[behind] == k for k in range(HIDDEN_LAMP.parts**2))
    return np.stack([seen[:, part].astype(float) @ flux[behind][part] for part in own])


class _Shading:
    """How likely the table's shading is with a lamp.

    ``seen``: log radiance of the used blocks (n, 3); ``known`` (n, 3): their irradiance without.
    As in `invrender.capture.clipped_lamps`, logarithms some blocks apart are compared, with
    Cauchy's loss, whose spread is that of the errors. Textures are alike over several blocks: each
    lag and axis counts as many times as its errors are independent, by how much the variance of
    their sums over tiles exceeds that of white noise (as composite likelihoods are adjusted:
    Varin, Reid, Firth 2011).
    """

    def __init__(self, seen: Array, use: Mask, known: Array) -> None:
        self.seen, self.known = seen @ AXES, known
        self.pairs = [pair for pair, _ in distant_pairs(use)]
        down, across = (np.arange(n) // HIDDEN_LAMP.tile for n in use.shape)
        tile = np.add.outer(down * (across.max(initial=0) + 1), across)
        self.weights = []
        for (i, _), error in zip(self.pairs, self.errors(known), strict=True):
            scale = spread(error, 0)
            index = np.unique(tile[use][i], return_inverse=True)[1]
            # What is rounded to 8 bits has independent errors of that spread.
            rounded = np.minimum(scale / TABLE_METER.least_spread, 1) ** 2
            white = len(i) * HIDDEN_LAMP.white_pull * (1 - rounded)
            z = error / np.maximum(scale, TABLE_METER.least_spread)
            pull = z / (1 + z * z)
            pull -= pull.mean(0)
            sums = np.stack([np.bincount(index, p) for p in pull.T], -1)
            alike = ((sums**2).sum(0) + white) / ((pull**2).sum(0) + white + TINY)
            self.weights.append(1 / np.maximum(alike, 1) * 2 / len(self.pairs))

    def errors(self, light: Array) -> list[Array]:
        """Differences (pairs, 3), along `AXES`, of each lag."""
        albedo = self.seen - np.log(np.maximum(light, TINY)) @ AXES
        return [albedo[i] - albedo[j] for i, j in self.pairs]

    def lit(self, x: Array, lamp: Array) -> Array:
        """Irradiance (n, 3) with a part of the room exp(x) times as bright."""
        return np.asarray(self.known + np.expm1(x) * lamp)

    def starts(self, lamp: Array) -> list[Array]:
        """Logarithms (3,) of a part's factor that make it a lamp; ``lamp`` (n, 3): its light."""
        most = lamp.max(initial=0)
        if not self.pairs or not most > 0:
            return []
        shares = np.array(HIDDEN_LAMP.starts) * np.median(self.known) / most
        greatest = HIDDEN_LAMP.greatest - HIDDEN_LAMP.inside
        return [np.full(3, min(x, greatest)) for x in np.log1p(shares)]

    def cost(self, x: Array, lamp: Array) -> float:
        """Minus twice the logarithm of the posterior, but for a constant."""
        cost = float((_prior(x) ** 2).sum())
        for error, weight in zip(self.errors(self.lit(x, lamp)), self.weights, strict=True):
            scale = np.maximum(spread(error, 0), TABLE_METER.least_spread)
            cost += float((weight * (np.log(scale) + np.log1p((error / scale) ** 2))).sum())
        return cost

    def spread_ratio(self, x: Array, lamp: Array) -> float:
        """The errors' spread in brightness with the lamp over that without, the median lag's."""
        with_lamp, without = (
            [max(spread(e, 0)[0], TABLE_METER.least_spread) for e in self.errors(light)]
            for light in (self.lit(x, lamp), self.known)
        )
        return float(np.median(np.divide(with_lamp, without)))

    def minimise(self, x: Array, lamp: Array) -> Array:
        """The most probable logarithms near ``x``."""
        for _ in range(3):
            scales = [
                np.maximum(spread(e, 0), TABLE_METER.least_spread)
                for e in self.errors(self.lit(x, lamp))
            ]

            def residuals(x: Array, scales: list[Array] = scales) -> Array:
                parts = [_prior(x)]
                errors = self.errors(self.lit(x, lamp))
                for error, scale, weight in zip(errors, scales, self.weights, strict=True):
                    parts.append((np.sqrt(weight) * cauchy_residuals(error / scale)).ravel())
                return np.concatenate(parts)

            bounds = (0, HIDDEN_LAMP.greatest)
            x = optimize.least_squares(residuals, x, "3-point", bounds, max_nfev=20).x
        return np.asarray(x)


def _prior(x: Array) -> Array:
    """Residuals (4,) whose squares are minus twice the log prior."""
    grey = x.mean()
    brightness = np.sqrt(2 * np.log1p((grey / HIDDEN_LAMP.quartile) ** 2))
    return np.array([brightness, *((x - grey) / HIDDEN_LAMP.channel_deviation)])
