"""Maps of a large photo from those of the photo shrunk."""

import numpy as np
import pytest

from invrender.capture.lights import find_lights
from invrender.capture.sample import Sample
from invrender.data import EXAMPLE
from invrender.files.capture import load_capture
from invrender.lights import Lights
from invrender.maps import Maps, constant_maps, resize_maps
from invrender.pattern.default import default_pattern
from invrender.pipeline import Stages, estimate_maps
from invrender.refine import enlarge as module
from invrender.refine.enlarge import TAKEN, enlarge, explain_details
from invrender.render.fast.estimator import Fast
from invrender.rig import Rig
from invrender.sampling import resize

SIZE, SMALL = 96, 24


def test_two_large_photos_are_solved_small(monkeypatch):
    """The maps have the photos' size; shrunk, they are those of the photos shrunk."""
    pytest.importorskip("nets.predict")  # it keeps the size that it finds: for all tests after
    monkeypatch.setattr(module, "WHOLE", 24)
    large = Sample.of(find_lights(load_capture(EXAMPLE)), 48)
    start, result, photos = estimate_maps([large, large], Stages())
    small = estimate_maps([large.shrunk(24, 24)] * 2, Stages())[1]
    assert start.shape == (24, 24) and result.maps.shape == (48, 48) and len(photos) == 2
    assert result.rendering is not None and result.rendering.shape == (48, 48, 3)
    np.testing.assert_allclose(
        result.maps.roughness, resize(small.maps.roughness, 48, 48), atol=1e-5
    )
    again = resize(result.maps.diffuse, 24, 24)
    assert np.abs(again - small.maps.diffuse).mean() < 0.01


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
    found = enlarge(resize_maps(maps, SMALL, SMALL), photo)
    plain = resize_maps(resize_maps(maps, SMALL, SMALL), SIZE, SIZE)
    error = lambda m, name: np.sqrt(np.mean((getattr(m, name) - getattr(maps, name)) ** 2))  # noqa: E731
    for name in ("diffuse", "normal"):
        assert error(found, name) < 0.3 * error(plain, name), name
    np.testing.assert_allclose(found.specular, 0.04, atol=1e-5)
    np.testing.assert_allclose(found.roughness, 0.5, atol=1e-5)


def test_shrunk_again_the_maps_are_what_they_were(textured):
    """Interpolation alone would even them out; bands leave no seams."""
    photo, maps = textured
    small = resize_maps(maps, SMALL, SMALL)
    found, plain = enlarge(small, photo), resize_maps(small, SIZE, SIZE)
    off = lambda m: np.abs(resize(m.diffuse, SMALL, SMALL) - small.diffuse).mean()  # noqa: E731
    assert off(found) < 0.1 * off(plain)
    np.testing.assert_array_equal(enlarge(small, resize(photo, SMALL, SMALL)).roughness,
                                  small.roughness)  # fmt: skip


def test_bands_leave_no_seams(textured, monkeypatch):
    photo, maps = textured
    small = resize_maps(maps, SMALL, SMALL)
    whole = enlarge(small, photo)
    monkeypatch.setattr(module, "BAND_PIXELS", 7 * SIZE)
    for name, image in vars(enlarge(small, photo)).items():
        np.testing.assert_allclose(image, getattr(whole, name), atol=1e-5, err_msg=name)


@pytest.mark.parametrize(("specular", "taken"), [(0.04, TAKEN), (0.6, 0.0)])
def test_albedo_takes_of_the_details_that_are_left(textured, specular, taken):
    """A dielectric's, and where the photo is not saturated; its rendering goes along."""
    renderer = Fast.under(Lights(Rig(), default_pattern(), np.zeros((16, 32, 3), np.float32), 2.0))
    small = constant_maps(SMALL, SMALL, diffuse=0.3, specular=specular, roughness=0.9)
    maps = resize_maps(small, SIZE, SIZE)
    true = resize_maps(small, SIZE, SIZE)
    detail = textured[1].diffuse - resize(resize(textured[1].diffuse, SMALL, SMALL), SIZE, SIZE)
    true.diffuse += detail
    picture, photo = (renderer.render(m, 64) for m in (maps, true))
    clipped = np.zeros((SIZE, SIZE), bool)
    clipped[:, :10] = True
    explain_details(maps, picture, photo, clipped, small, renderer)
    change = maps.diffuse - 0.3
    np.testing.assert_array_equal(change[:, :10], 0)
    slope = (change * detail)[:, 10:].sum() / (detail**2)[:, 10:].sum()
    assert 0.8 * taken <= slope <= taken + 1e-3
    np.testing.assert_allclose(picture, renderer.render(maps, 64), rtol=5e-3)


def test_noise_makes_no_details(textured):
    """Where the shrunk photo is even, a large one's noise is not texture."""
    _, maps = textured
    maps = resize_maps(maps, SMALL, SMALL)
    noise = 0.01 * np.random.default_rng(1).standard_normal((SIZE, SIZE, 3))
    even = np.full_like(noise, 0.3, dtype=np.float32)
    found, plain = enlarge(maps, even * np.float32(1 + noise)), enlarge(maps, even)
    assert np.abs(found.diffuse - plain.diffuse).mean() < 0.005


def test_a_photos_noise_stays_out_of_its_texture(textured):
    """White noise of each colour by itself is told from a texture, of which little is lost."""
    photo, maps = textured
    small = resize_maps(maps, SMALL, SMALL)
    noise = 0.1 * np.random.default_rng(1).standard_normal(photo.shape).astype(np.float32)
    error = lambda photo: np.abs(enlarge(small, photo).diffuse - maps.diffuse).mean()  # noqa: E731
    assert error(photo * (1 + noise)) < 1.5 * error(photo)


@pytest.mark.parametrize("level", [0.0, 1e-12, 1e12])
def test_any_photo_gives_maps(textured, level):
    """Black, in any unit, or negative here and there; not wider than a window."""
    photo, maps = textured
    photo = photo.copy()
    photo[::7] = -0.01
    for size in (SMALL, 2):
        found = enlarge(resize_maps(maps, size, size), photo * np.float32(level))
        for image in vars(found).values():
            assert np.isfinite(image).all()
        np.testing.assert_allclose(np.linalg.norm(found.normal, axis=-1), 1, atol=1e-5)
        assert (found.normal[..., 2] > 0).all()
