"""The screen's pose, curve and gain from its image in the ball: slopes, a fit that settles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from synthetic_photo import blocks, photograph

from invrender.capture import screen
from invrender.capture.ball_image import trace_image
from invrender.capture.mirror import make_ball
from invrender.capture.settings import SCREEN_FIT
from invrender.colour import linear_to_srgb, srgb_to_linear
from invrender.files.images import Photo
from invrender.files.tone_curves import FIXED, KNOTS
from invrender.lights import IDEAL, Device
from invrender.rig import Rig

SIZE = (720, 960)
RIG = Rig()
MOVED = replace(RIG, screen_shift=(0.003, -0.002, 0.002), screen_tilt=(2.0, -1.5, 1.0))
GAIN = (2.0, 2.1, 1.9)
BALL = make_ball(RIG, RIG.ball_centre, RIG.ball_radius, SIZE)
IMAGE = trace_image(RIG, BALL)


@pytest.fixture(scope="module")
def clean():
    return photograph(MOVED, *SIZE, gain=GAIN)


@pytest.fixture(scope="module")
def hard(clean):
    """Blurred, noisy, 8 bits."""
    image = ndimage.gaussian_filter(clean, (1.3, 1.3, 0))
    rng = np.random.default_rng(1)
    image = image + 0.04 * np.sqrt(image) * rng.standard_normal(image.shape)
    return (np.round(np.clip(image, 0, 2.2) * 60) / 60).astype(np.float32)


def unknowns(fit, seed=0):
    """Some way from the start."""
    u = fit.start()
    u[:9] = np.random.default_rng(seed).normal(0, 0.2, 9)
    u[12] -= 0.2
    return u


@pytest.mark.parametrize("level", [None, 2.5])
def test_the_slopes_are_those_of_the_cost(hard, level):
    fit = screen._Fit(Photo(hard, level), RIG, IMAGE, blocks())
    fit.free[:] = True
    fit.free[screen._COLOUR] = fit.free[screen._CURVE] = level is not None
    u = unknowns(fit)
    u[screen._DEVICE] = 0.4, 0.01, 0.02, 0.03, 0.01, 0.02, 0.04, 0.03
    if level:
        u[screen._CURVE] = np.random.default_rng(1).normal(0, 0.03, len(KNOTS))
    fit.prepare(u)
    _, downhill = fit.normal_equations(u)
    step = 1e-4 * np.eye(len(u))[fit.free]
    slope = np.array([fit.cost(u - d) - fit.cost(u + d) for d in step]) / 2e-4
    for part in (slice(9, 12), slice(13, None)):  # gains; what is beyond pose and curve
        here = slope[part]
        np.testing.assert_allclose(downhill[part], here, atol=0.03 * np.abs(here).max())
    np.testing.assert_allclose(downhill, slope, atol=0.03 * np.abs(slope).max())


def test_the_fits_screen_is_the_rigs(hard):
    fit = screen._Fit(Photo(hard), RIG, IMAGE, blocks())
    several = np.stack([unknowns(fit, k) for k in range(3)])
    for u, *found in zip(several, *fit.screen(several), strict=True):
        rig = fit.moved(u)
        for got, wanted in zip(found, (*rig.screen_edges, rig.screen_corner), strict=True):
            np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-15)
    below = unknowns(fit, 0)
    below[2] = -RIG.screen_height / (SCREEN_FIT.shift_deviation * RIG.sample_size)
    assert fit.cost(below) == np.inf


def test_lines_meet_the_screen_where_rays_do():
    fit = screen._Fit(Photo(np.ones((*SIZE, 3), np.float32)), RIG, IMAGE, blocks())
    u = np.zeros(13)
    u[:6] = [0.3, -0.2, 0.4, 0.3, -0.5, 0.2]
    a, b, c = np.moveaxis(fit.lines @ fit.forms(u), -1, 0)
    direction = fit.lines[..., 3:]
    point = np.cross(direction, fit.lines[..., :3])  # of each line, the nearest to the origin
    s, t, _ = screen.screen_coordinates(fit.moved(u), point, direction)
    np.testing.assert_allclose(a / c, s, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(b / c, t, rtol=1e-7, atol=1e-7)


def test_a_moved_screen_is_found(clean):
    found = screen.fit_screen(Photo(clean), RIG, IMAGE, blocks())
    shift = np.subtract(found.rig.screen_shift, MOVED.screen_shift)
    tilt = np.subtract(found.rig.screen_tilt, MOVED.screen_tilt)
    assert np.linalg.norm(shift) < 6e-4
    assert np.linalg.norm(tilt) < 0.4
    np.testing.assert_allclose(found.gain, GAIN, rtol=0.01)
    assert replace(found.device, gamma=IDEAL.gamma) == IDEAL  # what is not there is not fitted
    np.testing.assert_allclose(found.device.gamma, 1, atol=0.02)
    assert found.response is None and 0 < found.gain_deviation < 0.01


DISPLAY = Device(
    0.9, (1.05, 1.0, 0.95), 0.004, ((0.95, 0.03, 0.02), (0.01, 0.94, 0.05), (0, 0.04, 0.96))
)


def test_a_display_that_dims_and_mixes_keeps_its_gain():
    pattern = noise_pattern()
    image = photograph(MOVED, *SIZE, pattern=DISPLAY.shown(pattern), gain=GAIN, falloff=0.9)
    grain = 0.01 * np.sqrt(image) * np.random.default_rng(2).standard_normal(image.shape)
    found = screen.fit_screen(Photo(np.maximum(image + grain, 0)), RIG, IMAGE, pattern)
    np.testing.assert_allclose(found.gain, GAIN, rtol=0.02)
    assert found.device.falloff == pytest.approx(0.9, abs=0.06)
    np.testing.assert_allclose(found.device.mixing, DISPLAY.mixing, atol=0.012)
    np.testing.assert_allclose(found.device.gamma, DISPLAY.gamma, atol=0.03)


@pytest.mark.parametrize("falloff", [2.0, pytest.param(6.0, marks=pytest.mark.slow)])
def test_no_display_is_believed_to_dim_more_than_any(falloff):
    pattern = noise_pattern()
    image = photograph(MOVED, *SIZE, pattern=pattern, gain=GAIN, falloff=falloff)
    found = screen.fit_screen(Photo(image), RIG, IMAGE, pattern).device.falloff
    assert found == pytest.approx(falloff, abs=0.1) if falloff < 3 else found <= 3


@pytest.mark.parametrize("part", [0.3, 0.5])
def test_a_screen_of_few_pixels_is_not_believed(part, monkeypatch):
    """One elsewhere whose few pixels fit is none."""
    pattern = noise_pattern()
    image = photograph(MOVED, *SIZE, pattern=pattern, gain=GAIN)
    size = screen._Fit.size
    monkeypatch.setattr(screen._Fit, "size", lambda fit, u: size(fit, u) * (part if u[0] else 1))
    found = screen.fit_screen(Photo(image), RIG, IMAGE, pattern)
    assert (found.rig.screen_shift != RIG.screen_shift) == (part > screen.SCREEN_FIT.least_part)


def test_a_display_that_is_told_needs_no_fit():
    pattern = noise_pattern()
    image = photograph(RIG, *SIZE, pattern=DISPLAY.shown(pattern), gain=GAIN, falloff=0.9)
    found = screen.fit_screen(Photo(image), RIG, IMAGE, pattern, DISPLAY)
    np.testing.assert_allclose(found.gain, GAIN, rtol=0.01)
    assert found.device.falloff == 0.9  # as told
    np.testing.assert_allclose(found.device.mixing, DISPLAY.mixing, atol=1e-9)
    np.testing.assert_allclose(found.device.gamma, DISPLAY.gamma, rtol=0.01)


def noise_pattern():
    """Blocks of many levels, (64, 64, 3)."""
    levels = np.random.default_rng(3).choice([0.02, 0.05, 0.15, 0.4, 1.0], (8, 8, 3))
    return np.repeat(np.repeat(levels, 8, 0), 8, 1)


@pytest.mark.parametrize("shoulder", [0.0, 0.8])
def test_a_tone_curve_is_undone(shoulder):
    pattern, scale = noise_pattern(), 0.5
    rig = replace(RIG, ball_radius=0.02)
    image = scale * photograph(rig, *SIZE, pattern=pattern, gain=GAIN, samples=3)
    curved = image * (1 + shoulder) / (1 + shoulder * image)
    unit = 1 + shoulder - shoulder * KNOTS[FIXED]  # in which the fixed value is as it was
    encoded = np.round(linear_to_srgb(np.clip(curved, 0, 1)) * 255) / 255
    photo = Photo(srgb_to_linear(encoded).astype(np.float32), 0.97)
    ball = make_ball(rig, rig.ball_centre, rig.ball_radius, SIZE)
    found = screen.fit_screen(photo, rig, trace_image(rig, ball), pattern)
    assert (found.response is not None) == (shoulder > 0)
    expected = unit * scale * np.array(GAIN)
    np.testing.assert_allclose(found.gain, expected, rtol=0.1 if shoulder else 0.02)
    assert found.gain_deviation > 0.01  # nobody knows a JPEG's curve
    if found.response:
        straight = found.response.undo(photo)
        table = np.abs(straight.image / image / unit - 1)[:200, :200]
        assert np.median(table) < 0.06
        assert straight.clip_level > photo.clip_level


def test_where_much_is_saturated_a_curve_is_taken_as_cameras_have_it():
    """A quarter of the screen and more hides how the curve ends; a linear file has none."""
    pattern, rig = noise_pattern(), replace(RIG, ball_radius=0.02)
    image = 2 * photograph(rig, *SIZE, pattern=pattern, gain=GAIN, samples=3)
    encoded = np.round(linear_to_srgb(np.clip(image * 1.8 / (1 + 0.8 * image), 0, 1)) * 255) / 255
    photo = Photo(srgb_to_linear(encoded).astype(np.float32), 0.97)
    shown = trace_image(rig, make_ball(rig, rig.ball_centre, rig.ball_radius, SIZE))
    found = screen.fit_screen(photo, rig, shown, pattern)
    assert found.saturated > SCREEN_FIT.no_curve and found.response and not found.response.measured
    straight = found.response.undo(photo)
    dark, bright = values = np.array([KNOTS[FIXED], KNOTS[-1]], np.float32)
    light = values / (1.8 - 0.8 * values)
    undone = found.response.undo(Photo(values[None, :, None])).image[0, :, 0]
    off = np.log([bright / dark, undone[1] / undone[0]]) - np.log(light[1] / light[0])
    assert abs(off[1]) < 0.3 * abs(off[0])
    assert found.gain_deviation > straight.curve_deviation > 0.1
    again = screen.fit_screen(straight, rig, shown, pattern)
    assert again.response is None and again.gain_deviation > straight.curve_deviation


def test_a_ball_moved_by_nothing_changes_nothing(hard):
    """The fit settles: no chain of undamped steps amplifies the last digits."""
    x, y, z = BALL.position
    gain, moved = (
        screen.fit_screen(
            Photo(hard),
            RIG,
            trace_image(RIG, replace(BALL, position=(x + d, y - d, z))),
            blocks(),
        ).gain
        for d in (0, 1e-10 * RIG.ball_radius)
    )
    np.testing.assert_allclose(moved, gain, rtol=1e-6)
