"""Set-ups as people build them: what is drawn, what the camera does, and that the truth is true."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.tables import filled
from invrender.cli.main import main
from invrender.data.environments import procedural_environment
from invrender.data.materials import procedural_material
from invrender.data.simulate import simulate_real
from invrender.data.simulate_camera import (
    HALF_WIDTH,
    READ_NOISE,
    Camera,
    developed,
    seen,
    to_jpeg,
    toned,
)
from invrender.data.simulate_setup import RANGES, draw_setup, hides
from invrender.files.images import read_image, read_photo
from invrender.files.maps import read_maps
from invrender.files.rig_toml import read_rig
from invrender.lights import Lights
from invrender.maps import constant_maps
from invrender.pattern.default import default_pattern
from invrender.render.fast.estimator import Fast
from invrender.render.height import displaced
from invrender.sphere import scale_environment
from invrender.types import InputError


def test_the_docs_show_these_ranges():
    page = Path(__file__).parents[3] / "docs" / "reference-simulate.md"
    assert filled(page.read_text("utf-8")) == page.read_text("utf-8")


def within(value, name):
    r = RANGES[name]
    return np.all((np.asarray(value) >= r.low - 1e-9) & (np.asarray(value) <= r.high + 1e-9))


def test_draws_lie_in_their_ranges_and_fill_them():
    setups = [draw_setup(seed, "jpeg") for seed in range(60)]
    for s in setups:
        assert within(s.device.falloff, "falloff") and within(s.device.black, "black")
        mixed = 1 - np.diag(s.device.mixing)
        assert within(mixed, "mixing") and np.allclose(np.sum(s.device.mixing, 1), 1)
        assert within(s.rig.screen_tilt, "screen_tilt") and within(
            s.camera.distortion, "distortion"
        )
        assert within(HALF_WIDTH / np.tan(np.radians(s.rig.fov) / 2), "focal")
        assert not hides(s.rig), "the display is in the way"
        seen_at = s.rig.project(s.rig.sample_corners, 3, 4)
        assert np.all((seen_at > 0) & (seen_at < [4, 3])), "a corner is out of view"
    falloff = [s.device.falloff for s in setups]
    assert min(falloff) < 0.4 and max(falloff) > 1.5
    assert {s.rig.ball_shape for s in setups} == {"sphere", "hemisphere"}
    assert {s.exposures for s in setups} == {("sample",), ("middle",)}
    assert draw_setup(3, "jpeg") == setups[3] != setups[4]


def test_an_option_leaves_the_rest_as_it_is():
    plain, high = draw_setup(5), draw_setup(5, "bracket", exposures=3, camera_height=0.3)
    assert high.device == plain.device and high.gain == plain.gain
    assert high.rig.camera_height == 0.3
    assert within(HALF_WIDTH / np.tan(np.radians(high.rig.fov) / 2), "focal")
    assert high.exposures == ("sample", "middle", "screen")
    assert high.rig_of(0) == high.rig and high.rig_of(1) != high.rig
    assert draw_setup(5, sphere=True).rig.ball_shape == "sphere"
    for height in (0.05, 3.0):
        with pytest.raises(InputError, match="lens"):
            draw_setup(5, camera_height=height)


@pytest.mark.parametrize("distortion", [-0.03, 0.02])
def test_a_corner_is_displaced_by_the_distortion(distortion):
    """A dot whose image without a lens is near the corner appears further out or in by r³."""
    camera = Camera(distortion=distortion)
    height, width = 240, 320
    big = np.zeros((int(height * camera.wider), int(width * camera.wider), 3), np.float32)
    middle = (np.array(big.shape[:2]) - 1) / 2
    dot = np.rint(middle + np.array([80, 100])).astype(int)
    big[tuple(dot)] = 100
    r = np.hypot(*(dot - middle))
    weight = seen(camera, big, height, width)[..., 0]
    at = [
        np.average(np.arange(n), weights=weight.sum(1 - k)) for k, n in enumerate((height, width))
    ]
    found = np.hypot(*(np.array(at) - [(height - 1) / 2, (width - 1) / 2]))
    assert found / r - 1 == pytest.approx(distortion * (r / 200) ** 2, abs=2e-3)


def test_vignetting_noise_and_tone_curve():
    white = np.ones((240, 320, 3), np.float32)
    dim = seen(Camera(vignetting=0.4), white, 240, 320)
    assert dim[0, 0, 0] == pytest.approx(0.6, abs=0.01) and dim[120, 160, 0] > 0.999
    camera = Camera(electrons=2000.0)
    values = developed(camera, white, 0.5, np.random.default_rng(0))
    assert values.mean() == pytest.approx(0.5, abs=1e-3)
    expected = np.sqrt(0.5 / 2000 + (READ_NOISE / 2000) ** 2)
    assert values.std() == pytest.approx(expected, rel=0.02)
    curve = toned(Camera(shoulder=1.5, contrast=0.3), np.linspace(0, 1, 256, dtype=np.float32))
    assert curve[0] == 0 and curve[-1] == pytest.approx(1) and np.all(np.diff(curve) > 0)


@pytest.mark.parametrize("p3", [False, True])
def test_a_jpeg_reads_back_as_the_light_that_it_is_of(tmp_path, p3):
    rng = np.random.default_rng(1)
    blocks = np.kron(rng.uniform(0.1, 0.9, (6, 8, 3)), np.ones((16, 16, 1))).astype(np.float32)
    path = tmp_path / "photo.jpg"
    path.write_bytes(to_jpeg(Camera(display_p3=p3, quality=100), blocks, 67.3, 1.0))
    photo = read_photo(path).in_rec709()
    assert np.abs(photo.image - blocks).mean() < 4e-3
    assert photo.fov == pytest.approx(67.3, abs=0.5)


def test_the_truth_makes_the_photo(tmp_path):
    """The forward model under the lights that truth/ tells shows the sample as the photo does, but
    for what table and ball throw back at it and the path tracer's noise."""
    setup = replace(draw_setup(2, "raw", sphere=True), camera=Camera())
    maps = constant_maps(16, 16, 0.4, 0.04, 0.4)
    room = scale_environment(procedural_environment(4, 64), 0.5)
    simulate_real(tmp_path / "c", maps, room, default_pattern(64), setup, width=320, spp=64)
    truth = tmp_path / "c" / "truth"
    told = json.loads((truth / "setup.json").read_text())
    rig = read_rig(truth / "rig.toml")
    assert (rig.rig, rig.device) == (setup.rig, setup.device)
    assert not {"ball_reflectance", "ball_shape"} - read_rig(tmp_path / "c" / "rig.toml").unknown
    lights = Lights(
        rig.rig, default_pattern(64), read_image(truth / "environment.exr"), told["gain"],
        device=rig.device,
    )  # fmt: skip
    expected = Fast.under(lights).render(constant_maps(24, 24, 0.4, 0.04, 0.4), 256)
    photo = read_image(tmp_path / "c" / "photo.exr")
    pixels = rig.rig.project(rig.rig.sample_points(24, 24), *photo.shape[:2]).astype(int)
    found = photo[pixels[..., 1], pixels[..., 0]]
    ratio = found[2:-2, 2:-2].mean((0, 1)) / expected[2:-2, 2:-2].mean((0, 1))
    assert np.all((ratio > 0.98) & (ratio < 1.05)), ratio
    rows = [x[2:-2].mean((1, 2)) for x in (found, expected)]
    assert np.corrcoef(*rows)[0, 1] > 0.95
    plain = Fast.under(replace(lights, device=type(rig.device)())).render(
        constant_maps(24, 24, 0.4, 0.04, 0.4), 64
    )
    assert plain.mean() > 1.06 * expected.mean(), "the device must matter here"


def test_the_command_writes_a_bracket(tmp_path, capsys):
    out = tmp_path / "b"
    command = ["simulate", "-o", str(out), "--kind", "plastic", "--size", "16", "--width", "96"]
    assert main([*command, "--spp", "2", "--device", "real", "--exposures", "2", "--sheet"]) == 0
    names = {p.name for p in out.iterdir()}
    assert names == {"photo_1.jpg", "photo_2.jpg", "pattern.exr", "rig.toml", "truth"}
    bright, dark = (read_photo(out / f"photo_{k}.jpg").image.mean() for k in (1, 2))
    assert bright > 1.2 * dark
    assert main([*command, "--sheet"]) == 2
    assert "belong to --device real" in capsys.readouterr().err


@pytest.mark.parametrize("device", ["ideal", "real"])
def test_a_displaced_sample_has_a_surfaces_normals(tmp_path, device):
    out = tmp_path / "b"
    command = ["simulate", "-o", str(out), "--kind", "bricks", "--size", "32", "--width", "96"]
    assert main([*command, "--spp", "2", "--device", device, "--displaced"]) == 0
    drawn = procedural_material(0, 32, 32, kind="bricks")
    of_surface = displaced(drawn, 0.09)[1].normal
    assert np.abs(of_surface - drawn.normal).mean() > 0.01
    np.testing.assert_allclose(read_maps(out / "truth").normal, of_surface, atol=2e-3)
