"""What is set by hand: the camera by the sample's corners, the photo's turn, the ball."""

import math
from dataclasses import replace

import numpy as np
import pytest

from invrender.app.corrections import (
    camera_of_corners,
    find_corrected_lights,
    turn_between,
    turned,
)
from invrender.data import EXAMPLE
from invrender.files.capture import load_capture
from invrender.rig import Rig
from invrender.types import InputError

RIG = Rig()
SIZE = (720, 960)


@pytest.mark.parametrize("seed", range(6))
def test_the_camera_that_sees_these_corners(seed):
    rng = np.random.default_rng(seed)
    true = replace(
        RIG,
        camera_shift=tuple(rng.uniform(-0.02, 0.02, 3)),
        camera_tilt=tuple(rng.uniform(-12, 12, 3)),
    )
    found = camera_of_corners(RIG, true.project(RIG.sample_corners, *SIZE), *SIZE)
    np.testing.assert_allclose(found.camera_shift, true.camera_shift, atol=1e-5)
    np.testing.assert_allclose(found.camera_tilt, true.camera_tilt, atol=1e-2)


@pytest.mark.parametrize(
    "corners",
    [
        np.zeros((4, 2)), RIG.project(RIG.sample_corners, *SIZE)[::-1],
        RIG.project(RIG.sample_corners, *SIZE)[[0, 2, 1, 3]],
        [[0, 0], [900, 0], [10, 10], [0, 700]],
    ],
)  # fmt: skip
def test_no_camera_sees_these(corners):
    with pytest.raises(InputError, match="corner"):
        camera_of_corners(RIG, np.asarray(corners, float), *SIZE)


def test_a_turned_photo_is_turned_back():
    capture = load_capture(EXAMPLE)
    for turn in range(4):
        there = turned(capture, turn)
        assert turn_between(capture.photo, there.photo) == turn
        back = turned(there, -turn)
        np.testing.assert_array_equal(back.photo.image, capture.photo.image)
        assert back.rig.fov == pytest.approx(capture.rig.fov)
        focal = there.rig.focal(there.photo.width)
        assert focal == pytest.approx(capture.rig.focal(capture.photo.width))


def test_by_hand_as_by_itself():
    """Corners and ball where the program finds them give the lights that it finds."""
    capture = load_capture(EXAMPLE)
    by_itself = find_corrected_lights(capture, {})
    rig, photo = by_itself.lights.rig, by_itself.capture.photo
    corners = rig.project(rig.sample_corners, photo.height, photo.width)
    ball = [*by_itself.ball.centre, by_itself.ball.radius]
    quarter = turned(capture, 1)
    by_hand = find_corrected_lights(quarter, {"turn": 3, "corners": corners.tolist(), "ball": ball})
    assert math.dist(by_hand.ball.centre, by_itself.ball.centre) < 0.5
    np.testing.assert_allclose(by_hand.lights.gain, by_itself.lights.gain, rtol=0.03)
