"""Rigs as people have them: balls of steel, full spheres, no field of view, cropped photos."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_photo import blocks, grey_table, photograph, textured_table

from invrender.capture import orientation
from invrender.capture.ball import find_ball, find_fov
from invrender.capture.lights import find_lights, level_table
from invrender.capture.mirror import make_ball
from invrender.colour import PRIMARIES, to_rec709
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import InputError

RIG, SIZE = Rig(), (720, 960)
PATTERN, GAIN = blocks(), (2.0, 2.1, 1.9)
STEEL = replace(RIG, ball_reflectance=(0.57, 0.55, 0.52))
SHIFT = (0.002, -0.001)
UNKNOWN = frozenset({"ball_reflectance", "ball_shape"})


def noisy_photo(rig, table=textured_table, noise=0.01, seed=0):
    image = photograph(rig, *SIZE, table=table, ball=SHIFT)
    grain = noise * np.sqrt(image) * np.random.default_rng(seed).standard_normal(image.shape)
    return Photo(np.maximum(image + grain, 0).astype(np.float32))


def off(ball, rig):
    """The greater error of centre and radius, in radii."""
    centre = rig.ball_centre + np.array([*SHIFT, 0.0])
    true = make_ball(rig, centre, rig.ball_radius, SIZE)
    distance = np.hypot(*np.subtract(ball.centre, true.centre))
    return max(distance, abs(ball.radius - true.radius)) / true.radius


@pytest.fixture(scope="module")
def steel():
    return noisy_photo(STEEL)


@pytest.mark.parametrize("reflectance", [0.42, pytest.param(0.7, marks=pytest.mark.slow), 0.95])
def test_a_ball_is_found_before_its_reflectance_is_known(reflectance):
    rig = replace(RIG, ball_reflectance=(reflectance, 0.97 * reflectance, 0.92 * reflectance))
    ball = find_ball(noisy_photo(rig, grey_table), RIG)
    assert off(ball, rig) < 0.01 and ball.confidence > 0.7
    np.testing.assert_allclose(ball.reflectance, rig.ball_reflectance, rtol=0.04)
    assert 0.01 < ball.reflectance_deviation < 0.05


def test_the_lights_of_a_steel_ball_are_as_bright_as_they_are(steel):
    found = find_lights(Capture(steel, RIG, PATTERN, unknown=UNKNOWN))
    np.testing.assert_allclose(found.lights.gain, GAIN, rtol=0.04)
    assert [n.code for n in found.notices] == ["ball-reflectance-measured"]
    assert found.lights.fit["ball_reflectance"] == pytest.approx(0.547, rel=0.04)
    assert found.lights.fit["ball_reflectance_deviation"] > 0


def test_a_photo_in_wider_primaries_gives_the_same_lights():
    """A phone's JPEG has Display P3, in which the pattern's colours are no longer pure."""
    matrix = to_rec709(PRIMARIES["p3d65"])
    scene = photograph(STEEL, *SIZE, table=grey_table, ball=SHIFT).astype(np.float32)
    wide = (scene @ np.linalg.inv(matrix).T).astype(np.float32)
    level = 2 * float(scene.max())
    photo = Photo(wide, level, matrix=matrix)
    found = find_lights(Capture(photo, RIG, PATTERN, unknown=UNKNOWN))
    np.testing.assert_allclose(found.lights.gain, GAIN, rtol=0.04)
    np.testing.assert_allclose(found.lights.device.mixing, np.eye(3), atol=0.02)
    np.testing.assert_allclose(found.capture.photo.image, scene, atol=1e-3)
    bright = replace(photo, clip_level=float(np.quantile(wide, 0.999)))
    assert bright.clipped.any()
    np.testing.assert_array_equal(bright.in_rec709().clipped, bright.clipped)


def test_a_stated_reflectance_is_used_and_doubted(steel):
    found = find_lights(Capture(steel, RIG, PATTERN))
    wrong = np.array(STEEL.ball_reflectance) / RIG.ball_reflectance
    np.testing.assert_allclose(found.lights.gain, wrong * GAIN, rtol=0.04)
    assert [n.code for n in found.notices] == ["ball-reflectance-doubtful"]
    right = find_lights(Capture(steel, STEEL, PATTERN))
    np.testing.assert_allclose(right.lights.gain, GAIN, rtol=0.02)
    assert not right.notices


@pytest.mark.parametrize(
    ("table", "radius"),
    [
        (grey_table, 0.0125),
        (textured_table, 0.0095),
        pytest.param(grey_table, 0.0095, marks=pytest.mark.slow),
        pytest.param(textured_table, 0.0125, marks=pytest.mark.slow),
    ],
)
def test_a_full_sphere_is_recognised(table, radius):
    sphere = replace(STEEL, ball_shape="sphere", ball_radius=radius)
    nominal = replace(RIG, ball_radius=radius)
    capture = Capture(noisy_photo(sphere, table), nominal, PATTERN, unknown=UNKNOWN)
    found = find_lights(capture)
    assert found.lights.rig.ball_shape == "sphere"
    assert off(found.ball, sphere) < 0.015
    assert found.ball.position[2] == pytest.approx(radius, rel=0.02)
    np.testing.assert_allclose(found.lights.gain, GAIN, rtol=0.06)


def test_a_hemisphere_is_no_sphere(steel):
    found = find_lights(Capture(steel, RIG, PATTERN, unknown=UNKNOWN))
    assert found.lights.rig.ball_shape == "hemisphere" and found.ball.position[2] == 0


def test_beside_the_sheet_the_balls_size_decides_its_shape(monkeypatch):
    """A sphere that looks a little more like a hemisphere of another size; what the sheet measures
    counts for more."""
    seen = {"hemisphere": (0.9, 1.06), "sphere": (0.84, 1.0)}

    def find_ball(photo, rig, *given):
        confidence, size = seen[rig.ball_shape]
        return SimpleNamespace(confidence=confidence, radius_m=size * rig.ball_radius)

    monkeypatch.setattr(orientation, "find_ball", find_ball)
    capture = Capture(Photo(np.ones((8, 8, 3), np.float32)), RIG, PATTERN, unknown=UNKNOWN)
    for known, shape in (("rig", "hemisphere"), ("sheet", "sphere")):
        found, _ = orientation.find_either_ball(replace(capture, fov_from=known), None, 1.0)
        assert found.rig.ball_shape == shape


@pytest.mark.parametrize("fov", [52.0, pytest.param(84.0, marks=pytest.mark.slow)])
def test_the_field_of_view_is_measured_by_the_ball(fov):
    true = replace(STEEL, fov=fov)
    found = find_fov(noisy_photo(true), RIG)
    assert found == pytest.approx(fov, abs=0.5)
    ball = make_ball(true, true.ball_centre, true.ball_radius, SIZE)
    by_hand = find_fov(noisy_photo(true), RIG, (*ball.centre, ball.radius))
    assert by_hand == pytest.approx(fov, abs=0.02)


def test_a_photo_cropped_off_centre_is_refused(steel):
    cropped = Photo(np.ascontiguousarray(steel.image[90:, 130:]))
    with pytest.raises(InputError, match="cropped"):
        find_lights(Capture(cropped, RIG, PATTERN))


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_a_straight_camera_stays_straight_under_noise(seed):
    table = (grey_table, textured_table)[seed % 2]
    photo = noisy_photo(RIG, table, noise=0.02 * (seed + 1), seed=seed)
    assert level_table(photo, RIG, find_ball(photo, RIG)) is RIG
