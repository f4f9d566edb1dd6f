"""The tone curve of a photo's file: how brightness was changed after the light was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from invrender.capture.settings import DISPLAY, TONE_CURVE
from invrender.capture.sheet_layout import INK_DEVIATION, INK_REFLECTANCE, PAPER, PAPER_DEVIATION
from invrender.files.images import Photo
from invrender.files.tone_curves import FIXED, KNOTS, curve_prior
from invrender.sampling import knot_shares
from invrender.types import Array

LOG_KNOTS = np.log(KNOTS)


@dataclass(frozen=True)
class Response:
    """What a camera makes of light before it is encoded: the value v is of the light
    v·exp(c(log v)).

    c is linear between `invrender.files.tone_curves.KNOTS`, has the given ``logarithms`` there, and
    is constant beyond. The same for all channels. ``deviation``: what undoing it leaves, of the
    logarithm of bright over dark light. ``measured``: by the photo; else as cameras' curves are.
    """

    logarithms: tuple[float, ...]
    deviation: float = 0.0
    measured: bool = True

    def apply(self, light: Array) -> tuple[Array, Array]:
        """Values (...) that the file has for light (...); and how steep the curve is there, in
        logarithms: 1 where it is straight."""
        log = np.log(np.maximum(light, TONE_CURVE.darkest))
        steps = np.diff(LOG_KNOTS + self.logarithms)
        steps = np.maximum(steps, TONE_CURVE.least_slope * np.diff(LOG_KNOTS))
        lights = LOG_KNOTS[0] + self.logarithms[0] + np.concatenate([[0], np.cumsum(steps)])
        value = np.interp(log, lights, LOG_KNOTS)
        value += np.minimum(log - lights[0], 0) + np.maximum(log - lights[-1], 0)
        slopes = np.concatenate([[1], np.diff(LOG_KNOTS) / steps, [1]])
        return np.exp(value), slopes[np.searchsorted(lights, log)]

    @property
    def is_likely(self) -> bool:
        """Whether a camera has such a curve: it rises everywhere, and flattens towards white."""
        lights = np.diff(LOG_KNOTS + self.logarithms)
        if (lights <= TONE_CURVE.least_slope * np.diff(LOG_KNOTS)).any():
            return False
        slopes = np.diff(LOG_KNOTS) / lights
        steeper = np.diff(slopes[FIXED:]).max()
        return bool(self.logarithms[-1] > TONE_CURVE.shoulder and steeper < TONE_CURVE.steeper)

    def undo(self, photo: Photo) -> Photo:
        """The photo as the light was, linear."""

        def linear(values: Array) -> Array:
            log = np.log(np.maximum(values, TONE_CURVE.darkest))
            return np.asarray(
                values * np.exp(np.interp(log, LOG_KNOTS, self.logarithms)), np.float32
            )

        level = photo.clip_level
        if level is not None:
            level = float(linear(np.array([level]))[0])
        image = np.concatenate(
            [linear(part) for part in np.array_split(photo.image, TONE_CURVE.parts)]
        )
        return replace(
            photo, image=image, clip_level=level, linear=True, curve_deviation=self.deviation
        )


def curve_exponent(photo: Photo) -> float:
    """The deviation of the power to which what is left of a photo's tone curve raises its light:
    over a sample's distance from white it makes the photo's ``curve_deviation``."""
    return photo.curve_deviation / -math.log(DISPLAY.sample)


def curve_shares(values: Array) -> Array:
    """How much of each knot's logarithm the values (...) of a file have, (..., knots)."""
    return knot_shares(np.log(np.maximum(values, TONE_CURVE.darkest)), LOG_KNOTS)


def likely_curves(printed: Array | None = None) -> tuple[Array, Array]:
    """Mean (knots,) and inverse covariance (knots, knots) of the logarithms, of cameras' curves.

    printed: (m, 2) values of a capture sheet's ink and of the paper beside it. In any light paper
    is as many times as bright as ink, and about so many, which tells how steep the curve is.
    """
    mean, covariance = curve_prior(np.asarray(KNOTS), FIXED)
    fixed = np.zeros(len(KNOTS))
    fixed[FIXED] = 1 / TONE_CURVE.fixed_deviation**2
    inverse = np.linalg.inv(covariance) + np.diag(fixed)
    if printed is None or not len(printed):
        return mean, inverse
    ink, paper = (curve_shares(values) for values in printed.T)
    paper_over_ink = printed[:, 1] / printed[:, 0]
    spans, missing = paper - ink, math.log(PAPER / INK_REFLECTANCE) - np.log(paper_over_ink)
    alike = INK_DEVIATION**2 + (PAPER_DEVIATION / PAPER) ** 2
    apart = TONE_CURVE.ink_noise**2 * max(1, len(printed) / TONE_CURVE.independent)
    weight = np.linalg.inv(apart * np.eye(len(printed)) + alike)
    known = inverse + spans.T @ weight @ spans
    return np.linalg.solve(known, inverse @ mean + spans.T @ weight @ missing), known
