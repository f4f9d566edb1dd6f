"""The posterior: borders of two materials, what lights cannot explain, and right deviations."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from invrender.data.environments import procedural_environment
from invrender.maps import constant_maps, map_errors
from invrender.pattern.default import block_pattern
from invrender.refine.gauss_newton import Observation
from invrender.refine.lobes import fit_lobes
from invrender.refine.posterior import SETTINGS, explain, read_materials
from invrender.refine.priors import Prior, network_prior
from invrender.refine.theta import D, N, R, S, project, to_maps, to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.scene import make_scene
from invrender.rig import Rig
from invrender.sphere import scale_environment

SIZE = 48


@pytest.fixture(scope="module")
def renderer():
    room = scale_environment(procedural_environment(3, 64), 0.3)
    return Fast(make_scene(Rig(), block_pattern(64), room, 2.0))


def rusty_metal():
    """Rust with islands of bare metal."""
    noise = gaussian_filter(np.random.default_rng(4).standard_normal((SIZE, SIZE)), 3)
    bare = noise > np.quantile(noise, 0.6)
    truth = constant_maps(SIZE, SIZE, (0.3, 0.15, 0.08), 0.04, 0.7)
    truth.diffuse[bare], truth.specular[bare], truth.roughness[bare] = 0, (0.7, 0.65, 0.6), 0.32
    return truth, bare


def blurred(maps, width):
    """What a network makes of maps whose borders it does not see."""
    theta = gaussian_filter(to_theta(maps), (width, width, 0))
    return to_maps(project(theta))


def sigma_of(maps, value=0.05):
    return {
        k: np.full(maps.shape, value, np.float32)
        for k in ("diffuse", "specular", "roughness", "normal")
    }


def test_border_of_two_materials_becomes_sharp(renderer):
    truth, bare = rusty_metal()
    start = blurred(truth, 1.2)
    prior = network_prior(start, sigma_of(truth))
    result = explain([Observation(renderer.render(truth), renderer)], prior)
    before, after = map_errors(start, truth), map_errors(result.maps, truth)
    for name in ("diffuse", "specular", "roughness"):
        assert after[name] < 0.75 * before[name]
    found = result.maps.specular.mean(-1)
    assert (found[bare] > 0.3).mean() > 0.95
    assert (found[~bare] < 0.3).mean() > 0.95


def test_pixel_of_both_materials_keeps_its_share(renderer):
    """Radiance is the mean by area: what is a third metal moves there, not to one of the two."""
    truth, bare = rusty_metal()
    other = constant_maps(SIZE, SIZE, (0.3, 0.15, 0.08), 0.04, 0.7)
    photo = np.where(
        bare[..., None], renderer.render(truth) / 3 + renderer.render(other) * 2 / 3, 0
    )
    photo += np.where(bare[..., None], 0, renderer.render(truth))
    start = blurred(truth, 1.2)
    result = explain([Observation(photo, renderer)], network_prior(start, sigma_of(truth)))
    share = (result.maps.specular.mean(-1) - 0.04) / (0.65 - 0.04)
    told = (start.specular.mean(-1) - 0.04) / (0.65 - 0.04)
    unsure = bare & (told > 0.4) & (told < 0.7)
    assert unsure.sum() > 50
    assert 1 / 3 < np.median(share[unsure]) < 1 / 3 + 0.6 * (np.median(told[unsure]) - 1 / 3)


def test_materials_are_read_only_where_there_are_two():
    truth, bare = rusty_metal()
    readings = read_materials(to_theta(truth))
    assert readings is not None
    assert np.array_equal(readings.share > 0.5, bare)
    assert np.abs(readings.metal[~bare][:, S] - (0.7, 0.65, 0.6)).max() < 0.02
    assert np.abs(readings.dielectric[bare][:, :3] - (0.3, 0.15, 0.08)).max() < 0.02
    assert np.abs(readings.metal[..., R] - 0.32).max() < 0.02
    assert (readings.metal[..., D] == 0).all()
    for one in (constant_maps(8, 8, 0.4, 0.04, 0.5), constant_maps(8, 8, 0, 0.8, 0.3)):
        assert read_materials(to_theta(one)) is None


def test_albedo_does_not_make_up_for_wrong_lights(renderer):
    """A tenth more light than expected is the sample's; two and a half times is the lights'."""
    truth = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.6)
    photo, prior = renderer.render(truth), network_prior(truth, sigma_of(truth))
    moved = {
        by: float((explain([Observation(by * photo, renderer)], prior).maps.diffuse / 0.3).mean())
        for by in (1.1, 2.5)
    }
    assert 1.04 < moved[1.1] < 1.1
    assert 1 < moved[2.5] < 1.04


def test_deviations_are_those_of_the_errors(renderer):
    """Pixels drawn from the prior, photographed with the expected noise."""
    rng = np.random.default_rng(1)
    mean = to_theta(constant_maps(SIZE, SIZE, 0.4, 0.04, 0.5))
    sigma = np.broadcast_to(
        np.array([0.04] * 3 + [0.004] * 3 + [0.03] + [0.05] * 2, np.float32), mean.shape
    ).copy()
    prior = Prior(mean, sigma, np.eye(9, dtype=np.float32))
    true = project((mean + sigma * rng.standard_normal(mean.shape)).astype(np.float32))
    photo = renderer.render(to_maps(true))
    share, floor = SETTINGS.photo_noise
    noise = np.hypot(share * photo, floor * photo.mean())
    photo = np.maximum(photo + noise * rng.standard_normal(photo.shape), 0).astype(np.float32)
    result = explain([Observation(photo, renderer)], prior)
    z = (to_theta(result.maps) - true) / result.sigma
    for k in (D, S, slice(R, R + 1), N):
        assert 0.9 < np.sqrt(np.mean(z[..., k] ** 2)) < 1.15
    assert result.sigma[..., D].mean() < 0.85 * 0.04


@pytest.mark.parametrize("metal", [False, True], ids=["glossy", "metal"])
def test_near_mirror_is_found_from_a_flat_start(renderer, metal):
    truth = constant_maps(SIZE, SIZE, 0.03, 0.04, 0.1)
    if metal:
        truth = constant_maps(SIZE, SIZE, 0, (0.9, 0.8, 0.6), 0.1)
    maps = fit_lobes(renderer.render(truth), renderer)
    error = map_errors(maps, truth)
    assert error["roughness"] < 0.03 and error["specular"] < 0.03 and error["diffuse"] < 0.03


def test_saturated_pixels_of_two_materials_keep_their_prior(renderer):
    truth, _ = rusty_metal()
    start = blurred(truth, 1.2)
    prior = network_prior(start, sigma_of(truth))
    clipped = np.zeros((SIZE, SIZE), bool)
    clipped[:10] = True
    result = explain([Observation(renderer.render(truth), renderer, clipped)], prior)
    kept = project(prior.mean.copy())
    assert np.abs(to_theta(result.maps)[:10] - kept[:10]).max() < 1e-4
    assert np.abs(to_theta(result.maps)[10:] - kept[10:]).max() > 0.05
