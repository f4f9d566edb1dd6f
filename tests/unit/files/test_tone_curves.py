"""The family of cameras' curves, and the prior that it gives."""

import numpy as np

from invrender.capture.response import Response
from invrender.capture.settings import TONE_CURVE
from invrender.files.tone_curves import curve_prior, members

KNOTS = np.array([0.003, 0.01, 0.03, 0.08, 0.2, 0.4, 0.65, 0.95])


def test_members_rise_from_black_to_white():
    light = np.geomspace(1e-3, 1, 200)
    curves = members(light)
    assert np.isfinite(curves).all() and (np.diff(curves) > 0).all()
    np.testing.assert_allclose(curves[:, -1], 1, atol=1e-6)
    straight = np.abs(curves - light).max(1).min()
    assert straight < 1e-6  # a straight file is among them


def test_every_member_is_likely_under_the_prior():
    """Squared Mahalanobis distances from the mean are about as many as there are knots."""
    mean, covariance = curve_prior(KNOTS, 3)
    assert mean[3] == 0 and np.linalg.eigvalsh(covariance).min() > 0
    light = np.geomspace(1e-3, 1, 400)
    distances = []
    for values in members(light):
        log = np.interp(np.log(KNOTS), np.log(values), np.log(light)) - np.log(KNOTS)
        off = log - log[3] - mean
        distances.append(off @ np.linalg.solve(covariance, off))
    assert np.mean(distances) < len(KNOTS) and np.max(distances) < 35
    # A curve with a period in the logarithm is not.
    wave = 0.4 * np.sin(2 * np.pi * np.log(KNOTS / KNOTS[3]) / np.log(10))
    assert wave @ np.linalg.solve(covariance, wave) > 50


def test_curves_of_cameras_are_believed_and_waves_are_not():
    knots = np.array(TONE_CURVE.knots)
    light = np.geomspace(1e-3, 1, 400)
    steepest = []
    for values in members(light):
        log = np.interp(np.log(knots), np.log(light), np.log(values)) - np.log(knots)
        log -= log[TONE_CURVE.fixed]
        slopes = np.diff(log[TONE_CURVE.fixed : TONE_CURVE.white + 1])
        slopes /= np.diff(np.log(knots[TONE_CURVE.fixed : TONE_CURVE.white + 1]))
        steepest.append(np.diff(slopes).max())
    assert max(steepest) < 0.6 * TONE_CURVE.steeper
    filmic = (-0.3, -0.2, -0.1, 0, 0.02, -0.05, -0.2, -0.4, -0.8)
    wave = (0.41, 0.08, -0.25, 0, -0.48, -0.28, -0.34, -0.38, -0.42)  # fitted to a straight file
    assert Response(filmic).is_likely and not Response(wave).is_likely
    assert not Response((0.0,) * 9).is_likely
