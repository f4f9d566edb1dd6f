"""Metrics against closed forms and libraries, what they refuse, and ``invrender compare``."""

import json
import sys

import numpy as np
import pytest

from invrender.cli import compare as compare_cli
from invrender.cli.main import main
from invrender.data import EXAMPLE
from invrender.files.maps import read_maps, write_maps
from invrender.files.write import write_exr, write_png
from invrender.maps import constant_maps
from invrender.render.point_lights import grid_lights, relight, rerender
from invrender.report import metrics
from invrender.rig import Rig
from invrender.types import InputError

NOISE = np.random.default_rng(0).random((48, 40, 3))
RIG = Rig()


def test_relit_diffuse_sample_is_lamberts_law():
    maps = constant_maps(3, 3, diffuse=(0.2, 0.5, 0.8), specular=0.0, roughness=1.0)
    light = np.array([0.01, -0.02, 0.1])
    (image,) = relight(maps, RIG, light[None])
    to_light = light - RIG.sample_points(3, 3)
    distance = np.linalg.norm(to_light, axis=-1)
    cosine = to_light[..., 2] / distance
    v = RIG.camera - RIG.sample_points(3, 3)
    h = to_light / distance[..., None] + v / np.linalg.norm(v, axis=-1, keepdims=True)
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    # α = 1: D = 1/π, G2/(4 n·l n·v) = 1/(2(n·l + n·v)); f0 = 0 leaves Schlick's weight.
    v_z = RIG.camera[2] / np.linalg.norm(v, axis=-1)
    weight = (1 - (h * to_light).sum(-1) / distance) ** 5
    lobe = weight / np.pi / (2 * (cosine + v_z)) * cosine
    albedo = np.array([0.2, 0.5, 0.8]) / np.pi * cosine[..., None] + lobe[..., None]
    expected = albedo * np.pi * RIG.screen_height**2 / distance[..., None] ** 2
    np.testing.assert_allclose(image, expected, rtol=1e-5)


def test_grid_of_lights_is_over_the_sample():
    lights = grid_lights(RIG)
    assert lights.shape == (9, 3) and len(np.unique(lights, axis=0)) == 9
    assert np.all(lights[:, 2] == RIG.screen_height)
    assert np.abs(lights[:, :2]).max() == RIG.sample_size / 2


def test_relighting_does_not_depend_on_units():
    maps = constant_maps(8, 8, roughness=0.3)
    sizes = {k: 1000 * getattr(RIG, k) for k in
             ("screen_size", "screen_height", "camera_offset", "ball_radius")}  # fmt: skip
    np.testing.assert_allclose(rerender(maps, RIG), rerender(maps, Rig(**sizes)), atol=1e-5)


def test_closed_forms():
    found = metrics.image_metrics(np.full((16, 16, 3), 0.6), np.full((16, 16, 3), 0.5))
    assert found["rmse"] == pytest.approx(0.1)
    assert found["psnr"] == pytest.approx(20)
    assert found["ssim"] == pytest.approx((2 * 0.3 + 1e-4) / (0.61 + 1e-4), abs=1e-6)
    same = metrics.image_metrics(NOISE, NOISE)
    assert (same["rmse"], same["psnr"], same["ssim"]) == (0, None, pytest.approx(1))
    linear = metrics.image_metrics(1.1 * NOISE, NOISE, hdr=True)
    assert linear["relative"] == pytest.approx(0.1 * np.sqrt(np.mean(NOISE**2)) / NOISE.mean())


def test_maps_and_their_relit_images():
    a, b = constant_maps(16, 16, diffuse=0.5), constant_maps(16, 16, diffuse=0.6)
    found = metrics.map_metrics(a, b)
    assert found["maps"]["diffuse"] == pytest.approx(0.1)
    difference = rerender(a).astype(float) - rerender(b)
    assert found["rerender"]["rmse"] == pytest.approx(np.sqrt(np.mean(difference**2)))
    with pytest.raises(InputError, match="16 × 16"):
        metrics.map_metrics(a, constant_maps(8, 8))


def test_what_would_end_the_process_is_refused_before():
    with pytest.raises(InputError, match="differ in size"):
        metrics.flip(NOISE, NOISE[1:])
    bad = NOISE.copy()
    bad[0, 0, 0] = np.nan
    for pair in ((bad, NOISE), (NOISE, bad)):
        with pytest.raises(InputError, match="NaN"):
            metrics.flip(*pair, hdr=True)
    with pytest.raises(InputError, match="H, W, 3"):
        metrics.flip(NOISE[..., 0], NOISE[..., 0])


def test_flip():
    flip_evaluator = pytest.importorskip("flip_evaluator", reason="optional: flip-evaluator")
    black = np.zeros_like(NOISE)
    assert metrics.flip(black, black, hdr=True) == 0
    for reference in (black, NOISE):
        assert 0 < metrics.flip(NOISE / 2 + 0.1, reference, hdr=True) <= 1
    assert metrics.flip(NOISE, NOISE) == 0
    # Exposures as the library itself finds them, which it cannot for a black image.
    image = NOISE.astype(np.float32)
    _, mean, used = flip_evaluator.evaluate(image, 0.9 * image, "HDR", applyMagma=False)
    start, stop, count = metrics.flip_exposures(image)
    assert start == pytest.approx(used["startExposure"], abs=1e-3)
    assert stop == pytest.approx(used["stopExposure"], abs=1e-2)
    assert count == used["numExposures"]
    assert metrics.flip(0.9 * image, image, hdr=True) == pytest.approx(mean, abs=1e-3)


def test_compare(tmp_path, capsys):
    for name, diffuse in (("a", 0.5), ("b", 0.6)):
        (tmp_path / name).mkdir()
        write_maps(tmp_path / name, constant_maps(32, 32, diffuse=diffuse))
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["maps"]["diffuse"] == pytest.approx(0.1, abs=1e-6)
    assert found["rerender"]["rmse"] > 0
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "a")]) == 0
    assert "average  0.0000" in capsys.readouterr().out
    truth, rig = compare_cli._maps(EXAMPLE)  # of a capture, its ground truth
    assert truth.shape == read_maps(EXAMPLE / "truth").shape and rig is not None
    same, rig = compare_cli._maps(EXAMPLE / "truth")  # maps with a rig beside them, as results are
    assert np.array_equal(same.diffuse, truth.diffuse) and rig is not None


def test_compare_images(tmp_path, capsys):
    write_png(tmp_path / "a.png", np.full((32, 32, 3), 0.4), linear=True)
    write_png(tmp_path / "b.png", np.full((32, 32, 3), 0.6), linear=True)
    write_exr(tmp_path / "c.exr", NOISE)
    a, b, c = (str(tmp_path / n) for n in ("a.png", "b.png", "c.exr"))
    assert main(["compare", a, b, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["image"]["rmse"] == pytest.approx(0.2, abs=1e-6)
    for pair, words in (((a, c), "differ in size"), ((a, str(tmp_path)), "not one of each"),
                        ((a, str(tmp_path / "none")), "exist")):  # fmt: skip
        assert main(["compare", *pair]) == 2
        assert words in " ".join(capsys.readouterr().err.split())


def test_missing_extra_is_told(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    write_exr(tmp_path / "c.exr", NOISE)
    assert main(["compare", *[str(tmp_path / "c.exr")] * 2, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["image"]["flip"] is None and "flip-evaluator" in found["notes"][0]


def test_large_maps_are_relit_at_the_size_of_comparison(monkeypatch):
    """Stripes of one pixel become their mean."""
    monkeypatch.setattr(metrics, "RERENDER", 8)
    stripes, grey = (constant_maps(16, 16, diffuse=0.4, specular=0.0) for _ in range(2))
    stripes.diffuse[:, ::2], stripes.diffuse[:, 1::2] = 0.3, 0.5
    full = np.sqrt(np.mean((rerender(stripes) - rerender(grey)).astype(float) ** 2))
    assert metrics.map_metrics(stripes, grey)["rerender"]["rmse"] < 0.1 * full
