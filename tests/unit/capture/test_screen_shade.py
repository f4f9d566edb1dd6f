"""The edge of the screen's shadow, against one that is counted ray by ray."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.capture.screen_shade import place_lamps, seen_past_edge
from invrender.capture.table import hidden_by_screen
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.sphere import directions, sky_flux

SIZE = (240, 320)
RIG = Rig()
LAMP = np.array([-0.1, 0.6, 1]) / np.linalg.norm([-0.1, 0.6, 1])  # its edge crosses the sample
RAYS = 60
DIM = 0.05  # radiance of the room beside the lamp


def room(lamp, wide, rows=128, power=30.0):
    """A dim room with a lamp of a Gaussian's width in radians, as bright whatever that is."""
    spot = np.exp((directions(rows, 2 * rows) @ lamp - 1) / wide**2)
    light = np.repeat(np.where(spot > 0.01, spot, 0)[..., None], 3, -1)
    return (DIM + light * (power / sky_flux(light)[1].sum(0))).astype(np.float32)


def sample_light(environment, side=64):
    """Irradiance (side²,) of the sample by the lamp of a room."""
    points = RIG.sample_points(side, side).reshape(-1, 3)
    lamp = np.where(environment > 2 * DIM, environment, 0)
    d, flux = sky_flux(lamp)
    lit = flux.any(-1)
    return seen_past_edge(RIG, points, d[lit], np.pi / len(lamp)) @ flux[lit].mean(-1)


def photo_of(lamp, texture, wide=0.015, power=30.0):
    """A sample under the room's light, and that of rays from about a lamp, if there is one."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    ray = RIG.rays(np.stack([x, y], -1), *SIZE)
    point = (RIG.camera - ray * (RIG.camera[2] / ray[..., 2])[..., None]).reshape(-1, 3)
    albedo = 0.3 + texture * np.sin(point[:, 0] * 700) * np.sin(point[:, 1] * 600)
    light = np.full(len(point), DIM)
    if lamp is not None:
        d = lamp + wide * np.random.default_rng(0).standard_normal((RAYS, 3)) / np.sqrt(2)
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        light += power * (1 - hidden_by_screen(RIG, point, d).mean(1))
    photo = (albedo * light).reshape(*SIZE, 1)
    return Photo(np.repeat(photo, 3, -1).astype(np.float32))


@pytest.mark.parametrize("texture", [0.0, 0.06])
def test_a_lamp_that_the_ball_blurs_and_misplaces_comes_back(texture):
    """Most of the error of the light on the sample goes, and none of the lamp's light."""
    off = LAMP + np.array([0.012, -0.006, 0])
    under = Lights(RIG, default_pattern(64), room(off / np.linalg.norm(off), 0.04), gain=0.0)
    found = place_lamps(photo_of(LAMP, texture), under)
    true, before, after = (
        sample_light(e) for e in (room(LAMP, 0.015, 512), under.environment, found.environment)
    )
    assert np.ptp(true) > 0.5 * true.max()
    assert np.abs(before - true).mean() > 0.02 * true.max()
    assert np.abs(after - true).mean() < 0.5 * np.abs(before - true).mean()
    flux = [sky_flux(e)[1].sum() for e in (under.environment, found.environment)]
    assert flux[1] == pytest.approx(flux[0], rel=0.02)


def test_doubtful_lamps_and_what_the_ball_shows_move_along():
    under = Lights(RIG, default_pattern(64), room(LAMP, 0.03), gain=0.0)
    under = replace(under, lamps=under.environment / 2, coverage=np.ones((128, 256), np.float32))
    found = place_lamps(photo_of(LAMP, 0.05), under)
    assert found.lamps is not None and found.coverage is not None
    assert found.environment.shape == found.lamps.shape == (256, 512, 3)
    np.testing.assert_allclose(found.lamps, found.environment / 2, rtol=1e-4, atol=1e-6)
    assert found.coverage.shape == (256, 512) and (found.coverage > 0.999).all()


@pytest.mark.parametrize("case", ["no edge in the photo", "no lamp", "lamp over all"])
def test_what_the_photo_does_not_show_moves_nothing(case):
    environment = {
        "no edge in the photo": room(LAMP, 0.03),
        "no lamp": np.full((64, 128, 3), 0.1, np.float32),
        "lamp over all": room(np.array([0.9, 0, 0.44]), 0.03),
    }[case]
    under = Lights(RIG, default_pattern(64), environment, gain=0.0)
    photo = photo_of(None, 0.1)
    assert place_lamps(photo, under) is under


def test_the_edge_is_the_screens():
    """Far narrower than the distance between points, a spot is hidden or seen as a ray is."""
    rig = replace(RIG, screen_tilt=(5, -4, 3), screen_bezel=0.01)
    points = rig.sample_points(12, 12).reshape(-1, 3)
    d = directions(16, 32)[:8].reshape(-1, 3).astype(float)
    d = d[d[:, 2] > 0.2]
    seen = seen_past_edge(rig, points, d, 1e-6)
    np.testing.assert_array_equal(seen < 0.5, hidden_by_screen(rig, points, d))
    soft = seen_past_edge(rig, points, d, 0.05)
    assert ((soft > 0.01) & (soft < 0.99)).any() and soft.min() >= 0 and soft.max() <= 1
