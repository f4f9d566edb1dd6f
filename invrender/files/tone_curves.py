"""What cameras make of light before they encode it: tone curves as they are likely to be.

A curve is known by few points of it, so that the rest comes from what is usual. The family has a
shoulder, (1 + k)x/(1 + kx) (Reinhard et al. 2002), or Narkowicz's fit of the ACES curve (2015),
then an S, a share of the smooth step 3e² - 2e³ of encoded values, and an exponent, in all
combinations. The mean of the family's logarithms and their covariance are a Gaussian prior, as
Grossberg and Nayar's (2004) model of measured responses is, with other curves.
"""

from __future__ import annotations

import itertools

import numpy as np

from invrender.colour import linear_to_srgb, srgb_to_linear
from invrender.types import Array

# The members; chosen by hand, to reach from a straight file to a strong film-like curve.
SHOULDERS = (0.0, 0.3, 0.8, 1.5, 2.5)
CONTRASTS = (0.0, 0.15, 0.3, 0.45)
EXPONENTS = (0.9, 1.0, 1.1)
ACES_EXPOSURES = (0.5, 1.0, 2.0)  # light at which that curve is cut off
# Logarithms: by how much a camera's curve differs from all members, independently at each knot.
OTHERWISE = 0.03
# Values of a file, of white, between which a curve's logarithm is linear; chosen by hand. At the
# fixed one light and value are equal.
KNOTS = (0.003, 0.01, 0.03, 0.08, 0.2, 0.4, 0.65, 0.95)
FIXED = 4
LEAST_LIGHT, COUNT = 1e-3, 400  # light at which a curve starts, white being 1; values of its table


def members(light: Array) -> Array:
    """Linear values in files (curves, n) that cameras make of light (n,) between 0 and 1."""

    def aces(x: Array) -> Array:
        return np.asarray(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14))

    shoulders = [(1 + k) * light / (1 + k * light) for k in SHOULDERS]
    shoulders += [aces(light * white) / aces(np.array(white)) for white in ACES_EXPOSURES]
    out = []
    for values, contrast, exponent in itertools.product(shoulders, CONTRASTS, EXPONENTS):
        e = linear_to_srgb(values**exponent)
        out.append(srgb_to_linear(e + contrast * (3 * e**2 - 2 * e**3 - e)))
    return np.stack(out)


def curve_prior(knots: Array, fixed: int) -> tuple[Array, Array]:
    """Mean (k,) and covariance (k, k) of log light over value, where the file's value is one of the
    ``knots`` (k,), in units in which both are equal at the ``fixed`` one."""
    light = np.geomspace(LEAST_LIGHT, 1, COUNT)
    rows = []
    for values in members(light):
        log = np.interp(np.log(knots), np.log(values), np.log(light)) - np.log(knots)
        rows.append(log - log[fixed])
    curves = np.array(rows)
    return curves.mean(0), np.cov(curves.T) + OTHERWISE**2 * np.eye(len(knots))
