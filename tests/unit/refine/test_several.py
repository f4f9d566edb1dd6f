"""Several photos of one sample, explained together."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from invrender.data.environments import procedural_environment
from invrender.data.materials import procedural_material
from invrender.data.simulate_setup import without_screen
from invrender.lights import NO_PATTERN, Lights
from invrender.maps import constant_maps, map_errors
from invrender.pattern.default import default_pattern
from invrender.refine.gauss_newton import Observation
from invrender.refine.priors import network_prior
from invrender.refine.registration import factor_image
from invrender.refine.several import by_pattern, explain_together, plain_prior
from invrender.refine.shared_roughness import TRIED_ROUGHNESS, pool_roughness
from invrender.refine.theta import N, R, to_maps, to_theta
from invrender.render.fast.estimator import Fast
from invrender.rig import Rig
from invrender.sphere import scale_environment

SIZE = 24
SAMPLES = 16  # of the lobe, in photos as in what explains them
NAMES = ("diffuse", "specular", "roughness", "normal")


def half(axis, side):
    pattern = np.full((16, 16, 3), 0.02, np.float32)
    np.moveaxis(pattern, axis, 0)[8 * side : 8 * side + 8] = 1
    return pattern


PATTERNS = [default_pattern(), *(half(axis, side) for axis in (0, 1) for side in (0, 1))]


@pytest.fixture(scope="module")
def renderers():
    room = scale_environment(procedural_environment(3, 64), 0.3)
    return [Fast.under(Lights(Rig(), p, room, 2.0)) for p in PATTERNS]


@pytest.fixture(scope="module")
def truth():
    return procedural_material(5, SIZE, SIZE, kind="leather")


def photos_of(maps, renderers):
    rng = np.random.default_rng(0)
    photos = [r.render(maps, SAMPLES) for r in renderers]
    photos = [p * (1 + 0.005 * rng.standard_normal(p.shape).astype(np.float32)) for p in photos]
    return [Observation(p, r) for p, r in zip(photos, renderers, strict=True)]


def as_a_network_errs(truth):
    """Flat, too rough, and half as bright again."""
    theta = to_theta(truth)
    theta[..., 7:] *= 0.2
    theta[..., R] = np.clip(theta[..., R] + 0.1, 0, 1)
    theta[..., :3] *= 1.5
    return network_prior(to_maps(theta), {k: np.full(truth.shape, 0.05, np.float32) for k in NAMES})


def explained(photos, prior):
    return explain_together(photos, prior, samples=SAMPLES)


@pytest.fixture(scope="module")
def found(truth, renderers):
    return explained(photos_of(truth, renderers), as_a_network_errs(truth))


def test_five_photos_measure_what_one_leaves_to_the_prior(truth, found):
    before = map_errors(to_maps(as_a_network_errs(truth).mean), truth)
    after = map_errors(found.maps, truth)
    assert after["normal"] < 0.7 * before["normal"]
    assert after["diffuse"] < 0.5 * before["diffuse"]
    assert after["roughness"] < 0.75 * before["roughness"]
    assert after["specular"] < 0.01  # a dielectric stays one
    assert max(found.photo_errors) < 0.04 and not found.left_out


def test_a_photo_s_own_exposure_and_another_sample_are_found(truth, renderers, found):
    photos = photos_of(truth, renderers)
    photos[2] = replace(photos[2], photo=photos[2].photo * np.float32([1.08, 1, 0.95]))
    other = procedural_material(2, SIZE, SIZE, kind="bricks")
    photos.append(photos_of(other, renderers)[3])
    drifted = explained(photos, as_a_network_errs(truth))
    assert drifted.left_out == [5]
    before, after = (map_errors(f.maps, truth) for f in (found, drifted))
    assert after["normal"] < 1.4 * before["normal"]
    assert after["average"] < 1.3 * before["average"] + 0.003


def test_a_flat_sample_stays_flat(renderers):
    """Under lights that are found a little wrong, otherwise in each photo, with initial wrinkles;
    colours' noise is alike, so that five photos have hardly more than five numbers a pixel."""
    maps = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.8)
    rng = np.random.default_rng(2)
    factors = np.array([0.01, 0.02, 0.02]) * rng.standard_normal((len(renderers), 1, 3))
    photos = [
        replace(o, photo=o.photo * factor_image(np.tile(f, (3, 1)), SIZE, SIZE) * (1 + grey))
        for o, f, grey in zip(
            photos_of(maps, renderers), factors,
            0.01 * rng.standard_normal((len(renderers), SIZE, SIZE, 1)).astype(np.float32),
            strict=True,
        )
    ]  # fmt: skip
    theta = to_theta(maps)
    theta[..., N] = 0.1 * rng.standard_normal((SIZE, SIZE, 2))
    prior = network_prior(to_maps(theta), {k: np.full(maps.shape, 0.05, np.float32) for k in NAMES})
    slopes = to_theta(explained(photos, prior).maps)[..., N]
    assert np.sqrt((slopes**2).mean()) < 0.02
    assert np.abs(slopes.mean((0, 1))).max() < 0.005


def test_a_blurred_photo_does_no_harm(truth, renderers, found):
    photos = photos_of(truth, renderers)
    blurred = ndimage.gaussian_filter(photos[1].photo, (3, 3, 0))
    photos[1] = replace(photos[1], photo=blurred)
    before, after = (
        map_errors(maps, truth)["average"]
        for maps in (found.maps, explained(photos, as_a_network_errs(truth)).maps)
    )
    assert after < 1.25 * before


@pytest.mark.parametrize("value", [0.0, 1e6])
def test_any_photos_give_finite_maps_in_range(renderers, value):
    maps = constant_maps(4, 4)
    prior = network_prior(maps, {k: np.full((4, 4), 0.05, np.float32) for k in NAMES})
    photos = [Observation(np.full((4, 4, 3), value, np.float32), r) for r in renderers[:3]]
    found = explained(photos, prior)
    for name, image in found.maps.encoded().items():
        assert np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1, name
    assert np.isfinite(found.sigma).all()


def test_bands_and_saturated_pixels(truth, renderers, found, monkeypatch):
    """Rows are solved in bands; a pixel that no photo measures stays where the prior is."""
    prior, photos = as_a_network_errs(truth), photos_of(truth, renderers)
    clipped = np.zeros(truth.shape, bool)
    clipped[4, 5] = True
    monkeypatch.setattr("invrender.refine.several.BAND", SIZE * 8)
    parts = explained([replace(p, clipped=clipped) for p in photos], prior)
    assert map_errors(parts.maps, found.maps)["average"] < 0.02
    np.testing.assert_allclose(to_theta(parts.maps)[4, 5, :6], prior.mean[4, 5, :6], atol=1e-3)
    assert parts.sigma[4, 5, 0] > 5 * np.median(parts.sigma[..., 0])


def test_pixels_that_nothing_explains_keep_their_initial_maps(truth, renderers, found):
    """Such as relief finer than a pixel, but for their roughness, which is their material's; what
    is measured elsewhere is not spoilt."""
    prior, photos = as_a_network_errs(truth), photos_of(truth, renderers)
    rng = np.random.default_rng(1)
    wrong = slice(8, 14), slice(8, 14)
    for photo in photos:
        photo.photo[wrong] *= rng.uniform(0.2, 3, (6, 6, 3)).astype(np.float32)
    theta = to_theta(explained(photos, prior).maps)
    off = (np.abs(theta - prior.mean) / prior.expected)[wrong]
    assert np.median(off) < 0.3 and np.delete(off, R, -1).max() < 3
    before, after = (np.abs(t - to_theta(truth))[wrong][..., R].mean() for t in (prior.mean, theta))
    assert after < 0.6 * before
    rest = np.ones(truth.shape, bool)
    rest[6:16, 6:16] = False
    np.testing.assert_allclose(
        np.median(np.abs(theta - to_theta(found.maps))[rest], 0), 0, atol=0.02
    )


def test_a_good_start_on_a_mirror_is_not_lost(renderers):
    """A search from wide lobes loses narrow ones, whose patterns are other pixels'."""
    truth = constant_maps(SIZE, SIZE, 0.05, 0.04, 0.1)
    truth.diffuse[:, ::3] = 0.5
    theta = to_theta(truth)
    theta[..., :3] *= 1.2
    theta[..., R] += 0.03
    sigma = {k: np.full(truth.shape, 0.03, np.float32) for k in NAMES}
    prior = network_prior(to_maps(theta), sigma)
    before, after = (
        map_errors(maps, truth)
        for maps in (to_maps(prior.mean), explained(photos_of(truth, renderers), prior).maps)
    )
    assert after["normal"] < 0.005
    assert after["diffuse"] < 0.5 * before["diffuse"]


def test_roughness_is_that_of_the_materials_pixels_or_the_prior_s():
    theta = to_theta(constant_maps(16, 16, 0.3, 0.04, 0.5))
    theta[:8, :, :3] = 0.8
    sigma = np.full((16, 16), 0.1, np.float32)
    wanted = np.where(np.arange(16) < 8, 0.33, 0.8)[:, None]

    def told(rho, start):
        return start, np.broadcast_to(((rho - wanted) / 0.04) ** 2, (16, 16))

    mean, spread = pool_roughness(theta, sigma, told).roughness(theta)
    np.testing.assert_allclose(mean, np.broadcast_to(wanted, (16, 16)), atol=0.09)
    assert spread.max() < 0.15
    silent = pool_roughness(theta, sigma, lambda rho, start: (start, np.zeros((16, 16))))
    assert np.abs(silent.roughness(theta)[0] - 0.5).max() < np.diff(TRIED_ROUGHNESS).max() / 2


def test_photos_under_the_known_pattern_come_first():
    known = default_pattern()
    assert by_pattern([half(0, 0), known, half(1, 0), known[::2, ::2]], known)[:2] == [1, 3]


@pytest.fixture(scope="module")
def lamps():
    """Six photos' lights without a screen: a lamp in a room, moved about."""
    room = scale_environment(procedural_environment(3, 64), 0.5)
    rig = without_screen(Rig())
    lights = []
    for k in range(6):
        lit = room.copy()
        row = (8, 16)[k % 2]
        column = 64 * 2 * k // 6
        lit[row : row + 2, column : column + 3] += 400
        lights.append(Lights(rig, NO_PATTERN, lit, 0.0))
    return [Fast.under(x) for x in lights]


@pytest.mark.parametrize("kind", ["leather", "rusty_metal"])
def test_lamps_alone_measure_dielectrics_and_metals(lamps, kind):
    truth = procedural_material(5, SIZE, SIZE, kind=kind)
    photos = photos_of(truth, lamps)
    prior = plain_prior(photos, SAMPLES)
    found_metal = prior.mean[..., 3:6].mean(-1) > 0.2
    metal = truth.specular.mean(-1) > 0.3
    assert np.mean(found_metal == metal) > 0.8
    if metal.any():
        return
    before, after = (
        map_errors(maps, truth) for maps in (to_maps(prior.mean), explained(photos, prior).maps)
    )
    assert after["normal"] < 0.3 * before["normal"]
    assert after["average"] < 0.5 * before["average"]


def test_black_polished_stone_is_not_taken_for_metal(lamps):
    """Next to no diffuse albedo is left beside too wide a lobe: it has no hue then, and f0 no
    grounds to be nought."""
    truth = constant_maps(8, 8, 0.004, 0.04, 0.08)
    truth.diffuse[::3, ::2] *= 3
    prior = plain_prior(photos_of(truth, lamps), SAMPLES)
    assert np.all(np.abs(prior.mean[..., 3:6] - 0.04) < 0.01)
    assert np.median(prior.mean[..., 6]) < 0.2
