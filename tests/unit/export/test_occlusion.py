"""Ambient occlusion against surfaces whose sky is known in closed form."""

import numpy as np
import pytest

from invrender.export.occlusion import ambient_occlusion


def test_flat_and_tilted_planes():
    """A plane sees all of its sky; of a slope s the upper half of the directions rise by s·cos φ,
    whose mean of cos² h is 1/2 + 1/(2·sqrt(1 + s²))."""
    assert (ambient_occlusion(np.full((32, 32), 3.0), 0.1) == 1).all()
    slope = 0.8
    x = np.broadcast_to(slope * np.arange(128), (128, 128))
    seen = ambient_occlusion(x, 1.0)[64, 64]
    assert seen == pytest.approx(0.5 + 0.5 / np.sqrt(1 + slope**2), abs=0.01)


@pytest.mark.parametrize("slope", [0.3, 1.0, 3.0])
def test_bottom_of_a_cone(slope):
    """The horizon stands at atan(slope) all around: cos² of it is 1/(1 + slope²)."""
    y, x = np.mgrid[-64:65, -64:65]
    seen = ambient_occlusion(slope * np.hypot(x, y) * 1e-3, 1e-3)
    assert seen[64, 64] == pytest.approx(1 / (1 + slope**2), rel=1e-4)


def test_foot_of_a_wall():
    """A wall without an end on one side hides half of the sky."""
    height = np.zeros((129, 129))
    height[:, 65:] = 1e6
    assert ambient_occlusion(height, 1.0)[64, 64] == pytest.approx(0.5, abs=0.13)


def test_unit_does_not_matter():
    height = np.random.default_rng(0).uniform(0, 1, (40, 40))
    a, b = ambient_occlusion(height, 1.0), ambient_occlusion(1e-3 * height, 1e-3)
    assert np.abs(a - b).max() < 1e-6
