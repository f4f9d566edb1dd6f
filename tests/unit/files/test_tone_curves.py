"""The family of cameras' curves, and the prior that it gives."""

import numpy as np

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
