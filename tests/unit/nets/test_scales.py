"""An estimate of a large photo from that of the photo shrunk."""

import numpy as np
import pytest

pytest.importorskip("torch")

from invrender.maps import Maps, resize_maps
from invrender.sampling import resize
from nets.scales import Prediction, enlarged

SIZE, SMALL = 96, 24


def estimate(maps):
    sigma = {k: np.full(maps.shape, 0.05, np.float32) for k in ("normal", "diffuse", "roughness")}
    return Prediction(maps, sigma, 1.0)


@pytest.fixture
def textured():
    """A photo (96, 96, 3) of a sample in two greys, at a slope that darkens it, and its maps."""
    rng = np.random.default_rng(0)
    dark = resize(rng.uniform(0, 1, (48, 48, 1)).astype(np.float32), SIZE, SIZE)
    diffuse = np.exp(np.repeat(dark, 3, -1) - 2)
    normal = np.concatenate([0.5 * dark, 0 * dark, np.ones_like(dark)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    flat = np.full((SIZE, SIZE), 0.5, np.float32)
    maps = Maps(diffuse, np.full_like(diffuse, 0.04), flat, normal)
    light = np.linspace(1, 2, SIZE, dtype=np.float32)[:, None]
    return diffuse * light, maps


def test_details_follow_the_photo(textured):
    """What is linear in the photo's logarithm is found; what does not vary stays as it is."""
    photo, maps = textured
    found = enlarged(estimate(resize_maps(maps, SMALL, SMALL)), photo).maps
    plain = resize_maps(resize_maps(maps, SMALL, SMALL), SIZE, SIZE)
    error = lambda m, name: np.sqrt(np.mean((getattr(m, name) - getattr(maps, name)) ** 2))  # noqa: E731
    for name in ("diffuse", "normal"):
        assert error(found, name) < 0.3 * error(plain, name), name
    np.testing.assert_allclose(found.specular, 0.04, atol=1e-5)
    np.testing.assert_allclose(found.roughness, 0.5, atol=1e-5)
    # Shrunk again it is nearer to what it was made from than the interpolated maps are.
    small = resize_maps(maps, SMALL, SMALL).diffuse
    back = [resize(m.diffuse, SMALL, SMALL) for m in (found, plain)]
    assert np.abs(back[0] - small).mean() < 0.5 * np.abs(back[1] - small).mean()


def test_noise_makes_no_details(textured):
    """Where the shrunk photo is even, a large one's noise is not texture."""
    _, maps = textured
    maps = resize_maps(maps, SMALL, SMALL)
    noise = 0.01 * np.random.default_rng(1).standard_normal((SIZE, SIZE, 3))
    photo = (0.3 * (1 + noise)).astype(np.float32)
    found, plain = enlarged(estimate(maps), photo).maps, resize_maps(maps, SIZE, SIZE)
    assert np.abs(found.diffuse - plain.diffuse).mean() < 0.005


@pytest.mark.parametrize("level", [0.0, 1e-12, 1e12])
def test_any_photo_gives_maps(textured, level):
    """Black, in any unit, or negative here and there; not wider than a window."""
    photo, maps = textured
    photo = photo.copy()
    photo[::7] = -0.01
    for size in (SMALL, 2):
        found = enlarged(estimate(resize_maps(maps, size, size)), photo * np.float32(level)).maps
        for image in vars(found).values():
            assert np.isfinite(image).all()
        np.testing.assert_allclose(np.linalg.norm(found.normal, axis=-1), 1, atol=1e-5)
        assert (found.normal[..., 2] > 0).all()
