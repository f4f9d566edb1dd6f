"""Near-mirrors: the lobes' reading where it explains the photo far better, the networks' else."""

import numpy as np
import pytest

from invrender.data.environments import procedural_environment
from invrender.maps import constant_maps, map_errors
from invrender.pattern.default import block_pattern
from invrender.refine.gauss_newton import Observation
from invrender.refine.lobes import fit_lobes
from invrender.refine.mirrors import take_mirrors
from invrender.refine.priors import network_prior
from invrender.refine.theta import R, to_maps
from invrender.render.fast.estimator import Fast
from invrender.render.scene import make_scene
from invrender.rig import Rig
from invrender.sphere import scale_environment

SIZE = 32


@pytest.fixture(scope="module")
def renderer():
    room = scale_environment(procedural_environment(3, 64), 0.3)
    return Fast(make_scene(Rig(), block_pattern(64), room, 2.0))


def prior_of(maps):
    names = ("diffuse", "specular", "roughness", "normal")
    return network_prior(maps, {n: np.full(maps.shape, 0.03, np.float32) for n in names})


def taken(photo, renderer, prior, clipped=None):
    lobes = fit_lobes(photo, renderer)
    return take_mirrors(Observation(photo, renderer, clipped), prior, lobes)


@pytest.mark.parametrize(
    ("k_d", "k_s", "rho"),
    [(0, (0.9, 0.8, 0.6), 0.05), (0, 0.8, 0.1), (0.02, 0.04, 0.05)],
    ids=["mirror", "polished metal", "black gloss"],
)
def test_a_near_mirror_is_taken_from_the_lobes(renderer, k_d, k_s, rho):
    truth = constant_maps(SIZE, SIZE, k_d, k_s, rho)
    blurred = constant_maps(SIZE, SIZE, k_d, k_s, rho + 0.1)
    found = taken(renderer.render(truth), renderer, prior_of(blurred))
    assert map_errors(to_maps(found.mean), truth)["average"] < 0.01
    assert found.sigma[..., R].max() < 0.03
    assert np.array_equal(found.expected, found.sigma)


def test_one_half_may_be_a_mirror(renderer):
    half = SIZE // 2
    truth = constant_maps(SIZE, SIZE, (0.4, 0.3, 0.2), 0.04, 0.7)
    truth.diffuse[:, :half], truth.specular[:, :half], truth.roughness[:, :half] = 0, 0.9, 0.05
    start = constant_maps(SIZE, SIZE, (0.4, 0.3, 0.2), 0.04, 0.6)
    start.diffuse[:, :half], start.specular[:, :half], start.roughness[:, :half] = 0, 0.9, 0.15
    prior = prior_of(start)
    found = taken(renderer.render(truth), renderer, prior)
    assert (found.mean[:, : half - 1, R] == 0.05).mean() > 0.95
    rest = np.s_[:, half + 1 :]
    assert (found.mean[rest] == prior.mean[rest]).mean() > 0.95
    assert (found.expected[rest] == prior.expected[rest]).mean() > 0.95
    assert (found.expected[:, : half - 1] == found.sigma[:, : half - 1]).mean() > 0.95


def test_maps_that_explain_the_photo_stay(renderer):
    truth = constant_maps(SIZE, SIZE, 0, (0.9, 0.8, 0.6), 0.12)
    prior = prior_of(truth)
    assert taken(renderer.render(truth), renderer, prior) is prior


def test_what_no_plain_lobe_explains_stays(renderer):
    """A texture of black and white: pixel by pixel the lobes' albedo would explain any."""
    truth = constant_maps(SIZE, SIZE, 0.05, 0.04, 0.1)
    blocks = np.random.default_rng(1).random((SIZE // 4, SIZE // 4, 1)) > 0.5
    truth.diffuse += (0.5 * np.kron(blocks, np.ones((4, 4, 1)))).astype(np.float32)
    wrong = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.25)
    photo = renderer.render(truth)
    prior = prior_of(wrong)
    lobes = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.1)
    lobes.diffuse = truth.diffuse
    assert take_mirrors(Observation(photo, renderer), prior, lobes) is prior


def test_rough_lobes_stay(renderer):
    truth = constant_maps(SIZE, SIZE, 0, 0.8, 0.55)
    prior = prior_of(constant_maps(SIZE, SIZE, 0, 0.8, 0.3))
    assert taken(renderer.render(truth), renderer, prior) is prior


def test_saturated_pixels_are_not_compared(renderer):
    truth = constant_maps(SIZE, SIZE, 0, 0.8, 0.1)
    photo = renderer.render(truth)
    clipped = np.zeros((SIZE, SIZE), bool)
    clipped[:12] = True
    shown = np.where(clipped[..., None], photo.min(), photo).astype(np.float32)
    prior = prior_of(constant_maps(SIZE, SIZE, 0, 0.8, 0.2))
    found = take_mirrors(Observation(shown, renderer, clipped), prior, truth)
    assert (found.mean[..., R] == np.float32(0.1)).all()
    everything = np.ones((SIZE, SIZE), bool)
    assert take_mirrors(Observation(shown, renderer, everything), prior, truth) is prior


def test_lobes_of_a_smaller_photo(renderer):
    """Large photos have lobes of at most 256 pixels a side."""
    truth = constant_maps(SIZE, SIZE, 0, 0.8, 0.1)
    prior = prior_of(constant_maps(SIZE, SIZE, 0, 0.8, 0.2))
    shot = Observation(renderer.render(truth), renderer)
    found = take_mirrors(shot, prior, constant_maps(SIZE // 2, SIZE // 2, 0, 0.8, 0.1))
    assert map_errors(to_maps(found.mean), truth)["average"] < 0.01
