"""The ball's shadow on the sample, against one that is counted ray by ray."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.capture.ball_shade import without_ball_shade
from invrender.capture.crop import crop_sample
from invrender.capture.mirror import make_ball
from invrender.capture.near_lamp import connected
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.sphere import directions, irradiance

SIZE = (240, 320)
# Low; the environment's first and last column meet at y = 0.
ASIDE, AT_THE_SEAM = (np.array(v) / np.linalg.norm(v) for v in ((0.9, 0.1, 0.42), (0.9, 0, 0.42)))
WIDE = 0.06  # radians, radius of the lamp
RAYS = 100


def lights(shape, lamp=ASIDE):
    """A dim room with a lamp, and a dark screen."""
    d = directions(128, 256)
    room = np.where((d @ lamp > np.cos(WIDE))[..., None], 300.0, 0.1) * np.ones(3)
    rig = Rig(ball_shape=shape)
    return Lights(rig, default_pattern(64), room.astype(np.float32), gain=0.2)


def rays_lost(points, ball, lamp, wide):
    """The share of the lamp's light (n,) that the ball hides, by rays."""
    rng = np.random.default_rng(0)
    off = unit(np.cross(lamp, rng.normal(size=(RAYS, 3)))) * np.sqrt(rng.random((RAYS, 1)))
    to = np.asarray(ball.position) - points[:, None]
    along = (to * unit(lamp + wide * off)).sum(-1)
    return (((to**2).sum(-1) - along**2 < ball.radius_m**2) & (along > 0)).mean(1)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def photo_of(lights, ball, lamp=None, wide=WIDE):
    """A textured sample without the ball's shadow, and with that of a lamp whose light is nearly
    all there is."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    rig = lights.rig
    ray = rig.rays(np.stack([x, y], -1), *SIZE)
    point = (rig.camera - ray * (rig.camera[2] / ray[..., 2])[..., None]).reshape(-1, 3)
    texture = 0.3 + 0.1 * np.sin(point[:, 0] * 700) * np.sin(point[:, 1] * 600)
    clear = texture[:, None] * irradiance(lights.environment)
    lost = 0 * texture if lamp is None else rays_lost(point, ball, lamp, wide)
    part = irradiance(np.where(lights.environment > 1, lights.environment, 0))
    seen = clear - lost[:, None] * texture[:, None] * part
    return tuple(Photo(a.reshape(*SIZE, 3).astype(np.float32)) for a in (clear, seen))


@pytest.mark.parametrize(
    ("shape", "lamp", "wide"),
    [("hemisphere", ASIDE, WIDE), ("sphere", ASIDE, WIDE), ("sphere", AT_THE_SEAM, WIDE / 3)],
)
def test_a_lamps_shadow_is_undone(shape, lamp, wide):
    """Of a lamp that is as wide as the ball shows it, or much narrower."""
    under = lights(shape, lamp)
    rig = under.rig
    ball = make_ball(rig, rig.ball_centre, rig.ball_radius, SIZE)
    clear, seen = photo_of(under, ball, lamp, wide)
    crops = [crop_sample(p, rig, 128) for p in (clear, seen, without_ball_shade(seen, under, ball))]
    before, after = (np.abs(c / crops[0] - 1).max(-1) for c in crops[1:])
    assert before.max() > 0.8 and (before > 0.3).mean() > 0.005
    assert (after > 0.3).mean() < 0.15 * (before > 0.3).mean() and np.median(after) < 0.01
    assert after.mean() < 0.3 * before.mean()


def test_a_shadow_that_the_photo_does_not_show_is_not_undone():
    under = lights("sphere")
    ball = make_ball(under.rig, under.rig.ball_centre, under.rig.ball_radius, SIZE)
    clear, _ = photo_of(under, ball)
    assert without_ball_shade(clear, under, ball) is clear


def test_a_lamp_above_throws_no_shadow_there():
    under = replace(lights("sphere"), environment=np.full((32, 64, 3), 0.2, np.float32))
    ball = make_ball(
        under.rig, np.add(under.rig.ball_centre, (0.04, 0, 0)), under.rig.ball_radius, SIZE
    )
    photo = Photo(np.full((*SIZE, 3), 0.3, np.float32))
    assert without_ball_shade(photo, under, ball) is photo


def test_a_lamp_where_the_environment_begins_and_ends_is_one():
    mask = np.zeros((6, 12), bool)
    mask[2, :2] = mask[1:3, -2:] = mask[4, 5] = mask[0] = True
    parts = connected(mask)
    assert [len(p) for p in parts] == [18, 1]
    mask[0] = False
    assert [len(p) for p in connected(mask)] == [6, 1]
    assert connected(np.zeros((4, 8), bool)) == []
