"""Lamps that are clipped, or hidden by the screen, are as bright as the table's shading says."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import ndimage
from synthetic_photo import blocks, grey_table, light_from, photograph, sky, textured_table

from invrender.capture.ball_image import screen_coordinates, trace_image
from invrender.capture.clipped_lamps import raise_clipped
from invrender.capture.environment import fill_environment, unfold_environment
from invrender.capture.hidden_lamp import add_hidden_lamp
from invrender.capture.mirror import make_ball
from invrender.capture.table import hidden_by_screen, lit_table, room_irradiance
from invrender.files.images import Photo
from invrender.lights import IDEAL
from invrender.rig import Rig
from invrender.sphere import directions, irradiance, solid_angles

RIG, SIZE = Rig(), (480, 640)
BALL = make_ball(RIG, RIG.ball_centre, RIG.ball_radius, SIZE)
IMAGE = trace_image(RIG, BALL)
PATTERN, GAIN = blocks(), np.array([0.8, 0.85, 0.75])
SCREEN = PATTERN, GAIN, IDEAL
TILTED = [(0.6, 0, 0.8), (-0.6, 0, 0.8), (0, 0.6, 0.8), (0, -0.6, 0.8)]
LEVEL = 0.95


def plain_table(point):
    """One grey, unlike `grey_table`, whose colours change smoothly as light does."""
    return np.full(point.shape, 0.3)


def room(d):
    """Below the clipping level but for two lamps."""
    return 1.2 * sky(d)


def hidden_lamp(d):
    """A dim room with a lamp that the screen hides from the ball but not from the table."""
    to_lamp = np.array([-0.3, 0.55, 1.0])
    near = d @ (to_lamp / np.linalg.norm(to_lamp))
    return 0.3 * sky(d) + 100 * np.exp((near - 1) / 0.004)[..., None] * np.array([1.0, 0.9, 0.7])


@pytest.fixture(scope="module")
def light():
    return table_light(room)


def table_light(room):
    """Irradiance (25, 33, 3) of the table within 0.15 m of the sample, by brute force."""
    d = directions(64, 128)[:32].reshape(-1, 3).astype(float)
    weight = np.repeat(solid_angles(64, 128)[:32], 128) * d[:, 2]
    out = np.empty((25, 33, 3))
    for i, y in enumerate(np.linspace(-0.15, 0.15, 25)):
        for j, x in enumerate(np.linspace(-0.2, 0.2, 33)):
            out[i, j] = weight @ light_from(RIG, np.array([x, y, 0]), d, room, PATTERN, GAIN)
    return out


def picture(light, albedo, room=room):
    """The photo with a Lambertian table, clipped, and what the ball shows of the room."""

    def table(point):
        at = [(point[..., 1] + 0.15) / 0.3 * 24, (point[..., 0] + 0.2) / 0.4 * 32]
        planes = [
            ndimage.map_coordinates(light[..., c], at, order=1, mode="nearest") for c in range(3)
        ]
        return albedo(point) * np.stack(planes, -1) / np.pi

    image = photograph(RIG, *SIZE, room, table, PATTERN, GAIN)
    photo = Photo(np.minimum(image, 1).astype(np.float32), LEVEL)
    environment, coverage = unfold_environment(photo, RIG, IMAGE, 64)
    return photo, fill_environment(environment, coverage), coverage


@pytest.mark.parametrize("albedo", [plain_table, textured_table])
def test_the_table_tells_how_bright_clipped_lamps_are(light, albedo):
    photo, environment, _ = picture(light, albedo)
    truth = room(directions(256, 512).astype(float))
    found = raise_clipped(photo, RIG, IMAGE, SCREEN, environment)
    raised, factor = found.environment, found.factor
    assert (found.gain == 1).all()

    def error(seen):
        each = [[irradiance(e, n) for n in [(0, 0, 1), *TILTED]] for e in (seen, truth)]
        return np.abs(np.subtract(*each)).mean() / np.mean(each[1])

    assert error(environment) > 0.15 and factor > 1.5
    assert error(raised) < 0.4 * error(environment)
    assert (raised >= environment - 1e-6).all()
    dark = environment.max(-1) < 0.7
    assert (raised == environment)[dark].mean() > 0.99  # all but those beside a lamp


def test_a_channel_just_below_white_is_raised_with_the_others(light):
    """A JPEG's colours are coarse: beside a small lamp one channel may stay below white."""
    photo, environment, _ = picture(light, plain_table)
    image = photo.image.copy()
    image[..., 0] = np.where(image[..., 0] >= LEVEL, 0.97 * LEVEL, image[..., 0])
    part = raise_clipped(replace(photo, image=image), RIG, IMAGE, SCREEN, environment)
    whole = raise_clipped(photo, RIG, IMAGE, SCREEN, environment)
    found, lamps = part.environment, part.lamps
    assert abs(part.factor / whole.factor - 1) < 0.1
    rise, rise_wanted = ((x - environment).sum((0, 1)) for x in (found, whole.environment))
    np.testing.assert_allclose(rise, rise_wanted, rtol=0.15)
    assert lamps is not None and (lamps <= found).all()
    np.testing.assert_allclose((found - lamps).max(), LEVEL, rtol=0.2)


@pytest.mark.parametrize("times", [0.6, 1.5])
def test_the_table_tells_a_gain_that_the_ball_leaves_in_doubt(light, times):
    photo, environment, _ = picture(light, plain_table)
    wrong = PATTERN, GAIN * times, IDEAL
    deviation = 0.6
    factor = raise_clipped(photo, RIG, IMAGE, wrong, environment, deviation).gain
    assert abs(np.log(factor * times).mean()) < 0.5 * abs(np.log(times))
    # A gain that the ball shows well is not touched.
    factor = raise_clipped(photo, RIG, IMAGE, wrong, environment, 0.01).gain
    assert (factor == 1).all()


def test_a_hidden_lamp_cannot_make_the_screen_dark():
    """In a JPEG no such lamp is looked for, and light that the screen hides from the table looks
    like a dim screen: the ball's own doubt limits what the table may change."""
    photo, environment, _ = picture(table_light(hidden_lamp), plain_table, hidden_lamp)
    for deviation, most in ((0.11, 0.4), (0.14, 0.5), (0.43, 0.86)):
        found = raise_clipped(photo, RIG, IMAGE, SCREEN, environment, deviation)
        assert abs(np.log(found.gain).mean()) < most


def test_nothing_clipped_nothing_raised(light):
    photo, environment, _ = picture(light, grey_table)
    for whole in (replace(photo, clip_level=None), replace(photo, clip_level=2.0)):
        found = raise_clipped(whole, RIG, IMAGE, SCREEN, environment)
        assert found.environment is environment and found.factor == 1
        assert (found.gain == 1).all() and found.lamps is None


def with_hidden_lamp(photo, filled, coverage):
    table = partial(lit_table, photo, RIG, BALL, SCREEN, filled)
    return add_hidden_lamp(photo, RIG, BALL, table, filled, coverage)


def test_the_table_tells_of_a_lamp_behind_the_screen():
    photo, environment, coverage = picture(table_light(hidden_lamp), plain_table, hidden_lamp)
    photo = replace(photo, clip_level=None)
    found, times = with_hidden_lamp(photo, environment, coverage)
    assert times > 20
    np.testing.assert_array_equal(found[coverage > 0], environment[coverage > 0])
    truth = hidden_lamp(directions(64, 128).astype(float))
    truth[32:] = 0
    points = RIG.sample_points(3, 3).reshape(-1, 3)
    dim, new, true = (room_irradiance(RIG, points, e) for e in (environment, found, truth))
    assert np.abs(dim - true).mean() > 0.5 * true.mean()
    assert np.abs(new - true).mean() < 0.3 * np.abs(dim - true).mean()


@pytest.mark.parametrize("albedo", [plain_table, grey_table, textured_table])
def test_no_lamp_behind_the_screen_where_there_is_none(light, albedo):
    """Nor in a JPEG, nor where the table is black."""
    photo, environment, coverage = picture(light, albedo)
    whole = replace(photo, clip_level=None)
    for some in (whole, photo, replace(whole, image=0 * photo.image)):
        found, times = with_hidden_lamp(some, environment, coverage)
        assert found is environment and times == 1


@pytest.mark.parametrize("table", [0.0, 1e-6, 0.94, 1.0])
def test_a_table_that_says_nothing_leaves_the_prior(table, light):
    """Black, nearly so, or saturated itself: the factor stays finite and moderate."""
    photo, environment, _ = picture(light, grey_table)
    image = photo.image.copy()
    image[:, :250] = image[:, 390:] = table
    image[:180] = image[300:] = table
    bad = replace(photo, image=image)
    found = raise_clipped(bad, RIG, IMAGE, SCREEN, environment)
    raised, factor = found.environment, found.factor
    assert np.isfinite(raised).all() and 1 <= factor < 500


def test_hidden_directions_are_those_that_hit_the_screen():
    rig = replace(RIG, screen_tilt=(2.0, 3.0, 10.0))
    d = directions(32, 64).reshape(-1, 3).astype(float)
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (20, 3)) * [1, 1, 0]
    hidden = hidden_by_screen(rig, points, d)
    for p, row in zip(points, hidden, strict=True):
        np.testing.assert_array_equal(row, screen_coordinates(rig, p, d)[2])
    assert 0.05 < hidden.mean() < 0.3
