"""The family of cameras' curves, and the prior that it gives."""

import numpy as np
import pytest

from invrender.capture.response import Response
from invrender.capture.settings import TONE_CURVE
from invrender.files import tone_curves
from invrender.files.images import Photo
from invrender.files.tone_curves import FIXED, curve_prior, members

KNOTS = np.array(tone_curves.KNOTS)


def test_members_rise_from_black_to_white():
    light = np.geomspace(1e-3, 1, 200)
    curves = members(light)
    assert np.isfinite(curves).all() and (np.diff(curves) > 0).all()
    np.testing.assert_allclose(curves[:, -1], 1, atol=1e-6)
    straight = np.abs(curves - light).max(1).min()
    assert straight < 1e-6  # a straight file is among them


def test_every_member_is_likely_under_the_prior():
    """Squared Mahalanobis distances from the mean are about as many as there are knots."""
    mean, covariance = curve_prior(KNOTS, FIXED)
    assert mean[FIXED] == 0 and np.linalg.eigvalsh(covariance).min() > 0
    light = np.geomspace(1e-3, 1, 400)
    distances = []
    for values in members(light):
        log = np.interp(np.log(KNOTS), np.log(values), np.log(light)) - np.log(KNOTS)
        off = log - log[FIXED] - mean
        distances.append(off @ np.linalg.solve(covariance, off))
    assert np.mean(distances) < len(KNOTS) and np.max(distances) < 35
    # A curve with a period in the logarithm is not.
    wave = 0.4 * np.sin(2 * np.pi * np.log(KNOTS / KNOTS[FIXED]) / np.log(10))
    assert wave @ np.linalg.solve(covariance, wave) > 50


def test_curves_of_cameras_are_believed_and_waves_are_not():
    light = np.geomspace(1e-3, 1, 400)
    likely, flat = [], []
    for values in members(light):
        log = np.interp(np.log(KNOTS), np.log(values), np.log(light)) - np.log(KNOTS)
        log -= log[FIXED]
        flat.append(log[-1] > TONE_CURVE.shoulder)
        likely.append(Response(tuple(log)).is_likely)
    assert likely == flat and np.mean(flat) > 0.5  # the others are nearly straight
    wave = (0.0, -0.41, -0.1, 0.25, 0.0, 0.48, 0.28, 0.42)  # as was fitted to a straight file
    assert not Response(wave).is_likely
    assert not Response((0.0,) * len(KNOTS)).is_likely


def test_a_curve_and_its_undoing_are_inverse():
    response = Response((-0.1, 0.0, 0.02, -0.03, 0.0, 0.1, 0.3, 0.5))
    light = np.geomspace(1e-3, 1.2, 300)
    values, steep = response.apply(light)
    back = response.undo(Photo(np.tile(values[None, :, None], (1, 1, 3)).astype(np.float32), 0.95))
    np.testing.assert_allclose(back.image[0, :, 0], light, rtol=1e-4)
    assert back.linear and back.clip_level == pytest.approx(0.95 * np.exp(0.5))
    slope = np.gradient(np.log(values), np.log(light))
    assert np.median(np.abs(steep - slope)) < 0.01
