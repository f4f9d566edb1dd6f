"""A folder of photos under a set of patterns."""

import numpy as np
import pytest

from invrender.files.capture import load_capture, load_set
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.lights import Device
from invrender.rig import Rig
from invrender.types import InputError

GAMMA = (2.0, 2.0, 2.0)


@pytest.fixture
def folder(tmp_path):
    write_rig(tmp_path / "rig.toml", Rig(), device=Device(falloff=0.5, gamma=GAMMA))
    for i in (1, 2):
        write_exr(tmp_path / f"pattern_{i}.exr", np.full((4, 4, 3), 0.25 * i))
        write_exr(tmp_path / f"photo_{i}.exr", np.full((64, 80, 3), 0.1 * i))
    return tmp_path


def test_a_sets_patterns_are_shown_by_the_display_that_is_told(folder):
    captures, patterns = load_set(folder)
    assert [c.name for c in captures] == [f"{folder.name}/photo_{i}" for i in (1, 2)]
    for i, pattern in enumerate(patterns, 1):
        np.testing.assert_allclose(pattern, (0.25 * i) ** 2, rtol=1e-5)
    for i, capture in enumerate(captures, 1):
        assert capture.pattern is patterns[0]  # until it is found out
        assert capture.device == Device(falloff=0.5) and capture.truth is None
        assert capture.photo.image.mean() == pytest.approx(0.1 * i)


@pytest.mark.parametrize(("value", "match"), [(2.0, r"in \[0, 1\]"), (0.0, "all black")])
def test_a_pattern_of_a_set_that_is_none_is_refused(folder, value, match):
    write_exr(folder / "pattern_2.exr", np.full((4, 4, 3), value))
    with pytest.raises(InputError, match=match):
        load_set(folder)


def test_photos_without_a_screen_have_each_their_own_light(folder):
    rig = Rig(screen_size=None, sample_side=0.09, camera_height=0.15, screen_height=0.15)
    write_rig(folder / "rig.toml", rig)
    for i in (1, 2):
        (folder / f"pattern_{i}.exr").unlink()
    captures, patterns = load_set(folder)
    assert len(captures) == 2 and patterns == []
    assert all(c.rig == rig and not c.pattern.any() for c in captures)
    with pytest.raises(InputError, match="each under its own light"):
        load_capture(folder)
    write_exr(folder / "pattern.exr", np.ones((4, 4, 3)))
    with pytest.raises(InputError, match=r"rig.toml no \[screen\]"):
        load_set(folder)


def test_too_many_photos_are_refused_before_they_are_read(folder):
    for i in range(3, 42):
        (folder / f"photo_{i}.exr").write_bytes(b"not read")
    with pytest.raises(InputError, match="41 photos, and at most 20"):
        load_set(folder)
