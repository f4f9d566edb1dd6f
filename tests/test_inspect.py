"""`invrender inspect`: what is found in a capture, a lone photo, and what is refused."""

import json

import numpy as np
import pytest
from PIL import Image
from synthetic_photo import blocks, photograph

from invrender.capture import SATURATED, Lights, light_warnings
from invrender.cli import main
from invrender.images import write_exr
from invrender.pattern import default_pattern
from invrender.rig import Rig, write_rig

RIG = Rig()
SIZE = (720, 960)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("capture")
    pattern = blocks()
    write_exr(path / "photo.exr", photograph(RIG, *SIZE, pattern=pattern, gain=(2.0, 1.5, 1.0)))
    write_exr(path / "pattern.exr", pattern)
    write_rig(path / "rig.toml", RIG, "pattern.exr")
    return path


def test_inspect_tells_the_truth_and_draws_it(folder, tmp_path, capsys):
    assert main(["inspect", str(folder), "-o", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ball_confidence"] > 0.7 and not found["warnings"]
    np.testing.assert_allclose(found["gain"], [2.0, 1.5, 1.0], rtol=0.03)
    assert 0.5 < found["coverage"] < 0.95
    with Image.open(tmp_path / "out" / "inspect.png") as picture:
        assert picture.size == (SIZE[1], SIZE[0])
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"inspect.png", "environment.exr", "coverage.exr", "pattern.exr"}


def test_inspect_takes_a_lone_photo(tmp_path, capsys):
    path = tmp_path / "photo.exr"
    write_exr(path, photograph(RIG, *SIZE, pattern=default_pattern(64)))
    assert main(["inspect", str(path), "--ball", "480,360,39.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ball_confidence"] == 1


@pytest.mark.parametrize(
    ("arguments", "match"),
    [(["--ball", "5,5,40"], "not whole inside"), (["-o", "rig.toml"], "is a file")],
)
def test_inspect_refuses(folder, arguments, match, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    assert main(["inspect", str(folder), *arguments]) == 2
    assert match in " ".join(capsys.readouterr().err.split())


def test_a_ball_without_the_pattern_is_refused(folder, tmp_path, capsys):
    """Another pattern than the one shown, or something that is no ball."""
    for name in ("photo.exr", "rig.toml"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    write_exr(tmp_path / "pattern.exr", blocks(seed=9))
    assert main(["inspect", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "does not show the pattern" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_saturated_lights_are_told():
    lights = Lights(
        *(np.zeros((1, 1)),) * 3, np.ones(3), np.zeros((1, 1)), RIG,
        {"saturated": 2 * SATURATED, "room_saturated": 0.02, "pattern_residual": 0.5},
    )  # fmt: skip
    text = " ".join(light_warnings(lights))
    assert "2% of the screen" in text and "2.0% of the room" in text and "this pattern" in text
    assert not light_warnings(Lights(*(np.zeros((1, 1)),) * 3, np.ones(3), np.zeros(1), RIG))
