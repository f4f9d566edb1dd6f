"""Parts of the refinement that have closed forms: ranges, deviations, errors, penalties."""

import numpy as np
import pytest

from invrender.maps import constant_maps
from invrender.refine import lobes, pixels, posterior, several, shared
from invrender.refine.checks import photo_error
from invrender.refine.evidence import ODDS_SCALE, compress
from invrender.refine.flat import diffuse_rest
from invrender.refine.priors import ERROR_INFLATION, channel_correlation, lobe_prior, network_prior
from invrender.refine.theta import D, N, R, S, deviations, project, to_maps, to_theta


def sigma_of(maps, **sigma):
    return {k: np.full(maps.shape, v, np.float32) for k, v in sigma.items()}


def test_range_of_theta():
    theta = np.zeros((1, 3, 9), np.float32)
    theta[..., D], theta[..., S], theta[..., R] = 0.9, (0.3, -0.1, 1.5), (0.001, 0.05, 7)
    theta[0, :, N] = (0.3, 0.4), (30, 40), (0, -2.9)
    project(theta)
    np.testing.assert_allclose(theta[0, 0, D], (0.7, 0.9, 0), atol=1e-6)
    np.testing.assert_allclose(theta[0, 0, S], (0.3, 0, 1), atol=1e-6)
    np.testing.assert_allclose(theta[0, :, R], (0.03, 0.05, 1))
    np.testing.assert_allclose(theta[0, :, N], [(0.3, 0.4), (1.8, 2.4), (0, -2.9)], atol=1e-5)


def test_maps_of_slopes_are_unit_normals():
    theta = to_theta(constant_maps(1, 1, 0.3, 0.04, 0.5))
    theta[..., N] = 0.75, -1.0
    normal = to_maps(theta).normal[0, 0]
    np.testing.assert_allclose(normal, np.array([0.75, -1, 1]) / np.sqrt(2.5625), rtol=1e-6)


def test_deviations_of_maps():
    sigma = np.arange(1, 10, dtype=np.float32)[None, None]
    found = deviations(sigma)
    np.testing.assert_allclose(found["diffuse"][0, 0], (1, 2, 3))
    np.testing.assert_allclose(found["specular"][0, 0], (4, 5, 6))
    assert found["roughness"][0, 0] == 7
    np.testing.assert_allclose(found["normal"][0, 0], np.sqrt((64 + 81) / 2) / 2, rtol=1e-6)


def test_prior_of_lobes():
    maps = constant_maps(1, 2, 0.4, 0.04, 0.5)
    maps.specular[0, 1] = 0.36
    sigma = lobe_prior(maps).sigma
    np.testing.assert_allclose(sigma[..., D], 0.01 + 0.05 * 0.4, rtol=1e-5)
    np.testing.assert_allclose(sigma[0, 0, S], 0.002, rtol=1e-5)
    np.testing.assert_allclose(sigma[0, 1, S], 0.002 + 0.05, rtol=1e-5)
    np.testing.assert_allclose(sigma[..., R], 0.02)
    np.testing.assert_allclose(sigma[..., N], 0.05)


def test_prior_of_a_networks_maps():
    maps = constant_maps(1, 1, 0.4, 0.04, 0.5)
    small = network_prior(
        maps, sigma_of(maps, diffuse=0.02, specular=0.004, roughness=0.06, normal=0.01)
    )
    nominal = np.array([0.02] * 3 + [0.004] * 3 + [0.06] + [0.02] * 2)
    np.testing.assert_allclose(small.expected[0, 0], ERROR_INFLATION * nominal, rtol=1e-5)
    share = ERROR_INFLATION / ERROR_INFLATION.max()
    np.testing.assert_allclose(small.sigma[0, 0], share * nominal, rtol=1e-5)
    # An albedo's error within a material is at most a share of it, that of all is not.
    great = network_prior(
        maps, sigma_of(maps, diffuse=0.5, specular=0.5, roughness=0.06, normal=0.01)
    )
    np.testing.assert_allclose(great.sigma[0, 0, D], 0.01 + 0.15 * 0.4, rtol=1e-5)
    np.testing.assert_allclose(great.sigma[0, 0, S], 0.01 + 0.3 * 0.04, rtol=1e-5)
    np.testing.assert_allclose(great.expected[0, 0, D], 0.5 * ERROR_INFLATION[0], rtol=1e-5)


def test_channels_of_an_albedo_vary_together():
    c = channel_correlation(0.9, 0.5)
    assert np.allclose(np.diag(c), 1) and np.allclose(c, c.T)
    assert np.allclose([c[0, 1], c[1, 2]], 0.9) and np.allclose([c[3, 4], c[3, 5]], 0.5)
    assert c[0, 3] == c[2, 6] == c[7, 8] == 0


def test_photo_error_is_of_what_the_photo_measures():
    photo = np.full((4, 4, 3), 2.0, np.float32)
    picture = photo.copy()
    picture[0] = 3
    picture[1] = 100
    clipped = np.zeros((4, 4), bool)
    clipped[1] = True
    # One row of the three that are measured is off by one.
    assert photo_error(picture, photo, clipped) == pytest.approx(np.sqrt(1 / 3) / 2)


def test_evidence_is_compressed_beyond_its_scale():
    assert compress(np.array(0.1)) == pytest.approx(0.1 / ODDS_SCALE, rel=1e-3)
    assert compress(np.array(-1e4)) == pytest.approx(-np.log(2e4 / ODDS_SCALE), rel=1e-3)


def test_what_a_lobe_leaves_is_diffuse():
    e, b, a = (np.full((1, 2, 3), v, np.float32) for v in (3.0, 2.0, 0.1))
    photo = np.full((1, 2, 3), 0.5 * 3 / np.pi + 0.04 * 2 + 0.1, np.float32)
    photo[0, 1] = 50
    found = diffuse_rest(photo, (e, b, a), np.full(3, 0.04))
    np.testing.assert_allclose(found[0, 0], 0.5, rtol=1e-5)
    np.testing.assert_allclose(found[0, 1], 0.96, rtol=1e-5)


def test_least_squares_of_a_lobe():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.5, 1.5, (2, 400))
    z = 0.3 * x + 0.2 * y
    moments = [float((p * q).mean()) for p, q in ((x, x), (x, y), (y, y), (x, z), (y, z), (z, z))]
    k_s, k_d, rest = lobes._least_squares(np.array(moments), 0.0, np.float64(0.04))
    assert (k_s, k_d) == (pytest.approx(0.2, rel=1e-4), pytest.approx(0.3, rel=1e-4))
    assert rest < 1e-6
    # A strong pull gives the usual f0, and the diffuse albedo that goes with it.
    k_s, k_d, rest = lobes._least_squares(np.array(moments), 1e6, np.float64(0.04))
    assert k_s == pytest.approx(0.04, rel=1e-3) and k_d > 0.4 and rest > 1e-5


def test_unusual_lobes_cost_more():
    assert lobes._UNLIKELY.argmin() == np.abs(lobes.ROUGHNESS - lobes.USUAL_ROUGHNESS).argmin()
    assert lobes._UNLIKELY[0] == pytest.approx(4.0) and (lobes._UNLIKELY >= 0).all()


def test_plainer_texture_is_likelier():
    """A lobe that leaves the pattern in the albedo is less likely than one that does not."""
    rng = np.random.default_rng(1)
    e, b = rng.uniform(1, 2, (2, 16, 16, 3)).astype(np.float32)
    b *= 2
    a = np.zeros_like(e)
    photo = 0.3 * e / np.pi + lobes.USUAL_SPECULAR * b
    other = b[::-1].copy()
    assert lobes._plainness(photo, e, b, a, False) < lobes._plainness(photo, e, other, a, False)
    assert lobes._plainness(photo, e, b, a, False) < lobes._plainness(photo, e, b, a, True)
    metal = 0.8 * b
    assert lobes._plainness(metal, e, b, a, True) < lobes._plainness(metal, e, b, a, False)


def test_deviations_of_two_materials():
    sigma = np.full((1, 3, 9), 0.5, np.float32)
    share = np.array([[0.0, 0.5, 1.0]], np.float32)[..., None]
    s = posterior.SETTINGS
    both = posterior._sigma_of_both(sigma, share, s)
    np.testing.assert_allclose(both[0, :, 3], (0.005, 0.1525, 0.3), rtol=1e-5)
    np.testing.assert_allclose(both[0, :, 0], (0.502, 0.252, 0.002), rtol=1e-5)
    np.testing.assert_allclose(
        posterior._share_sigma(share, s)[0, :, 0], (0.1, 0.3, 0.1), rtol=1e-5
    )
    assert (sigma == 0.5).all()
    np.testing.assert_allclose(s.take, [1] * 6 + [0] + [0.2] * 2)


def test_deviations_for_several_photos():
    theta = to_theta(constant_maps(1, 2, 0.3, 0.04, 0.5))
    theta[0, 1, S] = 0.6
    s = several.TOGETHER
    sigma = pixels.wide_deviations(theta, np.full((1, 2), 0.07, np.float32), s)
    np.testing.assert_allclose(sigma[0, 0], [0.3] * 3 + [0.003] * 3 + [0.07] + [0.6] * 2, rtol=1e-5)
    np.testing.assert_allclose(sigma[0, 1], [0.01] * 3 + [0.3] * 3 + [0.07] + [0.6] * 2, rtol=1e-5)


def test_deviations_of_a_material():
    theta = to_theta(constant_maps(1, 3, 0.4, 0.04, 0.5))
    theta[0, 1, S], theta[0, 2, S] = 0.21, 0.8
    sigma = shared.shared_sigma(theta)
    np.testing.assert_allclose(sigma[..., D], 0.01 + 0.1 * 0.4, rtol=1e-5)
    np.testing.assert_allclose(
        sigma[0, :, 3], (0.002, 0.002 + 0.2 * 0.21 / 2, 0.002 + 0.2 * 0.8), rtol=1e-5
    )
    np.testing.assert_allclose(sigma[0, :, R], (0.025, 0.0375, 0.05), rtol=1e-5)


def test_contrast_is_with_neighbours():
    photo = np.full((64, 64, 3), 0.2, np.float32)
    assert np.abs(shared.contrast(photo)).max() < 1e-7
    photo[:, 32:] = 1.0
    found = shared.contrast(photo)
    # One of the four neighbours of the two columns on each side is beyond the edge.
    np.testing.assert_allclose(found[:, 30:34], 0.2, rtol=1e-5)
    assert found[:, :30].max() < 1e-6 and found[:, 34:].max() < 1e-6
    assert shared.contrast(photo[:1, :1]).shape == (1, 1, 3)


def test_parts_are_squares():
    part = shared.parts_of(32, 64).reshape(32, 64)
    assert part[0, 0] == 0 and part[-1, -1] == 255 and len(np.unique(part)) == 256
    assert (part[:2, :4] == 0).all() and part[0, 4] == 1 and part[2, 0] == 16
    assert int(shared.parts_of(3, 1)[-1]) == 2
