"""What a lens loses towards the corners is found on the table, and undone."""

from functools import partial

import numpy as np
import pytest
from scipy import ndimage
from synthetic_photo import blocks, sky

from invrender.capture.mirror import make_ball
from invrender.capture.table import lit_table, room_irradiance, screen_irradiance
from invrender.capture.vignetting import find_vignetting, without_vignetting
from invrender.files.images import Photo
from invrender.lights import IDEAL
from invrender.rig import Rig, lens_gain, squared_distance
from invrender.sphere import directions

RIG, SIZE = Rig(), (240, 320)
BALL = make_ball(RIG, RIG.ball_centre, RIG.ball_radius, SIZE)
SCREEN = blocks(), np.array([0.8, 0.85, 0.75]), IDEAL
ROOM = sky(directions(32, 64).astype(float)).astype(np.float32)


@pytest.fixture(scope="module")
def table():
    """Radiance (H, W, 3) of a plain grey table."""
    h, w = 30, 40
    at = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1) * SIZE[0] / h
    ray = RIG.rays(at, *SIZE)
    points = (RIG.camera - ray * (RIG.camera[2] / ray[..., 2:])).reshape(-1, 3)
    light = screen_irradiance(RIG, points, SCREEN, 16) + room_irradiance(RIG, points, ROOM)
    return ndimage.zoom(
        0.1 * light.reshape(h, w, 3), (8, 8, 1), order=1, grid_mode=True, mode="nearest"
    )


def darkened(image, share):
    x, y = np.meshgrid(np.arange(SIZE[1]) + 0.5, np.arange(SIZE[0]) + 0.5)
    aside = squared_distance(np.stack([x, y], -1), *SIZE)
    return Photo((image / lens_gain(share, aside)[..., None]).astype(np.float32))


def found_in(photo):
    return find_vignetting(photo, RIG, partial(lit_table, photo, RIG, BALL, SCREEN, ROOM))


@pytest.mark.parametrize("share", [0.15, 0.4])
def test_the_table_tells_what_the_corners_lack(table, share):
    photo = darkened(table, share)
    corner = photo.image[0, 0] / table[0, 0]
    np.testing.assert_allclose(corner, 1 - share, atol=0.01)
    found = found_in(photo)
    assert found == pytest.approx(share, abs=0.04)
    np.testing.assert_allclose(without_vignetting(photo, found).image, table, rtol=0.06)


def test_a_lens_without_it_and_a_patterned_table_stay(table):
    assert found_in(Photo(table.astype(np.float32))) == 0
    texture = np.exp(ndimage.gaussian_filter(np.random.default_rng(1).normal(0, 4, SIZE), 6))
    photo = darkened(table * texture[..., None], 0.3)
    assert found_in(photo) == 0
    assert found_in(Photo(np.zeros((*SIZE, 3), np.float32))) == 0
