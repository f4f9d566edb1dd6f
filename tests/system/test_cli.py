"""The command line: the whole job on the bundled capture, and what bad input gets."""

import json
import subprocess
import sys

import numpy as np
import pytest

from invrender.cli.main import main
from invrender.files.images import read_image
from invrender.files.maps import read_maps
from invrender.files.write import write_exr
from invrender.maps import NAMES


def test_network_starts_nearer(example_result):
    """The network's maps are nearer the truth than a flat sample's and its refinement's."""
    flat, network = (
        json.loads((example_result(init) / "report.json").read_text())["map_error"]
        for init in ("flat", "network")
    )
    assert network["initial"]["average"] < 0.8 * flat["refined"]["average"]
    assert network["refined"]["average"] < 0.8 * flat["refined"]["average"]


def test_result_is_complete(example_result):
    result = example_result("flat")
    names = {f"{n}.{e}" for n in NAMES for e in ("exr", "png")}
    names |= {f"sigma_{n}.exr" for n in NAMES}
    names |= {"environment.exr", "coverage.exr", "pattern_shown.exr", "pattern_captured.exr"}
    names |= {"rig.toml", "sample.exr", "report.json", "report.html"}
    names |= {"photo.png", "render.png", "difference.png"}
    assert {p.name for p in result.iterdir()} == names
    assert read_maps(result).shape == (32, 32)


def test_report_tells_what_was_gained(example_result):
    report = json.loads((example_result("flat") / "report.json").read_text())
    assert report["photo_error"]["refined"] < 0.5 * report["photo_error"]["initial"]
    errors = report["map_error"]
    assert errors["refined"]["average"] < 0.8 * errors["initial"]["average"]
    assert {"lights", "refine", "render"} <= report["seconds"].keys()


def test_module_is_a_command(tmp_path):
    command = [sys.executable, "-m", "invrender.refine", "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0
    assert "mirror ball" in done.stdout


def rig(text):
    def change(folder):
        (folder / "rig.toml").write_text(text)

    return change


def edit(old, new):
    def change(folder):
        path = folder / "rig.toml"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    return change


def photo(f):
    def change(folder):
        import OpenEXR

        image = f(read_image(folder / "photo.exr"))
        with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, {"RGB": image}) as file:
            file.write(str(folder / "photo.exr"))

    return change


def with_nan(image):
    image[5, 5] = np.nan
    return image


def without_ball(image):
    h, w = image.shape[:2]
    r = h // 6
    image[h // 2 - r : h // 2 + r, w // 2 - r : w // 2 + r] = image[10, 10]
    return image


BAD = {
    "no photo": (lambda f: (f / "photo.exr").unlink(), "no photo"),
    "no rig": (lambda f: (f / "rig.toml").unlink(), "rig.toml"),
    "no pattern": (lambda f: (f / "pattern.exr").unlink(), "pattern.exr"),
    "not an image": (lambda f: (f / "photo.exr").write_text("hello"), "readable"),
    "truncated": (
        lambda f: (f / "photo.exr").write_bytes((f / "photo.exr").read_bytes()[:5000]),
        "readable",
    ),
    "NaN": (photo(with_nan), "NaN"),
    "black": (photo(np.zeros_like), "black"),
    "one pixel": (photo(lambda x: x[:1, :1].copy()), "small"),
    "no ball": (photo(lambda x: without_ball(x[::4, ::4].copy())), "ball"),
    "ball cut off": (photo(lambda x: x[: x.shape[0] // 2 : 4, ::4].copy()), ""),
    "negative size": (edit("size = 0.18", "size = -0.18"), "positive"),
    "below the table": (edit("height = 0.153", "height = -0.1"), "above"),
    "unknown key": (edit("size = 0.18", "size = 0.18\ncolour = 3"), "colour"),
    "not TOML": (rig("screen = {"), "TOML"),
    "no size": (edit("size = 0.18", ""), "size"),
    "pattern outside": (edit("pattern.exr", "../pattern.exr"), "folder"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name, capture, tmp_path, capsys):
    change, words = BAD[name]
    change(capture)
    out = tmp_path / "out"
    before = sorted(p.name for p in tmp_path.iterdir())
    assert main(["refine", str(capture), "-o", str(out)]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert message.startswith("invrender: ") and words in message
    assert "Traceback" not in message
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_bad_arguments(capture, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["refine", str(tmp_path / "none"), "-o", str(out)]) == 2
    assert main(["refine", str(capture), "-o", str(out), "--size", "0"]) == 2
    with pytest.raises(SystemExit) as stop:
        main(["refine", str(capture), "-o", str(out), "--ball", "1,2"])
    assert stop.value.code == 2
    assert not out.exists()


@pytest.mark.parametrize(
    "words",
    [
        "refine example --samples 0", "refine example --samples 1.5", "refine example --gain 1e30",
        "refine example --gain nan", "simulate --irradiance nan", "simulate --noise -1",
        "simulate --gain inf", "simulate --seed -1", "simulate --spp 0", "pattern --seed -1",
        "simulate --size 0", "simulate --size 100000000", "simulate --width 63",
    ],
)  # fmt: skip
def test_numbers_out_of_range_are_refused(words, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main([*words.split(), "-o", str(tmp_path / "out")])
    assert stop.value.code == 2 and " from " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_simulate_writes_what_refine_reads(tmp_path, capsys):
    folder = tmp_path / "new"
    command = ["simulate", "-o", str(folder), "--kind", "plastic", "--size", "64"]
    assert main([*command, "--width", "320", "--spp", "4"]) == 0
    assert {p.name for p in folder.iterdir()} == {"photo.exr", "pattern.exr", "rig.toml", "truth"}
    assert read_maps(folder / "truth").shape == (64, 64)
    assert main([*command, "--width", "320", "--spp", "4"]) == 2  # not over what exists
    assert "holds a capture" in capsys.readouterr().err
    assert main(["simulate", "-o", str(tmp_path / "x"), "--kind", "cheese"]) == 2
    assert not (tmp_path / "x").exists()


def test_writing_is_whole_or_nothing(tmp_path):
    path = tmp_path / "a.exr"
    with pytest.raises(ValueError, match="non-finite"):
        write_exr(path, np.full((2, 2), np.nan))
    assert not list(tmp_path.iterdir())


def test_help_names_kinds_that_there_are(capsys):
    """They are written in the help, which does not load the materials."""
    from invrender.data.materials import PRESETS

    with pytest.raises(SystemExit):
        main(["simulate", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    named = text.split("instead, e.g. ")[1].split(" --")[0].split(" or ")
    assert len(named) == 2 and set(named) <= set(PRESETS)
