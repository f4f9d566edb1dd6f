"""The camera's pose from the sample's square in the photo."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_photo import grey_table, textured_table

from invrender.capture.camera import corners, find_camera
from invrender.capture.crop import crop_sample
from invrender.files.images import Photo
from invrender.rig import Rig

RIG = Rig()
SIZE = (720, 960)


def weave(point):
    """A sample with lines of its own, some of them close to its border."""
    x, y = point[..., 0], point[..., 1]
    lines = (np.mod(x + 0.04, 0.0121) < 0.002) | (np.mod(y + 0.041, 0.0121) < 0.002)
    return np.where(lines[..., None], [0.2, 0.1, 0.1], [0.6, 0.6, 0.5])


def marble(point):
    x, y = point[..., 0], point[..., 1]
    value = 0.5 + 0.3 * np.sin(x * 240 + 4 * np.sin(y * 130)) * np.sin(y * 310 + x * 90)
    return value[..., None] * np.array([0.5, 0.7, 0.8])


def snap(rig, sample, table=grey_table, noise=0.0):
    """The table and the sample on it, without a ball, (H, W, 3)."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    ray = rig.rays(np.stack([x, y], -1), *SIZE)
    point = rig.camera - ray * (rig.camera[2] / ray[..., 2])[..., None]
    image = table(point)
    if sample is not None:
        on = (np.abs(point[..., :2]) < rig.sample_size / 2).all(-1)
        image = np.where(on[..., None], sample(point), image)
    image = image + noise * np.random.default_rng(1).standard_normal(image.shape)
    return Photo(np.maximum(image, 0).astype(np.float32))


def held(seed):
    """A rig whose camera a hand holds some millimetres and degrees off."""
    rng = np.random.default_rng(seed)
    return replace(
        RIG,
        camera_shift=tuple(rng.normal(0, 2e-3, 3)),
        camera_tilt=tuple(np.clip(rng.normal(0, 1.2, 3), -3, 3)),
    )


def off(photo, rig, true):
    """Mean distance of the sample's corners, in its sides."""
    a, b = corners(photo, rig), corners(photo, true)
    return np.linalg.norm(a - b, axis=-1).mean() / np.linalg.norm(b[1] - b[0])


@pytest.mark.parametrize(
    "table", [pytest.param(grey_table, marks=pytest.mark.slow), textured_table]
)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_moved_camera_is_found(table, seed):
    rig = held(seed)
    photo = snap(rig, marble, table, noise=0.01)
    assert off(photo, RIG, rig) > 0.02
    found, _ = find_camera(photo, RIG)
    assert off(photo, found, rig) < 0.005
    assert np.linalg.norm(np.subtract(found.camera_tilt, rig.camera_tilt)[:2]) < 0.4
    assert np.linalg.norm(np.subtract(found.camera_shift, rig.camera_shift)) < 1e-3


@pytest.mark.parametrize("table", [grey_table, textured_table])
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_a_sample_with_lines_of_its_own_does_not_mislead(table, seed):
    rig = held(seed)
    photo = snap(rig, weave, table, noise=0.01)
    found, _ = find_camera(photo, RIG)
    assert (found is RIG and table is textured_table) or off(photo, found, rig) < 0.005


@pytest.mark.parametrize("sample", [marble, weave])
@pytest.mark.parametrize("tilt", [(2.0, -1.2, 1.5), (-2.0, -1.5, -1.0), (-1.0, 2.0, 2.0)])
def test_a_square_far_from_its_place_is_found(sample, tilt):
    """An eighth of its side off, since the camera stands high; a shadow crosses the table."""
    high = replace(RIG, camera_height=0.3, fov=50.0)
    rig = replace(high, camera_shift=np.copysign((0.004, 0.004, 0.003), tilt), camera_tilt=tilt)

    def table(point):
        return grey_table(point) * np.where(point[..., 1:2] > 0.09, 0.5, 1.0)

    photo = snap(rig, sample, table, noise=0.01)
    assert off(photo, high, rig) > 0.12
    assert off(photo, find_camera(photo, high)[0], rig) < 0.005


@pytest.mark.parametrize("period", [0.06, 0.09])
def test_tiles_without_end_are_no_square(period):
    """Joints around tiles of the sample's size or a part of it, nothing else."""

    def tiles(point):
        joint = (np.mod(point[..., :2] + 0.011, period) < 0.003).any(-1, keepdims=True)
        return np.where(joint, 0.15, 0.5) + [0.0] * 3

    assert find_camera(snap(held(4), None, tiles, noise=0.01), RIG)[0] is RIG


@pytest.mark.parametrize("seed", [0, 1])
def test_the_displays_edge_beside_the_sample_is_not_its_border(seed):
    rig = held(seed)

    def table(point):
        hidden = point[..., :1] < -rig.sample_size / 2 - 0.0025
        return np.where(hidden, 0.002, grey_table(point))

    photo = snap(rig, marble, table, noise=0.01)
    assert off(photo, find_camera(photo, RIG)[0], rig) < 0.005


@pytest.mark.parametrize("sample", [marble, weave])
def test_a_camera_as_told_stays(sample):
    for rig in (RIG, held(3)):
        assert find_camera(snap(rig, sample, noise=0.01), rig)[0] is rig


@pytest.mark.parametrize("sample", [None, marble])
@pytest.mark.parametrize("table", [grey_table, textured_table, marble])
def test_without_a_square_nothing_moves(sample, table):
    """No sample on the table, or one that covers it."""
    photo = snap(held(4), None, sample or table, noise=0.01)
    assert find_camera(photo, RIG)[0] is RIG


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_nothing_to_see(value):
    assert find_camera(Photo(np.full((60, 80, 3), value, np.float32)), RIG)[0] is RIG
    tiny = Rig(screen_size=0.02, screen_height=0.002, camera_offset=0.001, ball_radius=0.001)
    assert find_camera(Photo(np.full((60, 80, 3), value, np.float32)), tiny)[0] is tiny


def test_the_crop_follows():
    rig = held(5)
    photo = snap(rig, marble)
    truth = marble(RIG.sample_points(128, 128))
    told, found = (crop_sample(photo, r, 128) for r in (RIG, find_camera(photo, RIG)[0]))
    inner = slice(8, -8)
    before, after = (np.abs(c - truth)[inner, inner].mean() for c in (told, found))
    assert after < 0.01 and after < before / 5
