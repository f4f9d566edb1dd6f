"""The last fit of the ball: its planes, its unknown table, and what it tells of tilt and blur."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from synthetic_photo import grey_table, photograph, textured_table

from invrender.capture import ball_rim as rim
from invrender.capture.ball_image import trace_ball
from invrender.capture.ball_view import View, view_around
from invrender.capture.mirror import make_ball, on_table
from invrender.capture.settings import RIM_FIT
from invrender.files.images import Photo
from invrender.rig import Rig

RIG = Rig()
SIZE = (720, 960)
TILTED = replace(RIG, camera_tilt=(1.6, -1.1, 0.0))


def view_of(image, rig=RIG, shift=(0.0, 0.0)) -> View:
    ball = make_ball(rig, rig.ball_centre + np.array([*shift, 0]), rig.ball_radius, SIZE)
    return view_around(Photo(image), np.asarray(ball.centre), 3.3 * ball.radius, ball.radius / 64)


def unknowns(rig, shift=(0.0, 0.0)):
    x, y, _ = rig.ball_centre
    return np.array([x + shift[0], y + shift[1], rig.ball_radius, 0, 0, 0, 0])


def off(found: rim.Rim, rig, shift=(0.0, 0.0)) -> float:
    """The greatest error of the outline's centre and radius in the photo, in radii."""
    seen = make_ball(found.rig, np.array([*found.circle[:2], 0]), found.circle[2], SIZE)
    true = make_ball(rig, rig.ball_centre + np.array([*shift, 0]), rig.ball_radius, SIZE)
    distance = np.hypot(*np.subtract(seen.centre, true.centre))
    return float(max(distance, abs(seen.radius - true.radius)) / true.radius)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.02, -0.03)])
@pytest.mark.parametrize("double", [True, False], ids=["double", "single"])
def test_rays_in_the_planes_are_those_in_space(shift, double, monkeypatch):
    """Exactly in double precision; in single, as it is used, next to exactly."""
    if double:
        monkeypatch.setattr(rim, "_single", np.asarray)
    p = unknowns(TILTED, shift)
    view = view_of(np.ones((*SIZE, 3), np.float32), TILTED, shift)
    lines = rim._Lines(view, view.image[..., 0], TILTED, p, 16, 0.0, 1.25, RIM_FIT.tilt_deviation)
    got = lines.trace(p)
    centre = np.array([p[0], p[1], 0])
    middle = view.at(centre, TILTED)
    along = view.at(centre + 0.01 * lines.along, TILTED) - middle
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    at = middle + lines.points[:, None] * along[:, None]
    pixels = at * view.step + view.origin
    ball = make_ball(TILTED, centre, p[2], SIZE)
    point, mirrored, seen = trace_ball(TILTED, ball, pixels)
    down = seen & (mirrored[..., 2] < -0.05)
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = point - mirrored * (point[..., 2:] / mirrored[..., 2:])
    np.testing.assert_allclose(
        got.mirrored[down],
        np.linalg.norm(hit - centre, axis=-1)[down] / p[2],
        rtol=1e-6 if double else 4e-5,
    )
    # The reflected point lies on the line's own ray on the table, not beside it.
    across = np.cross(lines.along[:, None], hit - centre)[..., 2]
    assert np.abs(across[down]).max() < 1e-9
    rays = TILTED.rays(pixels, *SIZE)
    table = TILTED.camera - rays * (TILTED.camera[2] / rays[..., 2:])
    np.testing.assert_allclose(
        got.direct,
        np.linalg.norm(table - centre, axis=-1) / p[2],
        rtol=1e-6 if double else 3e-6,
    )
    sure = (got.inside == 0) | (got.inside == 1)
    np.testing.assert_array_equal(got.inside[sure], seen[sure])


@pytest.mark.parametrize(
    ("table", "bound"),
    [(grey_table, 1e-3), (textured_table, 2.5e-3)],  # the second has detail finer than a pixel
)
def test_a_clean_photo_tells_the_ball_to_a_thousandth_or_two(table, bound):
    shift = (0.002, -0.001)
    view = view_of(photograph(RIG, *SIZE, table=table, ball=shift), RIG, shift)
    start = unknowns(RIG, shift)[:3] + RIG.ball_radius * np.array([0.015, -0.01, 0.02])
    found = rim.fit_rim(view, RIG, start)
    assert off(found, RIG, shift) < bound
    assert found.deviation < 1e-3


def test_the_cameras_tilt_is_told():
    view = view_of(photograph(TILTED, *SIZE, table=grey_table), TILTED)
    # The fit does not know of the tilt: it starts where the untilted camera would see that ball.
    x, y = TILTED.project(RIG.ball_centre, *SIZE)
    start = np.array([*on_table(RIG, SIZE, x, y)[:2], RIG.ball_radius])
    found = rim.fit_rim(view, RIG, start)
    assert off(found, TILTED) < 2e-3
    np.testing.assert_allclose(found.rig.camera_tilt, TILTED.camera_tilt, atol=0.35)


def test_noise_makes_it_less_sure_and_bright_pixels_do_not_mislead():
    image = photograph(RIG, *SIZE, table=grey_table)
    clean = rim.fit_rim(view_of(image), RIG, unknowns(RIG)[:3])
    rng = np.random.default_rng(0)
    noisy = image * (1 + 0.03 * rng.standard_normal(image.shape))
    noisy[rng.random(SIZE) < 0.01] *= 8
    found = rim.fit_rim(view_of(noisy.astype(np.float32)), RIG, unknowns(RIG)[:3])
    assert off(found, RIG) < 0.01
    assert found.deviation > 1.2 * clean.deviation


def test_a_blurred_photo_is_no_smaller_ball():
    image = ndimage.gaussian_filter(photograph(RIG, *SIZE, table=textured_table), (1.2, 1.2, 0))
    assert off(rim.fit_rim(view_of(image), RIG, unknowns(RIG)[:3]), RIG) < 5e-3


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_an_empty_photo_gives_finite_numbers(level):
    image = np.full((*SIZE, 3), level, np.float32)
    found = rim.fit_rim(view_of(image), RIG, unknowns(RIG)[:3])
    assert np.isfinite(found.circle).all()
    assert np.isfinite(found.deviation)
