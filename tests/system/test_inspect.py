"""`invrender inspect`: what is found in a capture, a lone photo, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from synthetic_photo import blocks, photograph

from invrender.capture.lights import light_warnings
from invrender.capture.orientation import oriented
from invrender.capture.settings import SCREEN_FIT
from invrender.cli.main import main
from invrender.colour import linear_to_srgb
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.lights import Lights
from invrender.pattern.default import default_pattern
from invrender.rig import Rig

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
    advice = [said["code"] for said in found["advice"]]
    assert advice == ["go-closer", "larger-ball", "darken-room", "use-sheet"]
    assert found["sheet"] is None and 0 < found["deviations"]["fov"] < 1
    with Image.open(tmp_path / "out" / "inspect.png") as picture:
        assert picture.size == (SIZE[1], SIZE[0])
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"inspect.png", "environment.exr", "coverage.exr", "pattern_captured.exr"}


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
    capture = tmp_path / "capture"
    capture.mkdir()
    for name in ("photo.exr", "rig.toml"):
        (capture / name).write_bytes((folder / name).read_bytes())
    write_exr(capture / "pattern.exr", blocks(seed=9))
    assert main(["inspect", str(capture), "-o", str(tmp_path / "out")]) == 2
    assert "does not show the pattern" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_saturated_lights_are_told():
    fit = {"saturated": 2 * SCREEN_FIT.saturated, "room_saturated": 0.02, "pattern_residual": 0.5}
    lights = Lights(RIG, np.ones((1, 1, 3)), fit=fit)
    notices = light_warnings(lights)
    assert [n.code for n in notices] == ["screen-saturated", "room-saturated", "pattern-fits-badly"]
    text = " ".join(n.text for n in notices)
    assert "2% of the screen" in text and "2.0% of the room" in text and "this pattern" in text
    assert not light_warnings(replace(lights, fit={}))


# --- photos that are not as they should be ------------------------------------------------------


def inspected(capsys, *arguments):
    """Numbers that inspect prints, or the one sentence that it refuses with."""
    code = main(["inspect", *map(str, arguments), "--json"])
    out, err = capsys.readouterr()
    assert code in (0, 2)
    return json.loads(out) if code == 0 else " ".join(err.split())


@pytest.fixture(scope="module")
def image():
    return photograph(RIG, *SIZE, pattern=default_pattern(64))


@pytest.mark.parametrize("quarter", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_a_turned_photo_is_set_upright(image, quarter, tmp_path, capsys):
    """As EXIF leaves it of a phone that looks straight down: which side is up is arbitrary."""
    write_exr(tmp_path / "a.exr", np.rot90(image, -quarter))
    found = inspected(capsys, tmp_path / "a.exr")
    assert found["photo"] == [SIZE[1], SIZE[0]]
    assert [w["text"] for w in found["warnings"]] == [
        f"the photo was turned by {90 * quarter}° counter-clockwise: the ball shows which side is "
        "up"
    ]
    np.testing.assert_allclose(found["ball_centre"], [480, 360], atol=0.5)
    np.testing.assert_allclose(found["gain"], [2.0, 2.1, 1.9], rtol=0.02)


@pytest.mark.parametrize(("quarter", "flip"), [(2, False), (0, True), (3, True)])
def test_another_orientation_of_the_pattern_is_taken_as_shown(quarter, flip, tmp_path, capsys):
    shown = oriented(default_pattern(64), quarter, flip)
    write_exr(tmp_path / "a.exr", photograph(RIG, *SIZE, pattern=shown))
    found = inspected(capsys, tmp_path / "a.exr")
    assert (
        len(found["warnings"]) == 1 and "display shows the pattern" in found["warnings"][0]["text"]
    )
    assert found["fit"]["residual"] < 0.05
    np.testing.assert_allclose(found["gain"], [2.0, 2.1, 1.9], rtol=0.02)


def test_either_of_two_balls_will_do(image, tmp_path, capsys):
    """Each shows the same lights from where it stands."""
    other = (0.0, -2.6 * RIG.ball_radius)
    second = photograph(RIG, *SIZE, pattern=default_pattern(64), ball=other)
    both = np.where((np.arange(SIZE[0]) < 412)[:, None, None], image, second)
    write_exr(tmp_path / "a.exr", both)
    found = inspected(capsys, tmp_path / "a.exr")
    centres = [RIG.project(RIG.ball_centre + np.array([*s, 0]), *SIZE) for s in ((0, 0), other)]
    distance = [np.hypot(*np.subtract(found["ball_centre"], c)) for c in centres]
    assert min(distance) < 0.01 * found["ball_radius"]
    np.testing.assert_allclose(found["gain"], [2.0, 2.1, 1.9], rtol=0.02)


def test_a_grey_photo_gives_grey_lights_and_alpha_is_dropped(image, tmp_path, capsys):
    data = (linear_to_srgb(image / 2.5) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(np.dstack([data, np.full(SIZE, 7, np.uint8)])).save(tmp_path / "a.png")
    Image.fromarray(data).save(tmp_path / "b.png")
    ball = "--ball=480,360,39.5"  # by hand: what is tested needs no search
    with_alpha, without = (inspected(capsys, tmp_path / f"{k}.png", ball) for k in "ab")
    assert [note["code"] for note in with_alpha.pop("notes")] == ["photo-alpha"]
    assert without.pop("notes") == [] and with_alpha == without
    # A grey photo cannot show the colours of the pattern: it must not pass for a good one.
    Image.fromarray(data).convert("L").save(tmp_path / "c.png")
    grey = inspected(capsys, tmp_path / "c.png", ball)
    assert ("pattern" in grey) if isinstance(grey, str) else grey["warnings"]


@pytest.mark.parametrize("focal", [5, pytest.param(300, marks=pytest.mark.slow)])
def test_a_lying_focal_length_is_named(image, focal, tmp_path, capsys):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = focal
    data = (linear_to_srgb(image / 2.5) * 255 + 0.5).astype(np.uint8)
    Image.fromarray(data).save(tmp_path / "a.jpg", exif=exif, quality=95)
    text = inspected(capsys, tmp_path / "a.jpg")
    assert isinstance(text, str) and "EXIF gives a field of view" in text and "rig.toml" in text


def with_rig(folder, photo):
    """A capture whose rig.toml states lens and ball, so that they are not looked for as well."""
    write_exr(folder / "photo.exr", photo)
    write_exr(folder / "pattern.exr", default_pattern(64))
    write_rig(folder / "rig.toml", RIG, "pattern.exr")
    return folder


def test_a_screen_that_is_off_is_refused(tmp_path, capsys):
    dark = photograph(RIG, *SIZE, gain=(0.0, 0.0, 0.0))
    text = inspected(capsys, with_rig(tmp_path, dark))
    assert isinstance(text, str) and ("screen is dark" in text or "does not show" in text)


def test_a_display_without_the_pattern_is_refused(tmp_path, capsys):
    plain = photograph(RIG, *SIZE, pattern=np.full((64, 64, 3), 0.4))
    text = inspected(capsys, with_rig(tmp_path, plain))
    assert isinstance(text, str) and "pattern" in text


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda a: ndimage.gaussian_filter(a, (2.2, 2.2, 0)), "blurred"),
        (lambda a: a[:, 130:830], "beyond the photo"),
    ],
)
def test_doubtful_photos_are_told(image, change, match, tmp_path, capsys):
    photo = change(image)
    fov = 2 * np.degrees(np.arctan(np.tan(np.radians(RIG.fov / 2)) * photo.shape[1] / SIZE[1]))
    write_exr(tmp_path / "photo.exr", photo)
    write_exr(tmp_path / "pattern.exr", default_pattern(64))
    write_rig(tmp_path / "rig.toml", replace(RIG, fov=float(fov)), "pattern.exr")
    found = inspected(capsys, tmp_path)
    assert any(match in w["text"] for w in found["warnings"])


def test_a_weak_pattern_is_told(tmp_path, capsys):
    dim = photograph(RIG, *SIZE, pattern=default_pattern(64), gain=(0.1, 0.1, 0.1))
    write_exr(tmp_path / "a.exr", dim)
    found = inspected(capsys, tmp_path / "a.exr")
    assert isinstance(found, str) or any("only" in w["text"] for w in found["warnings"])
