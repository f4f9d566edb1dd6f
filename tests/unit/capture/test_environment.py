"""Light that is no image of the room: a veil over the ball, and the screen's own, spread."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from synthetic_photo import blocks, grey_table, photograph, sky, textured_table

from invrender.capture.ball_image import trace_image
from invrender.capture.environment import fill_environment, unfold_environment
from invrender.capture.glare import remove_glare
from invrender.capture.mirror import make_ball
from invrender.capture.table import hidden_by_screen, room_irradiance
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sphere import directions, irradiance

RIG, SIZE = Rig(), (720, 960)
BALL = make_ball(RIG, RIG.ball_centre, RIG.ball_radius, SIZE)
IMAGE = trace_image(RIG, BALL)


@pytest.fixture(scope="module", params=[grey_table, textured_table])
def image(request):
    return photograph(RIG, *SIZE, sky, request.param, blocks())


def veil(angle, width, colour):
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    u = (x - BALL.centre[0]) / BALL.radius - np.cos(angle)
    v = (y - BALL.centre[1]) / BALL.radius - np.sin(angle)
    return np.exp(-(u**2 + v**2) / width**2)[..., None] * np.array(colour)


@pytest.mark.parametrize("angle", [0.5, 4.0])
def test_a_veil_is_lifted(image, angle):
    light = veil(angle, 0.5, (0.3, 0.4, 0.35))
    found = remove_glare(Photo((image + light).astype(np.float32)), RIG, IMAGE).image
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    above = np.hypot(x - BALL.centre[0], y - BALL.centre[1]) < 0.7 * BALL.radius
    assert np.abs(found - image)[above].mean() < 0.3 * light[above].mean()


def test_without_a_veil_nothing_changes(image):
    rng = np.random.default_rng(3)
    noisy = image + 0.02 * rng.standard_normal(image.shape)
    for photo in (Photo(image), Photo(np.maximum(noisy, 0).astype(np.float32))):
        assert remove_glare(photo, RIG, IMAGE) is photo
    black = Photo(np.zeros_like(image))
    assert remove_glare(black, RIG, IMAGE) is black


def test_saturated_pixels_stay_saturated(image):
    light = image + veil(2.0, 0.5, (2.0, 2.0, 2.0))
    photo = Photo(np.minimum(light, 1).astype(np.float32), 0.99)
    found = remove_glare(photo, RIG, IMAGE)
    assert photo.clipped.any() and (found.clipped == photo.clipped).all()


def test_the_screen_does_not_light_the_room_beside_it():
    """A room 30 times as dark as the screen: its light must not count as the room's."""
    level = 0.1
    dark = photograph(RIG, *SIZE, lambda d: level + 0 * d, grey_table, blocks(), (3.0, 3.0, 3.0))
    photo = Photo(ndimage.gaussian_filter(dark, (1.2, 1.2, 0)))
    even = np.where(np.arange(64)[:, None, None] < 32, level, 0) * np.ones((64, 128, 3))

    def error(blur):
        room, coverage = unfold_environment(photo, RIG, IMAGE, 64, blur=blur)
        assert coverage[:32].mean() > 0.6
        found, true = (
            room_irradiance(RIG, np.zeros((1, 3)), e)
            for e in (fill_environment(room, coverage), even)
        )
        return np.abs(room[:24] / level - 1)[coverage[:24] > 0].max(), np.abs(
            found / true - 1
        ).max()

    (texel, light), (told_texel, told_light) = error(0), error(1.2)
    assert texel > 1 and told_texel < 0.3
    assert light > 0.05 and told_light < 0.02


def test_a_bezel_is_not_the_room():
    """Its black pixels in the ball are no dark wall, and what it hides does not light the table."""
    level, bezel = 0.1, 0.03
    rig = replace(RIG, screen_bezel=bezel)
    image = photograph(RIG, *SIZE, lambda d: level + 0 * d, grey_table, blocks())
    black = IMAGE.screen(rig) & ~IMAGE.screen(RIG)
    image[IMAGE.area][black] = 0
    photo = Photo(image)
    seen = {}
    for given in (RIG, rig):
        room, coverage = unfold_environment(photo, given, IMAGE, 64)
        seen[given] = room[:24][coverage[:24] > 0] / level
    assert np.abs(seen[rig] - 1).max() < 0.3
    assert seen[RIG].min() < 0.5
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (20, 3)) * [1, 1, 0]
    d = directions(32, 64).reshape(-1, 3).astype(float)
    larger = Rig(0.18 + 2 * bezel, sample_side=0.09, screen_shift=(bezel, 0.0, 0.0))
    hidden = hidden_by_screen(rig, points, d)
    np.testing.assert_array_equal(hidden, hidden_by_screen(larger, points, d))
    assert (hidden & ~hidden_by_screen(RIG, points, d)).any()


def test_a_lamp_right_beside_the_screen_is_seen():
    """Where the screen's light may spread, what is far brighter than the screen is a lamp."""
    white = np.full(3, 2.0)
    far = directions(64, 128).astype(float)
    edge = np.array([RIG.screen_corner[0] + RIG.screen_edges[0][0] + 0.004, 0.0, RIG.screen_height])
    toward = edge - RIG.ball_centre
    toward /= np.linalg.norm(toward)

    def room(d):
        lamp = np.asarray(d @ toward > np.cos(np.radians(2)))
        return 0.2 + 100.0 * lamp[..., None] * np.ones(3)

    def table(point):
        return np.full((*point.shape[:-1], 3), 0.1)

    image = photograph(RIG, *SIZE, room, table, np.ones((8, 8, 3)), white)
    photo = Photo(image.astype(np.float32))
    light = [
        irradiance(fill_environment(*unfold_environment(photo, RIG, IMAGE, 64, 1.0, w)), (0, 0, 1))
        for w in (None, white)
    ]
    truth = room(far)
    truth[32:] = 0
    true = irradiance(truth, (0, 0, 1))
    dark, found = (float(np.mean(np.abs(e - true) / true)) for e in light)
    assert found < 0.2 < dark
