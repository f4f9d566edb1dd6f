"""A lamp that the screen hides from the ball, as bright as the table around the sample says it is.

Behind the screen the room is only filled smoothly. But the screen hides less of it from the table
and the sample than from the ball, and a lamp there lights what the screen does not shade. Where the
table's shading is plainly better explained so, one part of the filling is made that bright.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy import optimize

from invrender.capture.ball_image import screen_coordinates
from invrender.capture.clipped_lamps import ROUGH
from invrender.capture.mirror import Ball
from invrender.capture.table import distant_pairs, hidden_by_screen, lit_table
from invrender.colour import AXES
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sphere import directions, sky_flux
from invrender.types import Array

PARTS = 8  # of what the screen hides from the ball, a side
TILE = 16  # blocks a side, over which the errors' correlation is measured
# Of the logarithm of how many times brighter a part is than its filling: half the range between the
# quartiles, of a Cauchy distribution, and the channels' standard deviation about their mean. In
# rooms one part in a hundred has 3 to 5: a lamp.
BRIGHTER, COLOUR = 0.3, 0.12
BRIGHTEST = 9.0  # the greatest such logarithm
LAMPS = (0.1, 0.4, 1.5)  # of the table's light: of a lamp to start from
WORTH = 6.0  # by how much, twice the log posterior, it must be likelier with a lamp
LEFT = 0.82  # of the table's usual differences in brightness, what a lamp must leave unexplained


def add_hidden_lamp(
    photo: Photo, rig: Rig, ball: Ball, pattern: Array, gain: Array, environment: Array,
    coverage: Array,
) -> tuple[Array, float]:  # fmt: skip
    """The filled environment (H, 2H, 3) with the lamp behind the screen that the table tells of;
    and how many times as bright as the filling that is (1 where there is none).

    The screen's radiance is pattern (h, w, 3) times gain (3,). In a JPEG none is looked for: its
    colours are too coarse.
    """
    if photo.clip_level is not None:
        return environment, 1.0
    height = len(coverage)
    d = directions(height, 2 * height).astype(float)
    s, t, _ = screen_coordinates(rig, np.asarray(ball.position), d)
    row, column = (np.clip(np.nan_to_num(a) * PARTS, 0, PARTS - 1).astype(int) for a in (t, s))
    part = np.where((coverage <= 0) & (d[..., 2] > 0), row * PARTS + column, -1)
    seen, at, use, known = lit_table(photo, rig, ball, pattern, gain, environment)
    shading = _Shading(seen, use, known)
    best = None
    for k, light in enumerate(_part_lights(rig, at, environment, part)):
        for x in shading.starts(light):
            cost = shading.cost(x, light)
            if best is None or cost < best[0]:
                best = cost, k, light, x
    if best is None:
        return environment, 1.0
    _, k, light, x = best
    x = shading.descend(x, light)
    gained = shading.cost(np.zeros(3), light) - shading.cost(x, light)
    if gained < WORTH or shading.left(x, light) > LEFT:
        return environment, 1.0
    factor = np.where((part == k)[..., None], np.exp(x), 1)
    return np.asarray(environment * factor, np.float32), float(np.exp(x).mean())


def _part_lights(rig: Rig, at: Array, environment: Array, part: Array) -> Iterator[Array]:
    """Irradiance (n, 3) of points on the table from each part of the room, in turn."""
    d, flux = sky_flux(environment)
    label = part[: len(part) // 2].ravel()
    behind = np.flatnonzero(label >= 0)
    seen = ~hidden_by_screen(rig, at, d[behind])
    for k in range(PARTS**2):
        own = label[behind] == k
        yield seen[:, own] @ flux[behind[own]]


class _Shading:
    """How likely the table's shading is with a lamp.

    ``seen``: log radiance of the used blocks (n, 3); ``known`` (n, 3): their irradiance without.
    As in `invrender.capture.clipped_lamps`, logarithms some blocks apart are compared, with
    Cauchy's loss, whose spread is that of the errors. Textures are alike over several blocks: each
    lag and axis counts as many times as its errors are independent, by how much the variance of
    their sums over tiles exceeds that of white noise (as composite likelihoods are adjusted:
    Varin, Reid, Firth 2011).
    """

    def __init__(self, seen: Array, use: Any, known: Array) -> None:
        self.seen, self.known = seen @ AXES, known
        self.pairs = [pair for pair, _ in distant_pairs(use)]
        tile = np.add.outer(np.arange(len(use)) // TILE * 1000, np.arange(use.shape[1]) // TILE)
        self.weights = []
        for (i, _), error in zip(self.pairs, self.errors(known), strict=True):
            spread = _spread(error)
            index = np.unique(tile[use][i], return_inverse=True)[1]
            # What is rounded is white, a usual error's pull 0.36.
            white = len(i) * 0.13 * (1 - np.minimum(spread / ROUGH, 1) ** 2)
            z = error / np.maximum(spread, ROUGH)
            pull = z / (1 + z * z)
            pull -= pull.mean(0)
            sums = np.stack([np.bincount(index, p) for p in pull.T], -1)
            alike = ((sums**2).sum(0) + white) / ((pull**2).sum(0) + white + 1e-12)
            self.weights.append(1 / np.maximum(alike, 1) * 2 / len(self.pairs))

    def errors(self, light: Array) -> list[Array]:
        """Differences (pairs, 3), along `AXES`, of each lag."""
        rest = self.seen - np.log(np.maximum(light, 1e-12)) @ AXES
        return [rest[i] - rest[j] for i, j in self.pairs]

    def lit(self, x: Array, lamp: Array) -> Array:
        return np.asarray(self.known + np.expm1(x) * lamp)

    def starts(self, lamp: Array) -> list[Array]:
        """Logarithms (3,) of a part's factor that make it a lamp; ``lamp`` (n, 3): its light."""
        most = lamp.max(initial=0)
        if not self.pairs or not most > 0:
            return []
        shares = np.array(LAMPS) * np.median(self.known) / most
        return [np.full(3, min(x, BRIGHTEST - 1e-3)) for x in np.log1p(shares)]

    def cost(self, x: Array, lamp: Array) -> float:
        """Minus twice the logarithm of the posterior, but for a constant."""
        cost = float((_prior(x) ** 2).sum())
        for error, weight in zip(self.errors(self.lit(x, lamp)), self.weights, strict=True):
            spread = np.maximum(_spread(error), ROUGH)
            cost += float((weight * (np.log(spread) + np.log1p((error / spread) ** 2))).sum())
        return cost

    def left(self, x: Array, lamp: Array) -> float:
        """The errors' spread in brightness with the lamp over that without, the median lag's."""
        with_lamp, without = (
            [np.maximum(_spread(e), ROUGH)[0] for e in self.errors(light)]
            for light in (self.lit(x, lamp), self.known)
        )
        return float(np.median(np.divide(with_lamp, without)))

    def descend(self, x: Array, lamp: Array) -> Array:
        """The most probable logarithms near ``x``."""
        for _ in range(3):
            spreads = [np.maximum(_spread(e), ROUGH) for e in self.errors(self.lit(x, lamp))]

            def residuals(x: Array, spreads: list[Array] = spreads) -> Array:
                parts = [_prior(x)]
                errors = self.errors(self.lit(x, lamp))
                for error, spread, weight in zip(errors, spreads, self.weights, strict=True):
                    z = error / spread
                    parts.append((np.sign(z) * np.sqrt(weight * np.log1p(z * z))).ravel())
                return np.concatenate(parts)

            x = optimize.least_squares(residuals, x, "3-point", (0, BRIGHTEST), max_nfev=20).x
        return np.asarray(x)


def _spread(error: Array) -> Array:
    return np.asarray(1.48 * np.median(np.abs(error), 0))


def _prior(x: Array) -> Array:
    """Residuals (4,) whose squares are minus twice the log prior."""
    grey = x.mean()
    return np.array([np.sqrt(2 * np.log1p((grey / BRIGHTER) ** 2)), *((x - grey) / COLOUR)])
