"""Bad photos among several of a sample: left out and named, or one sentence. (One without a ball:
`test_which_pattern.py`.)"""

import numpy as np
import pytest
from synthetic_photo import grey_table, photograph, sky

from invrender.capture.photos import find_every_light, read_captures
from invrender.cli.main import main
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.pattern.sets import pattern_set
from invrender.rig import Rig

RIG, SIZE = Rig(), (540, 720)
SET = pattern_set(3, 32)
OTHER = np.random.default_rng(0).uniform(0.02, 1, (4, 4, 3)).repeat(8, 0).repeat(8, 1)


def write_set(folder, shown):
    """A set's folder, with a photo of each pattern."""
    folder.mkdir()
    write_rig(folder / "rig.toml", RIG)
    for k, pattern in enumerate(SET, 1):
        write_exr(folder / f"pattern_{k}.exr", pattern)
    for k, pattern in enumerate(shown, 1):
        image = photograph(RIG, *SIZE, sky, grey_table, pattern)
        write_exr(folder / f"photo_{k}.exr", np.asarray(image, np.float32))
    return folder


def test_bad_photos_are_left_out_and_named(tmp_path):
    folder = write_set(tmp_path / "set", [OTHER, SET[1], SET[1]])
    found = find_every_light(read_captures(folder), {})
    assert len(found) == 1 and np.array_equal(found[0].capture.pattern, SET[1])
    told = [n.text for n in found[0].notices if n.code == "photo-left-out"]
    assert len(told) == 2
    for k, why in ((1, "none of the set's patterns"), (3, "same photo as set/photo_2")):
        assert any(f"photo_{k} was left out" in text and why in text for text in told)


def test_none_that_is_left_ends_in_a_sentence(tmp_path, capsys):
    folder = write_set(tmp_path / "set", [OTHER] * 2)
    assert main(["refine", str(folder), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.strip()
    assert "none of the set's patterns" in said and said.count("\n") <= 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("folders", [1, 2, 40])
def test_forty_photos_are_too_many(folders, tmp_path, capsys):
    """In one folder, as two sets, or as forty captures."""
    names = [str(tmp_path / f"set_{k}") for k in range(folders)]
    for k in range(folders):
        folder = write_set(tmp_path / f"set_{k}", [])
        for i in range(40 // folders):
            write_exr(folder / f"photo_{i}.exr", np.full((64, 80, 3), 0.1))
    assert main(["refine", *names, "--joint", "--out", str(tmp_path / "out")]) == 2
    assert "40 photos, and at most 20" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
