"""A lamp that is near, against Mitsuba, differences and its limit."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.data.materials import procedural_material
from invrender.data.simulate_setup import without_screen
from invrender.lights import NO_PATTERN, Lights, NearLamp
from invrender.maps import NAMES, Estimate
from invrender.refine.gauss_newton import linearise
from invrender.refine.theta import to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.image import render
from invrender.render.near import renderer_under
from invrender.render.path_traced import mi, path_traced, sample_scene, scene_dict
from invrender.report.report import Report
from invrender.report.result import Result
from invrender.rig import Rig
from invrender.sphere import directions

RIG = without_screen(Rig())
PLACE, RADIUS, LEVEL = (-0.25, 0.2, 0.35), 0.03, 60.0
SIZE = 12


def lights_with(place, near=True):
    """The lamp in a plain room, drawn as the ball sees it."""
    fine, height = 4, 128
    to = np.subtract(place, RIG.ball_centre)
    d = directions(fine * height, 2 * fine * height)
    distance = np.linalg.norm(to)
    on = d @ (to / distance) > np.sqrt(1 - (RADIUS / distance) ** 2)
    share = on.reshape(height, fine, 2 * height, fine).mean((1, 3)).astype(np.float32)
    room = np.where(share[..., None] > 0, share[..., None] * LEVEL, 0.2) * np.ones(3)
    lamp = NearLamp(place, tuple(RIG.ball_centre), (share > 0).astype(np.float32))
    return Lights(RIG, NO_PATTERN, room.astype(np.float32), 0.0, near=lamp if near else None)


@pytest.fixture(scope="module")
def maps():
    maps = procedural_material(5, SIZE, SIZE, kind="leather")
    return replace(maps, roughness=np.maximum(maps.roughness, 0.3))


def test_each_point_sees_it_where_it_is(maps):
    room = np.full((16, 32, 3), 0.2, np.float32)
    scene = sample_scene(RIG, maps, None, room, lamp=(PLACE, RADIUS, (LEVEL,) * 3))
    truth = path_traced(scene, RIG, SIZE, SIZE, 4096)
    near, far = (
        np.sqrt(np.mean((renderer_under(lights_with(PLACE, n)).render(maps, 256) - truth) ** 2))
        for n in (True, False)
    )
    assert near < 0.02 * truth.mean() < 0.2 * far


def test_mitsubas_description_has_it(maps):
    """Also under a camera off its place, as a result's lights are."""
    lights = replace(lights_with(PLACE), rig=replace(RIG, camera_shift=(0.004, -0.006, 0.01)))
    image = np.array(mi.render(mi.load_dict(scene_dict(maps, lights, samples=1024))))
    near, far = (render(maps, x) for x in (lights, replace(lights, near=None)))
    # Mitsuba averages over a pixel, ours is at its centre.
    off, without = (np.abs(image - x).mean() for x in (near, far))
    assert off < 0.012 * near.mean() and off < 0.2 * without, (off, without, near.mean())
    assert image.mean() == pytest.approx(near.mean(), rel=0.01)


def test_its_jacobian_is_that_of_differences(maps):
    """As well as that of a far lamp, whose sums over few points of it change with roughness."""
    theta, step = to_theta(maps), 1e-2

    def error(renderer, k):
        _, jacobian = linearise(renderer, theta, 256)
        moved = [theta.copy(), theta.copy()]
        for sign, t in zip((1, -1), moved, strict=True):
            t[..., k] += sign * step
        high, low = (linearise(renderer, t, 256)[0] for t in moved)
        slope = (high - low) / (2 * step)
        return np.sqrt(np.mean((jacobian[..., k] - slope) ** 2) / np.mean(slope**2))

    near, far = (renderer_under(lights_with(PLACE, n)) for n in (True, False))
    for k in (0, 3, 6, 7, 8):
        assert error(near, k) < 1.5 * error(far, k) + 0.005, k


def test_its_jacobian_is_the_same_again(maps):
    """Of other maps, from a renderer that was asked before."""
    lights = lights_with(PLACE)
    asked, theta = renderer_under(lights), to_theta(maps)
    for k in range(3):
        theta[..., 6:] *= 0.9
        for a, b in zip(*(linearise(r, theta, 256) for r in (asked, renderer_under(lights))),
                        strict=True):  # fmt: skip
            np.testing.assert_array_equal(a, b, err_msg=str(k))


def test_from_afar_it_is_the_environments(maps):
    far = tuple(1e4 * np.asarray(PLACE))
    room = lights_with(PLACE, near=False)
    lamp = NearLamp(far, (0.0, 0.0, 0.0), lights_with(PLACE).near.share)
    images = [renderer_under(replace(room, near=n)).render(maps, 256) for n in (None, lamp)]
    assert np.sqrt(np.mean((images[1] - images[0]) ** 2)) < 0.01 * images[0].mean()
    assert isinstance(renderer_under(room), Fast)


def test_it_moves_with_the_lights(maps):
    """A sample that lies turned and shifted sees the same."""
    lights = lights_with(PLACE)
    angle, shift = 0.4, (0.1, -0.05)
    c, s = np.cos(angle), np.sin(angle)
    place = np.array([[c, -s, shift[0]], [s, c, shift[1]], [0, 0, 1]])
    moved = lights.placed(place)
    half = RIG.sample_size / 2
    for x, y in ((0.0, 0.0), (0.6, -0.3)):
        there = half * (place @ [x, y, 1])[:2]
        before = np.subtract(lights.near.place, [*there, 0])
        after = np.subtract(moved.near.place, [half * x, half * y, 0])
        turned = [c * before[0] + s * before[1], c * before[1] - s * before[0], before[2]]
        np.testing.assert_allclose(after, turned, atol=1e-6)
    assert moved.near.share.sum() == pytest.approx(lights.near.share.sum(), rel=1e-4)


def test_a_saved_result_keeps_it(maps, tmp_path):
    lights = lights_with(PLACE)
    sigma = {name: np.full((SIZE, SIZE), 0.01, np.float32) for name in NAMES}
    fit = {"gain": [0, 0, 0]}
    error = {"initial": 0.1, "refined": 0.1}
    report = Report(
        "done",
        "c",
        SIZE,
        "flat",
        0.09,
        {"refine": 1.0},
        error,
        True,
        [],
        fit,
        [],
        None,
        {"invrender": "1"},
    )
    photo = np.full((SIZE, SIZE, 3), 0.1, np.float32)
    result = Result(Estimate(maps, sigma), lights, photo, report)
    result.save(tmp_path)
    again = Result.load(tmp_path)
    far = result.render(replace(lights, near=None), samples=64)
    near, kept = (r.render(samples=64) for r in (result, again))
    np.testing.assert_allclose(kept, near, rtol=1e-3, atol=1e-4)
    assert np.abs(far - near).max() > 0.1 * near.max()
    replace(result, lights=replace(lights, near=None)).save(tmp_path)
    assert Result.load(tmp_path).lights.near is None  # an older result's lamp is gone
