"""One Schmidt–Kalman step, for a prior whose errors whole materials share."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from invrender.refine.gauss_newton import UNLIKELY, Refined, Shot, _bands, _spread
from invrender.refine.priors import Prior
from invrender.refine.theta import project, to_maps

SHARE = np.array([1] * 6 + [0] + [0.2] * 2, np.float32)  # of its step that each of θ takes
LIGHT_NOISE = (0.1, 0.05)  # as PHOTO_NOISE, for what the lights' estimate adds to it


def correct(shots: Sequence[Shot], prior: Prior, *, samples: int = 64) -> Refined:
    """One cautious step from a prior whose errors are shared by whole materials.

    A network errs alike over a material, so what a pixel's own numbers say of roughness or slopes
    is mostly an error of something else. As in the Schmidt–Kalman filter, every parameter's
    uncertainty counts in the expected spread of the residual, but each takes only its `SHARE` of
    the step. The posterior is that of this suboptimal gain K: (1 - KJ)Σ(1 - KJ)ᵀ + KRKᵀ, with the
    prior's total error in Σ, and in R what gains and room may be off by.
    """
    began = time.perf_counter()
    theta, sigma = project(prior.mean.copy()), prior.sigma
    left = (sigma if prior.total is None else prior.total).copy()
    squares, seen = 0.0, 0
    interrupted = False
    try:
        for band in _bands(shots, LIGHT_NOISE, samples):
            rows = band.rows
            residual, jacobian = band.residual(theta[rows])
            squares, seen = squares + band.squares(residual), seen + int(band.seen.sum())
            _, ac, inverse = _spread(jacobian, sigma[rows], prior.correlation, band.noise)
            surprise = np.einsum("hwc,hwcd,hwd->hw", residual, inverse, residual)
            surprise /= residual.shape[-1]
            trust = np.sqrt(np.minimum(1, UNLIKELY / np.maximum(surprise, 1e-12)))
            gain = SHARE[:, None] * trust[..., None, None] * (np.swapaxes(ac, -1, -2) @ inverse)
            z = np.einsum("hwpc,hwc->hwp", gain, residual)
            theta[rows] = project((theta[rows] + sigma[rows] * z).astype(np.float32))
            gain *= sigma[rows][..., None]
            rest = (np.eye(9, dtype=np.float32) - gain @ jacobian) * left[rows][..., None, :]
            variance = np.einsum("hwpq,qr,hwpr->hwp", rest, prior.correlation, rest)
            measured = np.where(band.seen, band.noise, 0)  # where clipped, the gain is nought
            variance += np.einsum("hwpc,hwc,hwpc->hwp", gain, measured, gain)
            left[rows] = np.sqrt(np.clip(variance, 0, None))
    except KeyboardInterrupt:
        interrupted = True
    error = float(np.sqrt(squares / max(seen, 1)))
    history = [{"seconds": time.perf_counter() - began, "photo_error": error}]
    return Refined(to_maps(theta), left, history, not interrupted, interrupted)
