"""Heights against surfaces that are known, and seamless maps."""

from dataclasses import replace

import numpy as np
import pytest

from invrender.data.materials import procedural_material
from invrender.export.tileable import make_tileable
from invrender.maps import constant_maps, crop_maps
from invrender.render.height import displaced, height_from_normals
from invrender.types import InputError

SIDE = 0.09  # metres


def surface(n, kind):
    """Height (mean 0) and normals of an analytic surface on n × n pixels."""
    c = (np.arange(n) + 0.5) / n * SIDE - SIDE / 2
    x, y = np.meshgrid(c, -c)
    if kind == "sphere":
        h = np.sqrt(0.07**2 - x * x - y * y)
        p, q = -x / h, -y / h
    elif kind == "waves":
        k = 4 * np.pi / SIDE
        h = 0.001 * np.sin(k * x) * np.cos(k * y)
        p = 0.001 * k * np.cos(k * x) * np.cos(k * y)
        q = -0.001 * k * np.sin(k * x) * np.sin(k * y)
    else:
        h, p, q = 0.1 * x - 0.2 * y, np.full_like(x, 0.1), np.full_like(x, -0.2)
    normal = np.stack([-p, -q, np.ones_like(p)], -1)
    return h - h.mean(), normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def relative(height, truth):
    return np.sqrt(np.mean((height - truth) ** 2)) / truth.std()


@pytest.mark.parametrize(("kind", "bound"), [("sphere", 3e-3), ("waves", 5e-3), ("plane", 1e-5)])
def test_metres(kind, bound):
    truth, normal = surface(128, kind)
    assert relative(height_from_normals(normal, SIDE / 128).height, truth) < bound


def test_periodic():
    truth, normal = surface(128, "waves")
    found = height_from_normals(normal, SIDE / 128, periodic=True)
    assert relative(found.height, truth) < 5e-3


@pytest.mark.parametrize("kind", ["sphere", "waves", "plane"])
def test_outliers_do_not_bend_the_surface(kind):
    truth, normal = surface(128, kind)
    rng = np.random.default_rng(0)
    bad = rng.random(truth.shape) < 0.05
    wild = rng.normal(size=(bad.sum(), 3))
    wild[:, 2] = np.abs(wild[:, 2])
    normal[bad] = wild / np.linalg.norm(wild, axis=-1, keepdims=True)
    robust = height_from_normals(normal, SIDE / 128)
    plain = height_from_normals(normal, SIDE / 128, robust=False)
    assert relative(robust.height, truth) < 0.2 * relative(plain.height, truth)
    assert 0.02 < robust.outliers < 0.2


def test_horizon_and_single_pixels_stay_finite():
    normal = np.array([[[1.0, 0, 0]]])
    assert np.isfinite(height_from_normals(normal, 1e-3).height).all()
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(17, 33, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    for periodic in (False, True):
        found = height_from_normals(normal, 1e-3, periodic=periodic)
        assert found.height.shape == (17, 33) and np.isfinite(found.height).all()


@pytest.mark.parametrize("kind", ["bricks", "leather", "rusty_metal"])
def test_seams_vanish(kind):
    maps = crop_maps(procedural_material(4, 160, 160, kind=kind), 5, 9, 128, 120)
    tiled, seams = make_tileable(maps)
    assert tiled.shape == maps.shape
    assert seams.before > 1.5 and seams.after < 1.3
    # Whole pixels are taken: the colours are the sample's.
    for name in ("diffuse", "specular", "roughness"):
        old, new = getattr(maps, name), getattr(tiled, name)
        assert old.min() - 1e-6 <= new.min() and new.max() <= old.max() + 1e-6
        assert np.abs(new.mean() - old.mean()) < 0.5 * old.std() + 1e-6
    assert np.allclose(np.linalg.norm(tiled.normal, axis=-1), 1, atol=1e-5)


def test_constant_maps_stay():
    tiled, seams = make_tileable(constant_maps(32, 32))
    assert np.allclose(tiled.diffuse, 0.5) and seams.after == 0
    with pytest.raises(InputError):
        make_tileable(constant_maps(8, 8))


def test_displaced_normals_are_those_of_a_surface():
    """Of normals that no surface has the rest is left out: what is left is a surface's own."""
    rng = np.random.default_rng(3)
    slope = 0.2 * rng.standard_normal((24, 24, 2))
    normal = np.concatenate([slope, np.ones((24, 24, 1))], -1)
    normal = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
    maps = replace(constant_maps(24, 24), normal=normal)
    height, of_surface = displaced(maps, 0.09)
    down, right = np.gradient(height / (0.09 / 24))
    np.testing.assert_allclose(
        -of_surface.normal[..., 0] / of_surface.normal[..., 2], right, atol=1e-4
    )
    np.testing.assert_allclose(
        of_surface.normal[..., 1] / of_surface.normal[..., 2], down, atol=1e-4
    )
    assert abs(height.mean()) < 1e-7
    bowl = np.add.outer(np.linspace(-1, 1, 32) ** 2, np.linspace(-1, 1, 32) ** 2) * 0.004
    down, right = np.gradient(bowl / (0.09 / 32))
    normal = np.stack([-right, down, np.ones_like(bowl)], -1)
    normal = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
    height, same = displaced(replace(constant_maps(32, 32), normal=normal), 0.09)
    np.testing.assert_allclose(height, bowl - bowl.mean(), atol=2e-5)
    assert (same.normal * normal).sum(-1)[1:-1, 1:-1].min() > 0.9999
