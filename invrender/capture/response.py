"""The tone curve of a photo's file: how brightness was changed after the light was measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from invrender.capture.settings import TONE_CURVE
from invrender.files.images import Photo
from invrender.sampling import knot_shares, knot_slopes
from invrender.types import Array


@dataclass(frozen=True)
class Response:
    """What a camera makes of light before it is encoded: x becomes x·exp(c(log x)).

    c is linear between `TONE_CURVE.knots` (of linear values, 1 is white), has the given
    ``logarithms`` there, and is constant beyond. The same for all channels.
    """

    logarithms: tuple[float, ...]

    def apply(self, light: Array) -> tuple[Array, Array]:
        """Values (...) that the file has for light (...); and how steep the curve is there, in
        logarithms: 1 where it is straight."""
        knots = np.log(TONE_CURVE.knots)
        log = np.log(np.maximum(light, TONE_CURVE.darkest))
        curved = light * np.exp(np.interp(log, knots, self.logarithms))
        slopes = np.diff(self.logarithms) / np.diff(knots)
        steep = 1 + np.concatenate([[0], slopes, [0]])[np.searchsorted(knots, log)]
        return np.asarray(curved), np.asarray(steep)

    @property
    def is_likely(self) -> bool:
        """Whether a camera has such a curve: it rises everywhere, and flattens towards white."""
        slopes = 1 + np.diff(self.logarithms) / np.diff(np.log(TONE_CURVE.knots))
        steeper = np.diff(slopes[TONE_CURVE.fixed : TONE_CURVE.white]).max()
        flattens = self.logarithms[TONE_CURVE.white] < TONE_CURVE.shoulder
        rises = slopes.min() > TONE_CURVE.least_slope
        return bool(rises and flattens and steeper < TONE_CURVE.steeper)

    def undo(self, photo: Photo) -> Photo:
        """The photo as the light was, linear."""
        knots = np.asarray(TONE_CURVE.knots)
        curved = np.log(knots) + self.logarithms

        def linear(values: Array) -> Array:
            log = np.log(np.maximum(values, TONE_CURVE.darkest))
            off = np.interp(log, curved, self.logarithms)
            return np.asarray(values * np.exp(-off), np.float32)

        level = photo.clip_level
        if level is not None:
            level = float(linear(np.array([level]))[0])
        image = np.concatenate(
            [linear(part) for part in np.array_split(photo.image, TONE_CURVE.parts)]
        )
        return replace(photo, image=image, clip_level=level)


def curve_shares(light: Array) -> Array:
    """How much of each knot's logarithm the light (...) has, (..., knots)."""
    knots = np.log(TONE_CURVE.knots)
    log = np.log(np.maximum(light, TONE_CURVE.darkest))
    return knot_shares(log, knots)


def curve_precision() -> Array:
    """Inverse covariance of the logarithms: small slopes that change little, nought at the fixed
    knot."""
    knots = np.log(TONE_CURVE.knots)
    slope, bend = knot_slopes(knots)
    fixed = np.zeros((1, len(knots)))
    fixed[0, TONE_CURVE.fixed] = 1 / TONE_CURVE.fixed_deviation
    rows = np.concatenate(
        [slope / TONE_CURVE.slope_deviation, bend / TONE_CURVE.bend_deviation, fixed]
    )
    return np.asarray(rows.T @ rows)
