"""Roughness by the light's pattern in the albedo: found where it stands there, else kept."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.data.environments import procedural_environment
from invrender.maps import constant_maps
from invrender.pattern.default import default_pattern
from invrender.refine import texture
from invrender.refine.gauss_newton import Observation, linearise
from invrender.refine.plain import texture_details
from invrender.refine.priors import network_prior
from invrender.refine.texture import (
    TEXTURE_SETTINGS,
    Measured,
    _chosen,
    measure_light,
    without_light,
)
from invrender.refine.theta import D, R, S, to_maps, to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.scene import make_scene
from invrender.rig import Rig
from invrender.sphere import scale_environment

SIZE = 64
SIGMA = {"diffuse": 0.05, "specular": 0.05, "roughness": 0.08, "normal": 0.001}


@pytest.fixture(scope="module")
def renderer():
    room = scale_environment(procedural_environment(3, 64), 0.3)
    return Fast(make_scene(Rig(), default_pattern(), room, 2.0))


def sample(k_d, rho, texture=0.15, colours=1):
    """A dielectric whose albedo has spots of all sizes, of its own colour or of any."""
    maps = constant_maps(SIZE, SIZE, k_d, 0.04, rho)
    rng = np.random.default_rng(2)
    for n in (4, 8, 16, 32, 64):
        spots = rng.standard_normal((n, n, colours)) * texture / 3
        maps.diffuse *= 1 + np.kron(spots, np.ones((SIZE // n, SIZE // n, 1)))
    maps.diffuse = np.clip(maps.diffuse, 0, 0.9).astype(np.float32)
    return maps


def explained(renderer, maps, off):
    """The photo of maps, and the prior of others that explain it with a roughness off by so much
    and the albedo that this asks for."""
    photo = renderer.render(maps, 256)
    theta = to_theta(maps)
    theta[..., R] += off
    for _ in range(2):
        image, jacobian = linearise(renderer, theta, 256)
        theta[..., D] += (photo - image) / jacobian[..., range(3), range(3)]
    assert np.abs(linearise(renderer, theta, 256)[0] - photo).max() < 0.01 * photo.mean()
    found = to_maps(theta)
    sigma = {k: np.full(maps.shape, v, np.float32) for k, v in SIGMA.items()}
    return Observation(photo, renderer), network_prior(found, sigma)


def found_in(observations, prior, first=None):
    return without_light(observations, prior, prior.mean[..., R] if first is None else first)


@pytest.mark.parametrize("off", [-0.08, 0.08])
@pytest.mark.parametrize(("k_d", "rho"), [((0.3, 0.2, 0.1), 0.5), (0.05, 0.4), (0.1, 0.75)])
def test_roughness_is_found_that_the_albedo_makes_up_for(renderer, k_d, rho, off):
    maps = sample(k_d, rho)
    observation, prior = explained(renderer, maps, off)
    found = found_in([observation], prior)
    was, now = (np.abs(p.mean[..., R].mean() - rho) for p in (prior, found))
    assert now < 0.5 * was
    before, after = (np.abs(p.mean[..., D] - maps.diffuse).mean() for p in (prior, found))
    assert after < before
    assert found.total[..., R].mean() < prior.expected[..., R].mean()


def test_the_albedo_takes_what_the_lobe_loses(renderer):
    observation, prior = explained(renderer, sample((0.3, 0.2, 0.1), 0.5), 0.08)
    found = found_in([observation], prior)
    rougher = prior.mean.copy()
    rougher[..., R] = found.mean[..., R]
    alone, both = (
        np.square(linearise(renderer, theta, 256)[0] - observation.photo).mean()
        for theta in (rougher, found.mean)
    )
    assert both < 0.1 * alone


@pytest.mark.parametrize("rho", [0.4, 0.75])
def test_true_maps_stay(renderer, rho):
    observation, prior = explained(renderer, sample((0.3, 0.2, 0.1), rho), 0.0)
    found = found_in([observation], prior)
    assert np.abs(found.mean[..., R] - rho).max() < 0.015


def test_a_stronger_texture_tells_less(renderer):
    weak, strong = (
        measure_light(*_seen(renderer, sample(0.2, 0.6, texture, 3))) for texture in (0.02, 0.2)
    )
    assert strong.variance > 30 * weak.variance


def _seen(renderer, maps):
    observation, prior = explained(renderer, maps, 0.05)
    return observation, prior.mean, np.ones(maps.shape)


def test_metal_and_what_is_saturated_stay(renderer):
    metal = constant_maps(SIZE, SIZE, 0, 0.8, 0.4)
    observation, prior = explained(renderer, sample(0.2, 0.5), 0.08)
    clipped = Observation(observation.photo, renderer, np.ones((SIZE, SIZE), bool))
    found = found_in([clipped], prior)
    np.testing.assert_array_equal(found.mean[..., R], prior.mean[..., R])
    prior.mean[..., S] = to_theta(metal)[..., S]
    assert found_in([observation], prior) is prior


def test_two_photos_tell_more_than_one(renderer):
    observation, prior = explained(renderer, sample(0.2, 0.6), 0.08)
    one, two = (found_in([observation] * n, prior) for n in (1, 2))
    moved = [float((p.mean - prior.mean)[..., R].mean()) for p in (one, two)]
    assert moved[1] < moved[0] < 0


def test_a_first_start_that_was_right_is_gone_back_to(renderer):
    observation, prior = explained(renderer, sample(0.3, 0.6, 0.5, 3), 0.05)
    alone, beside = (
        found_in([observation], prior, np.full((SIZE, SIZE), rho, np.float32)).mean[..., R].mean()
        for rho in (0.65, 0.6)
    )
    assert abs(beside - 0.6) < abs(alone - 0.6) - 0.003


def test_a_start_that_was_wrong_is_not(renderer):
    observation, prior = explained(renderer, sample(0.3, 0.6), 0.0)
    found = found_in([observation], prior, np.full((SIZE, SIZE), 0.75, np.float32))
    assert abs(found.mean[..., R].mean() - 0.6) < 0.015


def test_a_room_in_doubt_is_no_roughness(renderer):
    """Of a room that is a tenth too bright some stands in the albedo: less is made of it where
    that is expected."""
    maps = sample(0.3, 0.6, 0.05)
    dimmer = renderer.scaled(1.0, 0.8)
    photo = dimmer.render(maps, 256)
    theta = to_theta(maps)
    for _ in range(2):
        image, jacobian = linearise(renderer, theta, 256)
        theta[..., D] += (photo - image) / jacobian[..., range(3), range(3)]
    sure, nearly, unsure = (
        measure_light(Observation(photo, renderer, None, (0.0, doubt)), theta, np.ones(maps.shape))
        for doubt in (0.0, 1e-3, 0.2)
    )
    assert abs(unsure.delta) < 0.5 * abs(sure.delta)
    assert nearly.delta == pytest.approx(sure.delta, rel=0.02)


def test_parts_of_two_sizes_tell_their_scatter(renderer):
    few, many, both = (
        measure_light(*_seen(renderer, sample(0.3, 0.6)), s=replace(TEXTURE_SETTINGS, parts=parts))
        for parts in ((4,), (10,), (4, 10))
    )
    assert both.delta == pytest.approx((few.delta + many.delta) / 2)
    scatter = (few.delta - many.delta) ** 2 / 4
    assert both.variance == pytest.approx((few.variance + many.variance) / 2 + scatter)
    assert scatter > 0.1 * few.variance


def test_a_wider_lobe_is_believed_less(monkeypatch):
    """Of δ measured with the same error."""
    prior = network_prior(sample(0.2, 0.6), {k: np.full((SIZE,) * 2, v) for k, v in SIGMA.items()})
    moved = []
    for delta in (0.06, -0.06):
        found = Measured(delta, 0.02**2, np.zeros((SIZE, SIZE, 3), np.float32))
        monkeypatch.setattr(texture, "measure_light", lambda *_, found=found: found)
        o = Observation(np.zeros((SIZE, SIZE, 3)), None)
        moved.append(abs(float((found_in([o], prior).mean - prior.mean)[..., R].mean())))
    assert 0.2 * moved[1] < moved[0] < 0.8 * moved[1]


def test_the_posterior_of_three_starts():
    """Against the integral over δ."""
    starts, odds = ((0.0, 0.01), (0.06, 0.02), (0.0, 0.08)), (1.0, 2.0, 3.0)
    delta = np.linspace(-0.6, 0.6, 24001)
    prior = sum(
        w * np.exp(-(((delta - m) / s) ** 2) / 2) / s
        for w, (m, s) in zip(odds, starts, strict=True)
    )
    for measured, deviation in ((0.05, 0.02), (-0.1, 0.05), (0.0, 0.3)):
        p = prior * np.exp(-(((delta - measured) / deviation) ** 2) / 2)
        mean = (p @ delta) / p.sum()
        variance = (p @ (delta - mean) ** 2) / p.sum()
        got = _chosen(measured, deviation**2, starts, odds)
        assert got == pytest.approx((mean, variance), rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("slope", [-0.15, 0.0, 0.15])
def test_roughness_that_goes_with_the_albedo_is_found(renderer, slope):
    """From maps of even roughness that explain the photo; and none where there is none."""
    maps = sample((0.2, 0.15, 0.1), 0.5, 0.5)
    varied = slope * texture_details(to_theta(maps))
    maps.roughness += varied
    observation, prior = explained(renderer, maps, -varied)
    found = found_in([observation], prior).mean[..., R]
    left = found - found.mean() - varied
    if slope:
        assert left.std() < 0.8 * varied.std()
    else:
        assert left.std() < 0.01


def test_a_screen_in_doubt_widens_narrow_lobes_only(monkeypatch):
    """Of δ above nought, measured with the same error."""
    moved = {}
    for rho in (0.15, 0.6):
        sigma = {k: np.full((SIZE,) * 2, v) for k, v in SIGMA.items()}
        prior = network_prior(sample(0.2, rho), sigma)
        for delta in (0.06, -0.06):
            found = Measured(delta, 0.01**2, np.zeros((SIZE, SIZE, 3), np.float32))
            monkeypatch.setattr(texture, "measure_light", lambda *_, found=found: found)
            for pose in (0.0, 0.05):
                o = Observation(np.zeros((SIZE, SIZE, 3)), None, pose=pose)
                change = float((found_in([o], prior).mean - prior.mean)[..., R].mean())
                moved[rho, delta, pose] = abs(change)
    assert moved[0.15, 0.06, 0.05] < 0.5 * moved[0.15, 0.06, 0.0]
    assert moved[0.6, 0.06, 0.05] > 0.9 * moved[0.6, 0.06, 0.0]
    assert moved[0.15, -0.06, 0.05] == moved[0.15, -0.06, 0.0]
