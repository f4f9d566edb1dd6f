"""What materials share and what lights are off by: found where the photo tells it, else kept."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.data.environments import procedural_environment
from invrender.maps import constant_maps, map_errors
from invrender.pattern.default import block_pattern
from invrender.refine.estimate import Initial, explain_photos
from invrender.refine.gauss_newton import Observation
from invrender.refine.priors import network_prior
from invrender.refine.shared import (
    SHARED_SETTINGS,
    _Problem,
    belongs,
    light_doubt,
    materials,
    plain_dielectric,
    share,
)
from invrender.refine.theta import D, R, S, to_maps, to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.scene import make_scene
from invrender.rig import Rig
from invrender.sphere import scale_environment

SIZE = 32
ROOM = scale_environment(procedural_environment(3, 64), 0.3)
SIGMA = {"diffuse": 0.05, "specular": 0.05, "roughness": 0.08, "normal": 0.001}


def lit_by(room, gain=2.0):
    return Fast(make_scene(Rig(), block_pattern(64), room, gain))


def under(gain=2.0, room=1.0):
    return lit_by(room * ROOM, gain)


@pytest.fixture(scope="module")
def renderer():
    return under()


def prior_of(maps, **sigma):
    return network_prior(
        maps, {k: np.full(maps.shape, v, np.float32) for k, v in {**SIGMA, **sigma}.items()}
    )


def textured(maps, amount=0.2):
    """The maps with a fine texture on their albedos."""
    by = 1 + amount * np.random.default_rng(0).uniform(-1, 1, (*maps.shape, 1))
    maps.diffuse, maps.specular = (
        (x * np.where(x > 0.05, by, 1)).astype(np.float32) for x in (maps.diffuse, maps.specular)
    )
    return maps


@pytest.mark.parametrize("off", [-0.07, 0.07])
@pytest.mark.parametrize(
    ("k_d", "k_s", "rho"),
    [(0, (0.9, 0.75, 0.5), 0.25), (0, 0.8, 0.12), (0.03, 0.04, 0.15), (0.05, 0.04, 0.4)],
    ids=["metal", "polished metal", "near-mirror", "dark gloss"],
)
def test_roughness_that_a_material_shares_is_found(renderer, k_d, k_s, rho, off):
    truth = textured(constant_maps(SIZE, SIZE, k_d, k_s, rho))
    start = to_theta(truth)
    start[..., R] = max(rho + off, 0.04)
    found = share([Observation(renderer.render(truth), renderer)], prior_of(to_maps(start)))
    before = abs(start[0, 0, R] - rho)
    assert abs(found.prior.mean[..., R].mean() - rho) < 0.3 * before
    assert found.converged


def test_each_material_has_its_own(renderer):
    """Bare metal is rougher than it was told, the paint beside it smoother."""
    half = SIZE // 2
    truth = constant_maps(SIZE, SIZE, (0.04, 0.05, 0.06), 0.04, 0.3)
    truth.diffuse[:, :half], truth.specular[:, :half], truth.roughness[:, :half] = 0, 0.8, 0.4
    start = to_theta(truth)
    start[:, :half, R] -= 0.07
    start[:, half:, R] += 0.07
    found = share([Observation(renderer.render(truth), renderer)], prior_of(to_maps(start)))
    error = found.prior.mean[..., R] - truth.roughness
    assert np.abs(error).mean() < 0.03


def test_truth_stays(renderer):
    truth = textured(constant_maps(SIZE, SIZE, (0.4, 0.3, 0.2), 0.04, 0.5))
    found = share([Observation(renderer.render(truth), renderer)], prior_of(truth))
    assert max(map_errors(to_maps(found.prior.mean), truth).values()) < 2e-3
    assert found.converged and found.misfit < 0.01


def test_what_the_photo_does_not_tell_stays(renderer):
    """A white sample's lobe is lost in its texture."""
    truth = textured(constant_maps(SIZE, SIZE, 0.7, 0.04, 0.8), 0.4)
    start = to_theta(truth)
    start[..., R] -= 0.1
    prior = prior_of(to_maps(start))
    found = share([Observation(renderer.render(truth), renderer)], prior)
    moved = found.prior.mean[..., R] - start[..., R]
    assert np.abs(moved).max() < 0.1
    # Its error is still expected, while that of a metal's roughness is not.
    metal = constant_maps(SIZE, SIZE, 0, 0.8, 0.3)
    known = share([Observation(renderer.render(metal), renderer)], prior_of(metal))
    total = prior.total
    assert known.prior.total[..., R].mean() < 0.8 * total[..., R].mean()
    assert found.prior.total[..., R].mean() > 0.9 * total[..., R].mean()
    assert np.array_equal(known.prior.total[..., 7:], prior_of(metal).total[..., 7:])


def test_unresolved_relief_is_no_roughness(renderer):
    """Where slopes may be off by more than the lobe is wide, a wider lobe says little of it."""
    truth = constant_maps(SIZE, SIZE, 0, 0.8, 0.3)
    photo = renderer.render(constant_maps(SIZE, SIZE, 0, 0.8, 0.38))
    moved = {}
    for slopes in (0.01, 0.1):
        prior = prior_of(truth, normal=slopes)
        found = share([Observation(photo, renderer)], prior)
        moved[slopes] = float(found.prior.mean[..., R].mean()) - 0.3
    assert moved[0.01] > 0.06
    assert 0 < moved[0.1] < 0.5 * moved[0.01]


def test_relief_that_the_maps_have_tells_of_more(renderer):
    """Of steep relief there is about as much again as the maps have."""
    truth = constant_maps(SIZE, SIZE, 0, 0.8, 0.3)
    moved = {}
    for steep in (0.0, 0.15):
        theta = to_theta(truth)
        theta[..., 7] += steep * np.where(np.arange(SIZE) % 2, 1, -1)
        start = to_maps(theta)
        theta[..., R] = 0.38
        photo = renderer.render(to_maps(theta))
        found = share([Observation(photo, renderer)], prior_of(start, normal=0.001))
        moved[steep] = float(found.prior.mean[..., R].mean()) - 0.3
    assert moved[0.0] > 0.06
    assert 0 < moved[0.15] < 0.6 * moved[0.0]


def test_doubtful_room_is_found(renderer):
    """A lamp was saturated: the room is brighter than it was taken for, the screen is not."""
    truth = textured(constant_maps(SIZE, SIZE, (0.4, 0.3, 0.2), 0.04, 0.3))
    photo = under(room=1.5).render(truth)
    found = share([Observation(photo, renderer, doubt=(0.001, 0.4))], prior_of(truth))
    screen, room, lamps = found.factors[0]
    assert (lamps == 1).all()
    assert np.abs(screen - 1).max() < 0.01
    assert np.abs(room / 1.5 - 1).max() < 0.15
    shown = found.observations[0].renderer.render(to_maps(found.prior.mean))
    assert np.abs(shown - photo).mean() < 0.2 * np.abs(renderer.render(truth) - photo).mean()


@pytest.mark.parametrize(("exponent", "loss"), [(-0.1, 0.0), (0.08, 0.0), (0.0, 0.15)])
def test_what_a_camera_does_is_found(renderer, exponent, loss):
    """A JPEG's power of light, and a lens that darkens the corners: not believed to be roughness
    or texture, and undone."""
    maps = textured(constant_maps(SIZE, SIZE, (0.5, 0.3, 0.2), 0.04, 0.3), 0.05)
    light = renderer.render(maps)
    away = np.add.outer(np.linspace(0, 0.5, SIZE), np.linspace(0, 0.5, SIZE)).astype(np.float32)
    middle = np.median(light)
    photo = middle * (light * np.exp(-loss * away[..., None]) / middle) ** (1 + exponent)
    prior = prior_of(maps, roughness=0.1)
    off, known = (
        share([Observation(photo.astype(np.float32), renderer, **camera)], prior)
        for camera in ({}, {"exponent": 0.15, "away": away})
    )

    def error(shared):
        return map_errors(to_maps(shared.prior.mean), maps)["roughness"]

    def contrast(shared):
        return np.log(shared.observations[0].photo / light).std()

    assert error(known) < 0.5 * error(off)
    assert contrast(known) < 0.5 * contrast(off)


@pytest.mark.parametrize("photos", [1, 2])
@pytest.mark.parametrize("shadow", [1.0, 0.2])
def test_a_shadow_that_the_lights_do_not_have_is_no_material(renderer, shadow, photos):
    """Where all parts together contradict the lights, a dielectric keeps its first maps."""
    maps = constant_maps(SIZE, SIZE, 0.7, 0.04, 0.6)
    photo = renderer.render(maps)
    photo[:, SIZE // 2 :] *= shadow
    first = replace(maps, roughness=maps.roughness + 0.03)
    seen = [Observation(photo, renderer), Observation(renderer.render(maps), renderer)][:photos]
    initial = Initial(first, prior_of(first), asked=seen[0])
    found, _ = explain_photos(seen, initial, 64, print, print)
    moved = np.abs(found.maps.diffuse - first.diffuse).max() > 0
    assert found.contradicted == (shadow < 1) and moved == (shadow == 1)


def test_doubtful_lamps_are_found(renderer):
    """The room beside them is not brighter, and nothing passes for a narrower lobe."""
    truth = textured(constant_maps(SIZE, SIZE, (0.4, 0.3, 0.2), 0.04, 0.5))
    lamps = np.zeros_like(ROOM)
    lamps[12:14, 30:32] = (150, 140, 130)
    times = np.array([1.3, 1.2, 1.1], np.float32)
    photo = lit_by(ROOM + times * lamps).render(truth)
    shot = Observation(photo, lit_by(ROOM + lamps), doubt=(0.001, 0.05), lamps=lamps)
    found = share([shot], prior_of(truth))
    screen, room, factor = found.factors[0]
    assert np.abs(screen - 1).max() < 0.01 and np.abs(room - 1).max() < 0.05
    assert np.abs(factor / times - 1).max() < 0.05
    assert np.abs(found.prior.mean[..., R] - 0.5).max() < 0.01
    shown = found.observations[0].renderer.render(to_maps(found.prior.mean))
    assert np.abs(shown - photo).mean() < 0.02 * photo.mean()


@pytest.mark.parametrize(("k_s", "alike"), [(0.04, 0.9), (0.8, 0.3)], ids=["paint", "metal"])
def test_what_is_expected_before_the_photo(renderer, k_s, alike):
    """Materials of a kind are off by much the same; a photo's colours are by nearly the same."""
    maps = constant_maps(SIZE, SIZE, 0.6, 0.04, 0.8)
    maps.diffuse[:8], maps.specular[:8], maps.roughness[:8] = 0.1, k_s, 0.3
    theta = to_theta(maps)
    shot = Observation(renderer.render(maps), renderer, doubt=(0.02, 0.1))
    centres = materials(theta)
    problem = _Problem([shot], prior_of(maps), theta, centres, 64, SHARED_SETTINGS)
    expected = np.linalg.inv(problem.precision)
    np.testing.assert_allclose(np.diag(expected)[:14], 1, rtol=1e-5)
    np.testing.assert_allclose(expected[R, 7 + R], alike, rtol=1e-4)
    np.testing.assert_allclose(expected[0, 1], 0.9, rtol=1e-4)
    for k, sigma in ((14, 0.02), (17, 0.1)):
        np.testing.assert_allclose(expected[k, k], 1.25 * sigma**2, rtol=1e-4)
        np.testing.assert_allclose(expected[k, k + 1], sigma**2, rtol=1e-4)
    assert expected[14, 17] == pytest.approx(0, abs=1e-9)


def test_known_lights_are_no_unknowns(renderer):
    truth = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.5)
    photo = under(room=1.5).render(truth)
    found = share([Observation(photo, renderer)], prior_of(truth))
    assert found.observations[0].renderer is renderer
    assert all((f == 1).all() for f in found.factors[0])


def test_two_photos_tell_more_than_one(renderer):
    """The second photo's screen is in doubt; what both share is not."""
    truth = textured(constant_maps(SIZE, SIZE, 0, 0.8, 0.3))
    start = to_theta(truth)
    start[..., R] += 0.07
    shots = [
        Observation(renderer.render(truth), renderer),
        Observation(under(gain=2.2).render(truth), renderer, doubt=(0.1, 0.01)),
    ]
    found = share(shots, prior_of(to_maps(start)))
    assert abs(found.prior.mean[..., R].mean() - 0.3) < 0.01
    assert found.factors[0][0].mean() == 1
    assert abs(found.factors[1][0].mean() - 1.1) < 0.02


def test_saturated_pixels_tell_nothing(renderer):
    truth = textured(constant_maps(SIZE, SIZE, 0, 0.8, 0.3))
    photo = renderer.render(truth)
    photo[: SIZE // 2] = 0.05
    clipped = np.zeros((SIZE, SIZE), bool)
    clipped[: SIZE // 2] = True
    found = share([Observation(photo, renderer, clipped)], prior_of(truth))
    assert max(map_errors(to_maps(found.prior.mean), truth).values()) < 5e-3


@pytest.mark.parametrize("value", [0.0, 1e4])
@pytest.mark.parametrize("size", [1, 3, 24])
def test_any_photo_gives_finite_maps(renderer, value, size):
    maps = constant_maps(size, size, 0.3, 0.04, 0.5)
    photo = np.full((size, size, 3), value, np.float32)
    found = share([Observation(photo, renderer, doubt=(0.01, 0.1))], prior_of(maps))
    assert np.isfinite(found.prior.mean).all() and np.isfinite(found.prior.total).all()
    everything = np.ones((size, size), bool)
    found = share([Observation(photo, renderer, everything)], prior_of(maps))
    assert np.abs(found.prior.mean - to_theta(maps)).max() < 1e-5


def test_groups_are_materials():
    maps = constant_maps(SIZE, SIZE, (0.3, 0.15, 0.08), 0.04, 0.7)
    maps.diffuse[:8], maps.specular[:8], maps.roughness[:8] = 0, 0.7, 0.3
    theta = to_theta(maps)
    weight = belongs(theta, materials(theta))
    assert weight.shape == (SIZE, SIZE, 2)
    np.testing.assert_allclose(weight.sum(-1), 1, atol=1e-5)
    first = int(weight[-1, 0].argmax())
    assert (weight[8:, :, first] > 0.99).all() and (weight[:8, :, first] < 0.01).all()
    assert materials(to_theta(constant_maps(8, 8, 0.4, 0.04, 0.5))).shape == (1, 5)


def test_dielectric_mirrors_alike():
    maps = constant_maps(SIZE, SIZE, 0.3, 0.04, 0.5)
    maps.specular[:, ::2] = (0.05, 0.03, 0.02)
    maps.specular[:4] = (0.9, 0.7, 0.4)
    theta = plain_dielectric(to_theta(maps))
    assert np.ptp(theta[4:, :, S]) < 1e-6 and theta[10, 0, 3] == np.float32(0.04)
    np.testing.assert_allclose(theta[:4, :, S], maps.specular[:4])
    assert (theta[..., D] == to_theta(maps)[..., D]).all()


def test_doubt_of_lights():
    assert light_doubt({}) == (0, 0)
    screen, room = light_doubt({"residual": 0.02, "room_raised": 1.0, "hidden_lamp": 1.0})
    assert screen == 0.02 and 0.01 < room < 0.1
    assert light_doubt({"residual": 0.0})[0] > 0
    assert light_doubt({"residual": 0.02, "hidden_lamp": 3.0})[1] > room


def test_scaled_renderer_is_one_of_scaled_lights(renderer):
    maps = constant_maps(8, 8, 0.3, 0.2, 0.3)
    color = np.array([1.5, 1.0, 0.5], np.float32)
    wanted = Fast(make_scene(Rig(), block_pattern(64), color * ROOM, 2.0 * color[::-1]))
    found = renderer.scaled(color[::-1], color)
    np.testing.assert_allclose(found.render(maps), wanted.render(maps), rtol=2e-3, atol=1e-5)
    found = renderer.scaled(1.0, 2.0, -0.5 * ROOM)
    np.testing.assert_allclose(
        found.render(maps), lit_by(1.5 * ROOM).render(maps), rtol=2e-3, atol=1e-5
    )


def test_paint_of_two_sheens_is_two_materials():
    """And one whose roughness differs by little is one."""
    found = {}
    for off in (0.05, 0.3):
        maps = constant_maps(SIZE, SIZE, 0.2, 0.04, 0.3)
        maps.roughness[: SIZE // 2] += off
        found[off] = len(materials(to_theta(maps)))
    assert found == {0.05: 1, 0.3: 2}
