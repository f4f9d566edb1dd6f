"""Lights of photos without a screen: the ball shows the whole room."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_photo import photograph, sky, textured_table

from invrender.capture.lights import find_lights
from invrender.data.simulate_setup import without_screen
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.lights import NO_PATTERN
from invrender.pipeline import reconstruct
from invrender.report.result import Result
from invrender.rig import Rig
from invrender.sphere import directions, irradiance

RIG = without_screen(Rig())
SIZE = (720, 960)


@pytest.fixture(scope="module")
def photo():
    return photograph(RIG, *SIZE, table=textured_table)


def test_the_whole_sky_is_found(photo):
    found = find_lights(Capture(Photo(photo), RIG, NO_PATTERN))
    lights = found.lights
    height = len(lights.environment)
    up = directions(height, 2 * height)[..., 2] > 0
    assert lights.coverage[up].min() > 0.9
    truth = sky(directions(height, 2 * height)) * up[..., None]
    np.testing.assert_allclose(irradiance(lights.environment), irradiance(truth), rtol=0.02)
    assert not np.any(lights.gain) and not found.notices


def test_a_photo_on_its_side_is_turned_by_the_samples_square(photo):
    rows, columns = np.indices(SIZE)
    pixels = np.stack([columns, rows], -1) + 0.5
    rays = RIG.rays(pixels, *SIZE)
    at = (RIG.camera - rays * (RIG.camera[2] / rays[..., 2:]))[..., :2]
    square = (np.abs(at) < RIG.sample_size / 2).all(-1)
    image = np.where(square[..., None], [0.5, 0.1, 0.1] + 0.3 * photo, photo).astype(np.float32)
    side = np.tan(np.radians(RIG.fov) / 2) * SIZE[0] / SIZE[1]
    rig = replace(RIG, fov=float(np.degrees(2 * np.arctan(side))))
    capture = Capture(Photo(np.rot90(image).copy()), rig, NO_PATTERN)
    found = find_lights(capture)
    assert [n.code for n in found.notices] == ["photo-turned"]
    assert found.capture.photo.image.shape == image.shape
    assert found.lights.rig.fov == pytest.approx(RIG.fov, abs=0.01)
    np.testing.assert_allclose(found.capture.photo.image, image)


def test_a_room_that_is_told_needs_no_ball(photo):
    room = np.ones((8, 16, 3), np.float32)
    found = find_lights(Capture(Photo(photo), RIG, NO_PATTERN), environment=room)
    assert found.ball is None and found.lights.environment is room


def test_a_result_without_a_screen_is_kept_and_read_again(photo, tmp_path):
    room = np.ones((8, 16, 3), np.float32)
    found = find_lights(Capture(Photo(photo), RIG, NO_PATTERN), environment=room)
    result = reconstruct([found, found], size=16, init="flat")
    (tmp_path / "pattern_shown.exr").write_bytes(b"an older result's")
    result.save(tmp_path)
    assert not list(tmp_path.glob("pattern*"))
    again = Result.load(tmp_path)
    assert not again.lights.rig.has_screen
    np.testing.assert_allclose(again.render(), result.render(), rtol=1e-3)
    assert "Screen" not in (tmp_path / "report.html").read_text()
