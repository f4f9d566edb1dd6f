"""What the refinement's benchmark draws and measures."""

import numpy as np
import pytest

from benchmarks import refine
from benchmarks.common.captures import OTHERS, PHOTOGRAPHS, CaptureSet
from invrender.maps import constant_maps
from invrender.pattern.default import default_pattern
from invrender.render import Fast
from invrender.render.scene import make_scene
from invrender.rig import Rig
from nets.training.draw import held_out


def test_sets_share_no_material_room_seed_or_noise(tmp_path):
    names = {s: held_out(s.split) for s in (PHOTOGRAPHS, OTHERS)}
    assert not names[PHOTOGRAPHS] & names[OTHERS]
    for name in ("seen", *held_out("holdout"), *held_out("families")):
        (tmp_path / name).mkdir()
        for kind in ("basecolor", "normal"):
            (tmp_path / name / f"{kind}.png").touch()
    trained = CaptureSet("train", 0)
    chosen = {s: {p.name for p in s.choose(tmp_path, None)[0]} for s in (*names, trained)}
    assert chosen[PHOTOGRAPHS] and chosen[PHOTOGRAPHS] <= names[PHOTOGRAPHS]
    assert chosen[OTHERS] and chosen[OTHERS] <= names[OTHERS]
    assert chosen[trained] == {"seen"}
    assert abs(PHOTOGRAPHS.first_seed - OTHERS.first_seed) > 10_000
    assert {PHOTOGRAPHS.noise_of(k) for k in range(24)} == {0.005}
    noises = [OTHERS.noise_of(k) for k in range(200)]
    assert min(noises) > 0.002 and max(noises) < 0.02
    assert np.median(noises) == pytest.approx(np.sqrt(0.002 * 0.02), rel=0.3)


def test_correlation_is_pearsons_in_size():
    x = np.linspace(0, 1, 64).reshape(8, 8, 1)
    a, noise = np.repeat(x, 3, 2), np.random.default_rng(0).normal(size=(8, 8, 3))
    assert refine.correlation(a, 3 - 2 * a) == pytest.approx(1)
    assert refine.correlation(a, np.full_like(a, 0.5)) == 0
    expected = np.mean([abs(np.corrcoef(x.ravel(), noise[..., c].ravel())[0, 1]) for c in range(3)])
    assert refine.correlation(a, noise) == pytest.approx(expected)


def test_pattern_that_stands_in_the_albedo_is_seen():
    renderer = Fast(make_scene(Rig(), default_pattern(64), None, 2.0))
    truth = constant_maps(24, 24, 0.3, 0.04, 0.15)
    lobe = renderer.render(constant_maps(24, 24, 0.0, 0.5, 0.15), 64)
    baked = constant_maps(24, 24, 0.3, 0.04, 0.15)
    baked.diffuse[:] = 0.2 + 0.2 * lobe / lobe.max()
    found, true = refine.pattern_in_albedo(baked, truth, renderer)
    assert true == 0 and found > 0.9
    rough = constant_maps(24, 24, 0.3, 0.04, 0.8)
    assert refine.pattern_in_albedo(baked, rough, renderer) is None


def test_flat_samples_and_their_noise():
    maps = constant_maps(8, 8, 0.3, 0.04, 0.5)
    maps.diffuse[:4] = 0.6  # a print is still flat and homogeneous
    assert refine.is_flat(maps)
    maps.roughness[:4] = 0.7
    assert not refine.is_flat(maps)
    rng = np.random.default_rng(0)
    photo, level, noise = np.full((256, 256, 3), 0.1), 0.9, 0.01
    seen = photo + noise * np.sqrt(photo * level) * rng.standard_normal(photo.shape)
    rms = np.sqrt(np.mean((seen - photo) ** 2)) / photo.mean()
    assert refine.expected_noise(photo, level, noise) == pytest.approx(rms, rel=0.01)


def test_bars_are_of_the_summary():
    row = {
        "capture": "000", "jpeg": False, "seconds_initial": 1.0, "seconds_refined": 3.0,
        "processor_seconds": 3.0, "stages": {"refine": 2.0}, "converged": True,
        "coverage": dict.fromkeys(refine.NAMES, 0.7), "pattern": (0.3, 0.25), "warned": False,
        "photo_initial": 0.2, "photo_refined": 0.05,
    }  # fmt: skip
    for name in (*refine.NAMES, "average", "rerender"):
        row |= {f"{name}_initial": 0.1, f"{name}_refined": 0.05}
    worse = {**row, "average_initial": 0.05, "average_refined": 0.1, "photo_refined": 0.2}
    reached = {b["name"]: b for b in refine.bars("x", refine.summarise([row, row, worse]))}
    assert reached["x: average map RMSE, refined over network"]["value"] == pytest.approx(0.5)
    assert reached["x: share of captures improved"]["value"] == pytest.approx(2 / 3)
    assert reached["x: worst capture, refined over network"]["value"] == pytest.approx(2)
    assert not reached["x: worst capture, refined over network"]["ok"]
    assert reached["x: photo unexplained, worst"]["value"] == 0.2
    above = reached["x: correlation with the light's pattern, above the truth's"]
    assert above["value"] == pytest.approx(0.05) and not above["ok"]
    assert reached["x: seconds after the initial maps, median"]["value"] == 2
    assert not any("noise" in name for name in reached)  # no flat sample was among them
