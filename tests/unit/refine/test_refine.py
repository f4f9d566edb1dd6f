"""Initial maps, lobes and refinement on photos rendered from known maps."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.data.environments import procedural_environment
from invrender.data.materials import procedural_material
from invrender.lights import Lights
from invrender.maps import constant_maps, map_errors, turn_maps
from invrender.pattern.default import block_pattern
from invrender.refine import gauss_newton as refinement
from invrender.refine.checks import baked_light, coarse_error
from invrender.refine.flat import flat_maps
from invrender.refine.gauss_newton import Observation, linearise, refine
from invrender.refine.lobes import fit_lobes, read_lobes
from invrender.refine.posterior import explain
from invrender.refine.priors import Prior, lobe_prior, network_prior, pooled
from invrender.refine.theta import MIN_FITTED_ROUGHNESS, to_maps, to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.scene import make_scene
from invrender.report.notices import BAKED
from invrender.rig import Rig
from invrender.sphere import scale_environment

RIG, PATTERN, GAIN = Rig(), block_pattern(64), 2.0
SIZE = 32


@pytest.fixture(scope="module")
def environment():
    return scale_environment(procedural_environment(3, 64), 0.3)


@pytest.fixture(scope="module")
def renderer(environment):
    return Fast(make_scene(RIG, PATTERN, environment, GAIN))


def photo_of(maps, environment, samples=64):
    return Fast(make_scene(RIG, PATTERN, environment, GAIN)).render(maps, samples)


def test_theta_round_trip():
    rng = np.random.default_rng(0)
    maps = constant_maps(8, 8)
    maps.diffuse[:] = rng.random((8, 8, 3))
    slopes = rng.normal(0, 0.3, (8, 8, 2))
    maps.normal[..., :2] = slopes
    maps.normal /= np.linalg.norm(maps.normal, axis=-1, keepdims=True)
    back = to_maps(to_theta(maps))
    assert max(map_errors(back, maps).values()) < 1e-6


def test_linearise_predicts_small_changes(renderer):
    rng = np.random.default_rng(1)
    theta = to_theta(constant_maps(SIZE, SIZE, 0.4, 0.1, 0.5))
    theta += 0.05 * rng.standard_normal(theta.shape).astype(np.float32)
    step = 2e-4 * rng.standard_normal(theta.shape).astype(np.float32)
    image, jacobian = linearise(renderer, theta, 64)
    moved, _ = linearise(renderer, theta + step, 64)
    predicted = np.einsum("hwcp,hwp->hwc", jacobian, step)
    error = np.linalg.norm(moved - image - predicted) / np.linalg.norm(predicted)
    assert error < 0.02


@pytest.mark.parametrize(
    ("k_d", "k_s", "rho"),
    [
        ((0.4, 0.3, 0.2), 0.04, 0.55),
        ((0.05, 0.06, 0.1), 0.04, 0.23),
        ((0, 0, 0), (0.9, 0.7, 0.4), 0.32),
    ],
    ids=["matt", "glossy", "metal"],
)
def test_lobe_of_a_uniform_sample_is_found(renderer, environment, k_d, k_s, rho):
    truth = constant_maps(SIZE, SIZE, k_d, k_s, rho)
    maps = fit_lobes(photo_of(truth, environment), renderer)
    error = map_errors(maps, truth)
    assert error["roughness"] < 0.02
    assert error["specular"] < 0.02
    assert error["diffuse"] < 0.02


@pytest.mark.parametrize("metal", [False, True])
def test_evidence_of_dielectric_and_metal(renderer, environment, metal):
    """Of a textured sample: all three odds name its kind, whose fit is the truth."""
    rng = np.random.default_rng(0)
    truth = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.32)
    if metal:
        truth = constant_maps(SIZE, SIZE, 0, (0.9, 0.7, 0.4), 0.32)
    texture = rng.uniform(0.9, 1.1, (SIZE, SIZE, 1)).astype(np.float32)
    truth.diffuse, truth.specular = truth.diffuse * texture, truth.specular * texture**metal
    lobes = read_lobes(photo_of(truth, environment), renderer)
    e = lobes.evidence
    odds = np.stack([e.material_odds, e.sample_odds, e.texture_odds])
    assert odds.shape == (3, SIZE, SIZE) and ((odds > 0) == metal).all()
    if metal:
        color, wanted, rho = e.metal_specular, truth.specular, e.metal_roughness
        textured = e.metal_texture_roughness
        assert np.abs(e.metal_material_specular - truth.specular).mean() < 0.05
    else:
        color, wanted, rho = e.dielectric_diffuse, truth.diffuse, e.dielectric_roughness
        textured = e.dielectric_texture_roughness
    assert np.abs(color - wanted).mean() < 0.02
    assert np.abs(rho - 0.32).max() < 0.08 and np.abs(textured - 0.32).max() < 0.08
    costs = np.stack([e.residual_costs, e.texture_costs])
    assert (costs[:, int(metal)].min(-1) == 0).all() and (costs >= 0).all()


def test_white_under_lights_told_too_dark_is_no_metal(renderer, environment):
    """No albedo is above one, but lights may be told half as bright as they are."""
    rng = np.random.default_rng(0)
    truth = constant_maps(SIZE, SIZE, 0.85, 0.04, 0.9)
    truth.diffuse *= rng.uniform(0.95, 1.05, (SIZE, SIZE, 1)).astype(np.float32)
    maps = fit_lobes(2.2 * photo_of(truth, environment), renderer)
    assert maps.specular.max() < 0.1
    assert maps.diffuse.min() > 0.9


def test_two_materials_get_two_lobes(renderer, environment):
    truth = constant_maps(SIZE, SIZE, (0.5, 0.3, 0.1), 0.04, 0.7)
    half = SIZE // 2
    truth.diffuse[:, :half], truth.specular[:, :half] = 0, 0.8
    truth.roughness[:, :half] = 0.32
    photo = photo_of(truth, environment)
    start, maps = flat_maps(photo, renderer), fit_lobes(photo, renderer)
    assert map_errors(maps, truth)["average"] < 0.4 * map_errors(start, truth)["average"]


def test_photo_of_the_prior_changes_nothing(renderer, environment):
    maps = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.5)
    result = refine([Observation(photo_of(maps, environment), renderer)], lobe_prior(maps))
    assert result.converged
    assert max(map_errors(result.maps, maps).values()) < 1e-3


def test_normals_are_recovered_where_all_else_is_known(renderer, environment):
    truth = constant_maps(SIZE, SIZE, 0.3, 0.3, 0.4)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE * 2 * np.pi
    # Slight relief: a reflection must not jump from one block of the pattern to the next.
    truth.normal[..., 0], truth.normal[..., 1] = 0.05 * np.sin(2 * x), 0.05 * np.cos(3 * y)
    truth.normal /= np.linalg.norm(truth.normal, axis=-1, keepdims=True)
    photo = photo_of(truth, environment)
    start = constant_maps(SIZE, SIZE, 0.3, 0.3, 0.4)
    sigma = np.full((SIZE, SIZE, 9), 1e-3, np.float32)
    sigma[..., 7:] = 0.3
    prior = Prior(to_theta(start), sigma, np.eye(9, dtype=np.float32))
    result = refine([Observation(photo, renderer)], prior)
    before, after = map_errors(start, truth), map_errors(result.maps, truth)
    assert after["normal"] < 0.7 * before["normal"]
    errors = [h["photo_error"] for h in result.history]
    assert errors[-1] < 0.3 * errors[0]
    # The photo tells slopes, but the assumed noise leaves some doubt: about as much as there is.
    left = result.sigma[..., 7:]
    assert np.median(left) < 0.1
    error = (to_theta(result.maps) - to_theta(truth))[..., 7:]
    assert 0.2 < np.sqrt(np.mean((error / left) ** 2)) < 1.5


def test_clipped_pixels_keep_their_prior(renderer, environment):
    truth = constant_maps(SIZE, SIZE, 0.5, 0.04, 0.5)
    prior = lobe_prior(constant_maps(SIZE, SIZE, 0.2, 0.04, 0.5))
    clipped = np.zeros((SIZE, SIZE), bool)
    clipped[:8] = True
    result = refine([Observation(photo_of(truth, environment), renderer, clipped)], prior)
    np.testing.assert_allclose(result.maps.diffuse[:8], 0.2, atol=1e-3)
    assert result.maps.diffuse[8:].mean() > 0.25


@pytest.mark.parametrize("value", [0.0, 1e-6, 1e4])
def test_any_photo_gives_finite_maps_in_range(renderer, value):
    photo = np.full((8, 8, 3), value, np.float32)
    maps = fit_lobes(photo, renderer)
    result = refine([Observation(photo, renderer)], lobe_prior(maps), iterations=3)
    for image in result.maps.encoded().values():
        assert np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1
    assert (result.maps.diffuse + result.maps.specular).max() <= 1 + 1e-6
    assert result.maps.roughness.min() >= MIN_FITTED_ROUGHNESS
    assert np.isfinite(result.sigma).all()


def test_one_pixel(renderer):
    photo = np.full((1, 1, 3), 0.1, np.float32)
    result = refine([Observation(photo, renderer)], lobe_prior(fit_lobes(photo, renderer)))
    assert result.maps.shape == (1, 1)


def test_correction_of_a_networks_maps(renderer, environment):
    """Wrong albedos move to the truth, roughness stays, and what is clipped keeps its prior."""
    truth = constant_maps(SIZE, SIZE, 0.4, 0.04, 0.5)
    start = constant_maps(SIZE, SIZE, 0.48, 0.04, 0.5)
    sigma = {k: np.full((SIZE, SIZE), 0.05, np.float32) for k in ("diffuse", "roughness", "normal")}
    sigma["specular"] = np.full((SIZE, SIZE), 0.005, np.float32)
    clipped = np.zeros((SIZE, SIZE), bool)
    clipped[:8] = True
    prior = network_prior(start, sigma)
    result = explain([Observation(photo_of(truth, environment), renderer, clipped)], prior)
    assert map_errors(result.maps, truth)["diffuse"] < 0.7 * map_errors(start, truth)["diffuse"]
    assert np.array_equal(result.maps.roughness, start.roughness)
    assert result.maps.diffuse[:8] == pytest.approx(start.diffuse[:8], abs=1e-5)
    assert prior.total is not None
    assert (result.sigma <= prior.total * 1.0001).all()
    assert (result.sigma[8:, :, 0] < 0.95 * prior.total[8:, :, 0]).all()


def wrong_by(truth, seed):
    """Maps off by what all of the material shares and by relief, and their expected errors."""
    rng = np.random.default_rng(seed)
    theta = to_theta(truth)
    theta[..., :3] += 0.06 * rng.standard_normal(3).astype(np.float32)
    theta[..., 3:6] += np.float32(0.02 * rng.standard_normal())
    theta[..., 7:] += 0.1 * rng.standard_normal(theta[..., 7:].shape).astype(np.float32)
    names = ("diffuse", "specular", "roughness", "normal")
    sigma = {k: np.full(truth.shape, 0.05, np.float32) for k in names}
    return network_prior(to_maps(theta), sigma)


def test_two_photos_tell_more_than_one(renderer, environment):
    """The second under another pattern and with the sample turned."""
    truth = procedural_material(5, SIZE, SIZE, kind="leather")
    other = PATTERN[::-1, :, ::-1].copy()
    photo = Fast(make_scene(RIG, other, environment, GAIN)).render(turn_maps(truth, 1))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = Lights(RIG, other, environment, GAIN).placed(quarter)
    shots = [
        Observation(photo_of(truth, environment), renderer),
        Observation(np.ascontiguousarray(np.rot90(photo, -1)), Fast.under(turned)),
    ]
    # The turned photo is what the turned lights make of the sample that lies as before.
    image, _ = linearise(shots[1].renderer, to_theta(truth), 64)
    assert np.abs(image - shots[1].photo).mean() < 0.02 * image.mean()

    prior = wrong_by(truth, 0)
    for step in (explain, refine):
        one = map_errors(step(shots[:1], prior).maps, truth)["average"]
        two = map_errors(step(shots, prior).maps, truth)["average"]
        assert two < 0.98 * one


def test_pooled_priors_weigh_by_precision():
    maps = constant_maps(2, 2, 0.2, 0.04, 0.4), constant_maps(2, 2, 0.5, 0.04, 0.4)
    names = ("diffuse", "specular", "roughness", "normal")
    priors = [
        network_prior(m, {k: np.full((2, 2), s, np.float32) for k in names})
        for m, s in zip(maps, (0.01, 0.02), strict=True)
    ]
    both = pooled(priors)
    assert both.mean[..., 0] == pytest.approx(0.2 + 0.3 * 0.2)  # weights 4 : 1
    assert (both.sigma[..., 0] > 0.01).all() and (both.sigma[..., 0] < 0.02).all()


def test_bands_give_what_the_whole_gives(renderer, environment, monkeypatch):
    truth = procedural_material(7, SIZE, SIZE)
    shots, prior = [Observation(photo_of(truth, environment), renderer)], wrong_by(truth, 1)
    whole = refine(shots, prior, iterations=2), explain(shots, prior)
    monkeypatch.setattr(refinement, "BAND", 5 * SIZE)
    parts = refine(shots, prior, iterations=2), explain(shots, prior)
    for a, b in zip(whole, parts, strict=True):
        assert max(map_errors(a.maps, b.maps).values()) < 1e-3
        np.testing.assert_allclose(a.sigma, b.sigma, atol=1e-3)
        assert a.history[0]["photo_error"] == pytest.approx(b.history[0]["photo_error"])


def test_interrupt_keeps_the_best_so_far(renderer, environment):
    truth = constant_maps(SIZE, SIZE, 0.5, 0.04, 0.5)
    prior = lobe_prior(constant_maps(SIZE, SIZE, 0.45, 0.04, 0.5))

    def stop(step, error):
        if step == 1:
            raise KeyboardInterrupt

    result = refine([Observation(photo_of(truth, environment), renderer)], prior, progress=stop)
    assert result.interrupted and not result.converged
    error = np.abs(result.maps.diffuse - truth.diffuse).mean()
    assert error < np.abs(prior.mean[..., :3] - truth.diffuse).mean()


def test_albedo_that_makes_up_for_wrong_lights_is_told(renderer, environment):
    """A matt sample: the photo is explained in any rig, but the albedo's colours tell."""
    truth = constant_maps(SIZE, SIZE, (0.5, 0.35, 0.2), 0.04, 0.5)
    high = replace(RIG, screen_height=1.2 * RIG.screen_height)
    raised = Fast(make_scene(high, PATTERN, environment, GAIN))
    photos = photo_of(truth, environment), raised.render(truth)
    right, wrong = (baked_light(flat_maps(p, renderer).diffuse, renderer) for p in photos)
    assert right < 0.3 and wrong > BAKED
    dark = constant_maps(SIZE, SIZE, 0.0)
    assert baked_light(dark.diffuse, renderer) == 0
    plain = Fast(make_scene(RIG, np.ones((4, 4, 3), np.float32), None, 1.0))
    assert baked_light(truth.diffuse, plain) == 0


def test_coarse_error_sees_lights_and_not_texture():
    photo = np.full((37, 50, 3), 0.5, np.float32)
    nowhere = np.zeros(photo.shape[:2], bool)
    assert coarse_error(1.2 * photo, photo, nowhere) == pytest.approx(0.2, rel=1e-4)
    texture = np.random.default_rng(0).normal(0, 0.1, photo.shape).astype(np.float32)
    assert coarse_error(photo + texture, photo, nowhere) < 0.1
    left = np.where(np.arange(50)[None, :, None] < 25, 1.4, 1.0).astype(np.float32) * photo
    assert coarse_error(left, photo, nowhere) == pytest.approx(0.4 / np.sqrt(2), rel=0.05)
    assert coarse_error(left, photo, left[..., 0] > photo[..., 0]) == 0
    assert coarse_error(photo[:1, :1], photo[:1, :1], nowhere[:1, :1]) == 0
    assert np.isfinite(coarse_error(photo, 0 * photo, nowhere))


@pytest.mark.parametrize("seed", range(3))
def test_usual_f0_unless_the_photo_says_otherwise(renderer, environment, seed):
    """A strong texture leaves f0 open: it is the usual one then, not what fits slightly better."""
    rng = np.random.default_rng(seed)
    truth = constant_maps(SIZE, SIZE, (0.4, 0.3, 0.2), 0.04, 0.6)
    truth.diffuse *= rng.uniform(0.4, 1.6, (SIZE, SIZE, 3)).astype(np.float32)
    maps = fit_lobes(photo_of(truth, environment), renderer)
    assert np.abs(maps.specular - 0.04).max() < 0.015
