"""The main job where parts of a capture are missing or known: dark room, no ball, two photos."""

import json

import numpy as np
import pytest
import synthetic_photo
from synthetic_photo import blocks, grey_table, photograph

import invrender
from invrender.cli.main import main
from invrender.files.maps import write_maps
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.maps import constant_maps
from invrender.pipeline import refine_capture
from invrender.render import Fast, make_scene
from invrender.rig import Rig

RIG, SIZE, GAIN = Rig(), 24, (2.0, 2.1, 1.9)


def capture(folder, truth, *, ball=(0.0, 0.0), sky=None, pattern=None):
    """Write a capture of ``truth``; a dark room without ``sky``, a ball unless it is None."""
    pattern = blocks() if pattern is None else pattern
    room = None if sky is None else sky(directions(32))
    sample = Fast(make_scene(RIG, pattern, room, GAIN)).render(truth)

    def table(point):
        x, y = (point[..., i] / RIG.sample_size + 0.5 for i in (0, 1))
        inside = (x >= 0) & (x < 1) & (y >= 0) & (y < 1)
        out = 0.3 * grey_table(point)
        n = len(sample)
        out[inside] = sample[((1 - y[inside]) * n).astype(int), (x[inside] * n).astype(int)]
        return out

    dark = lambda d: np.zeros((*d.shape[:-1], 3))  # noqa: E731
    photo = photograph(RIG, 480, 640, sky or dark, table, pattern, GAIN, ball)
    (folder / "truth").mkdir(parents=True)
    write_exr(folder / "photo.exr", photo)
    write_exr(folder / "pattern.exr", pattern.astype(np.float32))
    write_maps(folder / "truth", truth)
    write_rig(folder / "rig.toml", RIG, "pattern.exr", "truth/")
    return folder


def directions(height):
    """Unit directions (H, 2H, 3) of an equirectangular image's texels."""
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(2 * height) + 0.5) / height * np.pi
    t, p = theta[:, None], phi[None, :]
    z = np.broadcast_to(np.cos(t), (height, 2 * height))
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), z], -1)


@pytest.fixture(scope="module")
def truth():
    maps = constant_maps(SIZE, SIZE, (0.5, 0.3, 0.2), 0.04, 0.42)
    maps.diffuse[: SIZE // 2] *= 0.5
    return maps


def test_dark_room_without_ball(tmp_path, truth):
    folder = capture(tmp_path / "dark", truth, ball=None)
    arguments = ["--environment", "none", "--gain", "2,2.1,1.9", "--init", "flat", "-q"]
    out = tmp_path / "out"
    assert main(["refine", str(folder), "-o", str(out), "--size", str(SIZE), *arguments]) == 0
    assert (out / "roughness.exr").is_file() and (out / "report.html").is_file()
    dark = np.zeros((8, 16, 3), np.float32)
    found = invrender.find_lights(invrender.load_capture(folder), environment=dark, gain=GAIN)
    result = invrender.reconstruct(found, size=SIZE, init="flat")
    assert found.ball is None
    assert np.abs(result.maps.diffuse - truth.diffuse).mean() < 0.03


def test_dark_room_with_ball(tmp_path, truth):
    folder = capture(tmp_path / "dark", truth)
    report = refine_capture(folder, tmp_path / "out", size=SIZE, init="flat")
    assert report.map_error["refined"]["average"] < 0.06
    assert report.photo_error["refined"] < 0.1


def test_known_room_without_ball(tmp_path, truth):
    sky = lambda d: 0.5 * synthetic_photo.sky(d)  # noqa: E731
    folder = capture(tmp_path / "lit", truth, ball=None, sky=sky)
    room = np.asarray(sky(directions(32)), np.float32)
    known = {"environment": room, "gain": GAIN, "size": SIZE, "init": "flat"}
    report = refine_capture(folder, tmp_path / "known", **known)
    assert report.map_error["refined"]["average"] < 0.06
    # The light matters: in a room thought dark the albedo comes out too high.
    known["environment"] = np.zeros_like(room)
    wrong = refine_capture(folder, tmp_path / "wrong", **known)
    assert wrong.map_error["refined"]["diffuse"] > 2 * report.map_error["refined"]["diffuse"]


def test_two_captures_are_solved_jointly(tmp_path, truth):
    a = capture(tmp_path / "a", truth, ball=None)
    b = capture(tmp_path / "b", truth, ball=None, pattern=blocks(seed=6))
    out = tmp_path / "out"
    known = ["--environment", "none", "--gain", "2,2.1,1.9", "--init", "flat", "-q"]
    command = ["refine", str(a), str(b), "--joint", "-o", str(out), "--size", str(SIZE), *known]
    assert main(command) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["capture"] == "a + b"
    assert report["map_error"]["refined"]["average"] < 0.06


@pytest.mark.parametrize("gain", ["0", "1,2", "-1,1,1", "a", "inf"])
def test_bad_gain_is_refused(tmp_path, gain):
    with pytest.raises(SystemExit) as stop:
        main(["refine", "example", "-o", str(tmp_path / "out"), f"--gain={gain}"])
    assert stop.value.code == 2


def test_missing_environment_is_refused(tmp_path):
    out = tmp_path / "out"
    assert main(["refine", "example", "-o", str(out), "--environment", "no.exr"]) == 2
    assert not out.exists()
