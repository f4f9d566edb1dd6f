"""Roughness by the light's pattern in the albedo: found where it stands there, else kept."""

import numpy as np
import pytest

from invrender.data.environments import procedural_environment
from invrender.maps import constant_maps
from invrender.pattern.default import default_pattern
from invrender.refine.gauss_newton import Observation, linearise
from invrender.refine.priors import network_prior
from invrender.refine.texture import measure_light, without_light
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


@pytest.mark.parametrize("off", [-0.08, 0.08])
@pytest.mark.parametrize(("k_d", "rho"), [((0.3, 0.2, 0.1), 0.5), (0.05, 0.4), (0.1, 0.75)])
def test_roughness_is_found_that_the_albedo_makes_up_for(renderer, k_d, rho, off):
    maps = sample(k_d, rho)
    observation, prior = explained(renderer, maps, off)
    found = without_light([observation], prior)
    was, now = (np.abs(p.mean[..., R].mean() - rho) for p in (prior, found))
    assert now < 0.5 * was
    before, after = (np.abs(p.mean[..., D] - maps.diffuse).mean() for p in (prior, found))
    assert after < before
    assert found.total[..., R].mean() < prior.expected[..., R].mean()


def test_the_albedo_takes_what_the_lobe_loses(renderer):
    observation, prior = explained(renderer, sample((0.3, 0.2, 0.1), 0.5), 0.08)
    found = without_light([observation], prior)
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
    found = without_light([observation], prior)
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
    found = without_light([clipped], prior)
    np.testing.assert_array_equal(found.mean[..., R], prior.mean[..., R])
    prior.mean[..., S] = to_theta(metal)[..., S]
    assert without_light([observation], prior) is prior


def test_two_photos_tell_more_than_one(renderer):
    observation, prior = explained(renderer, sample(0.2, 0.6), 0.08)
    one, two = (without_light([observation] * n, prior) for n in (1, 2))
    moved = [float((p.mean - prior.mean)[..., R].mean()) for p in (one, two)]
    assert moved[1] < moved[0] < 0
