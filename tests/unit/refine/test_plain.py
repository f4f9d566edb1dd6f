"""Noise and the lights' doubt stay out of plain maps; textures and metals stay as they are."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.data.environments import procedural_environment
from invrender.maps import constant_maps
from invrender.pattern.default import default_pattern
from invrender.refine.estimate import Initial, explain_photos
from invrender.refine.gauss_newton import Observation
from invrender.refine.plain import PLAIN_SETTINGS, evened, keep_level, likely_relief
from invrender.refine.priors import Prior, network_prior
from invrender.refine.theta import D, N, R, S, project, to_maps, to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.scene import make_scene
from invrender.rig import Rig
from invrender.sphere import scale_environment

SIZE = 128
ALBEDO = np.float32([0.5, 0.4, 0.3])


@pytest.fixture(scope="module")
def renderer():
    room = scale_environment(procedural_environment(3, 64), 0.3)
    return Fast(make_scene(Rig(), default_pattern(), room, 2.0))


def flat(k_d=ALBEDO, k_s=0.04):
    return constant_maps(SIZE, SIZE, k_d, k_s, 0.6)


def waves(height, cycles):
    """The slopes of a flat sample's prior, so high, after `likely_relief`, over those before."""
    theta = to_theta(flat())
    theta[..., N.start] = height * np.sin(np.arange(SIZE) / SIZE * 2 * np.pi * cycles)
    ones = np.ones_like(theta)
    found = likely_relief(Prior(theta, ones, np.eye(9))).mean
    np.testing.assert_array_equal(found[..., :7], theta[..., :7])
    assert not found[..., N.start + 1].any()
    before = theta[..., N.start]
    return float((found[..., N.start] * before).sum() / (before**2).sum())


def test_relief_keeps_its_details_and_little_of_wrinkles_and_wide_shades():
    wide, fine = PLAIN_SETTINGS.slopes
    assert waves(0.3, 1) == pytest.approx(wide, abs=0.03)
    assert waves(0.3, 40) == pytest.approx(fine, abs=0.03)
    assert waves(2 * PLAIN_SETTINGS.wrinkles, 40) == pytest.approx(fine / 2, abs=0.02)
    assert waves(0.002, 40) < 0.02


LEVEL = 0.05  # of the photos' lights


def asked(renderer, factor, doubt=(0.01, 0.05), k_s=0.04):
    """A photo that asks for ``factor`` times the first network's albedo; its prior."""
    maps = flat(ALBEDO * np.float32(factor), k_s)
    shape = (SIZE, SIZE)
    sigma = {
        k: np.full(shape, 0.05, np.float32) for k in ("normal", "diffuse", "roughness", "specular")
    }
    photo = Observation(renderer.render(maps, 64), renderer, None, doubt, level=LEVEL)
    return photo, network_prior(maps, sigma)


def test_a_level_within_the_lights_doubt_is_the_lights(renderer):
    factor = np.float32([1.02, 0.98, 1.0])
    photo, prior = asked(renderer, factor)
    (shot,), found, left = keep_level([photo], prior, flat().diffuse)
    np.testing.assert_allclose(found.mean[..., D], flat().diffuse, rtol=1e-4)
    np.testing.assert_allclose(left, factor, rtol=1e-4)
    shown = shot.renderer.render(to_maps(found.mean), 64)
    np.testing.assert_allclose(shown, photo.photo, rtol=0.01)
    assert np.abs(renderer.render(to_maps(found.mean), 64) / photo.photo - 1).max() > 0.015


def test_a_level_well_above_it_is_the_samples(renderer):
    photo, prior = asked(renderer, 1.3)
    _, found, left = keep_level([photo], prior, flat().diffuse)
    taken = np.log(found.mean[..., D].mean((0, 1)) / ALBEDO)
    doubt = np.hypot(PLAIN_SETTINGS.level, PLAIN_SETTINGS.of_gain * LEVEL)
    np.testing.assert_allclose(taken, np.log(1.3) - doubt**2 / np.log(1.3), rtol=1e-3)
    np.testing.assert_allclose(np.log(left) + taken, np.log(1.3), rtol=1e-3)


def test_lights_that_are_known_well_take_less(renderer):
    photo, prior = asked(renderer, 1.04)
    known = replace(photo, level=0.0)
    for photos, least, most in (([photo], 0.6, 0.9), ([known], 0, 0.1), ([photo, known], 0, 0.1)):
        left = keep_level(photos, prior, flat().diffuse)[2]
        assert least < np.log(left).mean() / np.log(1.04) < most


@pytest.mark.parametrize(("doubt", "k_s"), [((0.0, 0.0), 0.04), ((0.01, 0.05), 0.6)])
def test_known_lights_and_metals_keep_their_level(renderer, doubt, k_s):
    photo, prior = asked(renderer, 1.02, doubt, k_s)
    (shot,), found, left = keep_level([photo], prior, flat().diffuse)
    assert shot is photo and found is prior
    np.testing.assert_array_equal(left, 1)


def noisy(deviation, of=1, k_d=ALBEDO, k_s=0.04):
    """θ of a flat sample whose albedo varies from square to square of ``of`` pixels, relatively,
    and whose roughness does from pixel to pixel."""
    theta = to_theta(flat(k_d, k_s))
    rng = np.random.default_rng(1)
    n = SIZE // of
    theta[..., D] *= 1 + np.kron(deviation * rng.standard_normal((n, n, 1)), np.ones((of, of, 1)))
    theta[..., R] += 0.02 * rng.standard_normal((SIZE, SIZE))
    return project(theta)


@pytest.mark.parametrize(
    ("deviation", "of", "k_d"),
    [(0.04, 1, ALBEDO), (0.03, 2, ALBEDO), (0.3, 1, np.float32([0.01] * 3))],
)
def test_noise_of_a_plain_sample_goes(deviation, of, k_d):
    theta = noisy(deviation, of, k_d)
    before = theta[..., D].copy()
    after = evened(theta)[..., D]
    assert after.std((0, 1)).max() < 0.1 * before.std((0, 1)).min()
    np.testing.assert_allclose(after.mean((0, 1)), before.mean((0, 1)), rtol=1e-3)


@pytest.mark.parametrize(
    ("deviation", "of", "kept"), [(0.12, 4, 0.95), (0.07, 4, 0.8), (0.2, 1, 0.85)]
)
def test_a_texture_stays(deviation, of, kept):
    theta = noisy(deviation, of)
    before = theta[..., D] - theta[..., D].mean((0, 1))
    after = evened(theta)[..., D]
    assert (after * before).sum() > kept * (before**2).sum()


def test_a_weave_of_single_pixels_stays():
    theta = noisy(0)
    weave = np.indices((SIZE, SIZE)).sum(0) % 2 - 0.5
    theta[..., D] *= (1 + 0.4 * weave)[..., None]
    before = theta[..., D].std()
    assert evened(theta)[..., D].std() > 0.9 * before


def kept_of(variation, deviation, of=1):
    """Share of an image (H, W) of roughness that stays on a sample whose albedo is `noisy`."""
    theta = noisy(deviation, of)
    theta[..., R] = flat().roughness + variation(theta[..., D].mean(-1))
    uneven = theta[..., R] - theta[..., R].mean()
    after = evened(theta)[..., R]
    return float((after * uneven).sum() / (uneven**2).sum())


def test_roughness_that_goes_with_the_albedo_stays():
    def alike(albedo):
        return 0.05 * np.log(albedo + 0.01)

    assert kept_of(alike, 0.3) > 0.9
    assert kept_of(lambda albedo: -alike(albedo), 0.3) > 0.9


def test_other_details_of_roughness_go_but_a_fifth_and_wide_shades_wholly():
    noise = 0.02 * np.random.default_rng(3).standard_normal((SIZE, SIZE))
    found = kept_of(lambda _: noise, 0.3)
    assert found == pytest.approx(PLAIN_SETTINGS.roughness, abs=0.05)
    shade = 0.02 * np.sin(np.linspace(0, np.pi, SIZE))[:, None] * np.ones(SIZE)
    assert abs(kept_of(lambda _: shade, 0.3)) < 0.05


def test_a_plain_sample_has_one_roughness():
    assert abs(kept_of(lambda albedo: 2 * (albedo - albedo.mean()), 0.01)) < 0.02


def test_metal_keeps_all_of_it():
    theta = noisy(0.01, k_d=np.float32([0, 0, 0]), k_s=0.6)
    before = theta.copy()
    np.testing.assert_array_equal(evened(theta), before)
    theta[:, : SIZE // 4, S], theta[:, SIZE // 4 :, S] = 0.6, 0.04  # a quarter is one
    before = theta.copy()
    np.testing.assert_array_equal(evened(theta), before)


def test_the_whole_refinement_does_both(renderer):
    """A flat sample's noisy photo, 2% brighter than the network's maps under lights in doubt."""
    photo, prior = asked(renderer, 1.02)
    noise = 0.04 * np.random.default_rng(2).standard_normal(photo.photo.shape)
    photo = replace(photo, photo=(photo.photo * (1 + noise)).astype(np.float32))
    start = Initial(flat(), replace(prior, mean=to_theta(flat())), asked=photo)
    result, (shot,) = explain_photos([photo], start, 64, lambda s: None, lambda i, e: None)
    found = result.maps.diffuse
    np.testing.assert_allclose(found.mean((0, 1)), ALBEDO, rtol=0.005)
    assert found.std((0, 1)).max() < 0.005
    shown = shot.renderer.render(result.maps, 64).mean((0, 1))
    np.testing.assert_allclose(shown, photo.photo.mean((0, 1)), rtol=0.01)
    (screen, room, _), *_ = result.factors
    both = renderer.scaled(screen, room).render(result.maps, 64).mean((0, 1))
    np.testing.assert_allclose(both, shown, rtol=0.002)


@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (3, 2)])
def test_a_few_pixels_are_numbers(renderer, shape):
    photo, prior = asked(renderer, 1.02)
    few = tuple(slice(n) for n in shape)
    start = Prior(prior.mean[few], prior.sigma[few], prior.correlation)
    photo = replace(photo, photo=photo.photo[few])
    initial = Initial(to_maps(start.mean), start, asked=photo)
    result, _ = explain_photos([photo], initial, 64, lambda s: None, lambda i, e: None)
    assert all(np.isfinite(m).all() for m in (*vars(result.maps).values(), result.sigma))
