import numpy as np
import pytest
from scipy.stats import chi2

from invrender.render import brdf
from invrender.render.backend import Float, ad, dr, vector

Float64 = ad.Float64
Vec = vector(Float64, 3)


def random_directions(n, seed, lowest=0.0):
    rng = np.random.default_rng(seed)
    z, phi = rng.uniform(lowest, 1, n), rng.uniform(0, 2 * np.pi, n)
    r = np.sqrt(1 - z * z)
    return Vec(np.array([r * np.cos(phi), r * np.sin(phi), z]))


def lobe(l, v, alpha, k_s):
    """Specular BRDF times n·l."""
    value, weight = brdf.specular(l, v, alpha)
    return value * (k_s + (1 - k_s) * weight)


def test_frame_is_orthonormal_and_smooth():
    n = random_directions(1000, 0, -0.9)
    s, t = brdf.frame(n)
    for a, b, dot in ((s, s, 1), (t, t, 1), (s, t, 0), (s, n, 0), (t, n, 0)):
        assert np.allclose(np.array(dr.dot(a, b)), dot, atol=1e-12)
    assert np.allclose(np.array(dr.cross(s, t)), np.array(n), atol=1e-12)
    d = random_directions(1000, 1, -1)
    back = brdf.to_world(brdf.to_local(d, s, t, n), s, t, n)
    assert np.allclose(np.array(back), np.array(d), atol=1e-12)


def test_reciprocity():
    l, v = random_directions(4096, 0, 0.01), random_directions(4096, 1, 0.01)
    alpha = Float64(np.random.default_rng(2).uniform(1e-4, 1, 4096))
    a = np.array(lobe(l, v, alpha, 0.3) / l.z)
    b = np.array(lobe(v, l, alpha, 0.3) / v.z)
    assert np.allclose(a, b, rtol=1e-9)


@pytest.mark.parametrize("alpha", [1e-4, 0.01, 0.1, 0.5, 1.0])
def test_distribution_is_normalised(alpha):
    """∫ D(h) cos h dh = 1, by a substitution that resolves the narrowest lobe."""
    n = 4000
    u = (np.arange(n) + 0.5) / n
    # tan²θ = α² u/(1-u) makes the integrand of an exact GGX constant: any other D would not be 1.
    tan2 = alpha**2 * u / (1 - u)
    cos = 1 / np.sqrt(1 + tan2)
    h = Vec(np.array([np.sqrt(1 - cos**2), np.zeros(n), cos]))
    # dcosθ/du from cos² = (1-u)/(1-u+α²u)
    q = 1 - u + alpha**2 * u
    jacobian = alpha**2 / (2 * cos * q * q)
    total = np.mean(2 * np.pi * np.array(brdf.ggx_d(h, Float64(alpha))) * cos * jacobian)
    assert total == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("elevation", [90, 60, 20, 3])
@pytest.mark.parametrize("roughness", [0.3, 0.6, 1.0])
def test_visible_normals_follow_their_density(elevation, roughness):
    """χ² test of sampled directions against the integral of the density over the sphere's bins."""
    rng = np.random.default_rng(elevation)
    n, alpha = 200_000, roughness**2
    e = np.radians(elevation)
    v = Vec(*map(float, (np.cos(e) * np.cos(0.7), np.cos(e) * np.sin(0.7), np.sin(e))))
    h = brdf.sample_vndf(v, Float64(alpha), Float64(rng.uniform(size=n)), Float64(rng.random(n)))
    assert np.all(np.array(dr.dot(v, h)) > 0), "a sampled normal is not visible"
    l = np.array(dr.fma(h, 2 * dr.dot(v, h), -v))
    bins_z, bins_phi, sub_z, sub = 20, 24, 60, 120
    up = l[:, l[2] > 0]
    phi = np.mod(np.arctan2(up[1], up[0]), 2 * np.pi)
    # The last bin counts directions below the horizon.
    found = np.histogram2d(up[2], phi, (bins_z, bins_phi), ((0, 1), (0, 2 * np.pi)))[0]
    z = (np.arange(bins_z * sub_z) + 0.5) / (bins_z * sub_z)
    p = (np.arange(bins_phi * sub) + 0.5) / (bins_phi * sub) * 2 * np.pi
    z, p = (g.ravel() for g in np.meshgrid(z, p, indexing="ij"))
    r = np.sqrt(1 - z * z)
    grid = Vec(np.array([r * np.cos(p), r * np.sin(p), z]))
    density = np.array(brdf.pdf_vndf(grid, v, Float64(alpha)))
    density = density.reshape(bins_z, sub_z, bins_phi, sub).mean((1, 3))
    expected = n * density * (2 * np.pi / (bins_z * bins_phi))
    below = n - up.shape[1]
    expected_below = n - expected.sum()
    assert abs(below - expected_below) < 5 * np.sqrt(max(expected_below, 25)) + 2e-4 * n
    large = expected > 20
    statistic = np.sum((found[large] - expected[large]) ** 2 / expected[large])
    assert chi2.sf(statistic, large.sum() - 1) > 1e-4


def test_cosine_samples_follow_their_density():
    rng = np.random.default_rng(0)
    d = np.array(
        brdf.sample_cosine(Float64(rng.random(100_000)), Float64(rng.random(100_000)), Vec)
    )
    assert np.allclose(np.linalg.norm(d, axis=0), 1)
    # P(z² < a) = a for density z/π
    found = np.histogram(d[2] ** 2, 20, (0, 1))[0]
    assert chi2.sf(np.sum((found - 5000.0) ** 2 / 5000), 19) > 1e-4


@pytest.mark.parametrize("elevation", [90, 45, 10, 1, 0.1])
@pytest.mark.parametrize("roughness", [0.01, 0.1, 0.5, 1.0])
def test_white_furnace(elevation, roughness):
    """Neither lobe reflects more than it receives: k_s = 1 (F = 1) and k_d = 1 one by one."""
    n = 1 << 15
    i = np.arange(n)
    e = np.radians(elevation)
    v = Vec(float(np.cos(e)), 0, float(np.sin(e)))
    alpha = Float64(roughness**2)
    u1, u2 = Float64((i * 0.6180339887) % 1), Float64((i + 0.5) / n)
    h = brdf.sample_vndf(v, alpha, u1, u2)
    l = dr.fma(h, 2 * dr.dot(v, h), -v)
    pdf = brdf.pdf_vndf(l, v, alpha)
    weight = dr.select(pdf > 0, lobe(l, v, alpha, 1) / dr.select(pdf > 0, pdf, 1), 0)
    weight = np.array(weight)
    assert np.all(np.isfinite(weight)) and weight.min() >= 0
    assert weight.max() <= 1 + 1e-9, "G2/G1 must not exceed one"
    assert weight.mean() <= 1 + 1e-9
    if roughness == 0.01 and elevation >= 10:
        assert weight.mean() > 0.999, "a smooth metal loses next to nothing"


def test_smooth_and_rough_limits():
    """A narrow lobe returns the mirror direction with weight k_s; at α = 1 D is 1/π everywhere."""
    v = random_directions(500, 3, 0.3)
    rng = np.random.default_rng(4)
    u = Float64(rng.random(500)), Float64(0.98 * rng.random(500))
    h = np.array(brdf.sample_vndf(v, Float64(1e-5), *u))
    assert np.abs(h[:2]).max() < 5e-4 and h[2].min() > 0.999999
    assert np.allclose(np.array(brdf.ggx_d(v, Float64(1.0))), 1 / np.pi)


def test_nothing_below_the_horizon():
    down = Vec(0.6, 0.0, -0.8)
    up = Vec(0.0, 0.6, 0.8)
    for l, v in ((down, up), (up, down)):
        assert lobe(l, v, Float64(0.3), 0.5)[0] == 0
        assert brdf.pdf_vndf(l, v, Float64(0.3))[0] == 0


def test_schlick_ends():
    assert brdf.schlick(Float64(1.0))[0] == 0
    assert brdf.schlick(Float64(0.0))[0] == 1
    assert brdf.schlick(Float64(1.0 + 1e-9))[0] == 0  # rounding past normal incidence


def test_float32_agrees_with_float64():
    """D, the lobe and the density keep a relative 1e-4 even where α² is 1e-8."""
    n = 4096
    rng = np.random.default_rng(0)
    v = random_directions(n, 5, 0.02)
    alpha = np.exp(rng.uniform(np.log(1e-4), 0, n))
    h = np.array(
        brdf.sample_vndf(v, Float64(alpha), Float64(rng.random(n)), Float64(rng.random(n)))
    )
    h32 = h.astype(np.float32)
    a = np.array(brdf.ggx_d(vector(Float, 3)(h32), Float(alpha.astype(np.float32))), np.float64)
    b = np.array(
        brdf.ggx_d(Vec(h32.astype(float)), Float64(alpha.astype(np.float32).astype(float)))
    )
    assert np.abs(a / b - 1).max() < 1e-4
