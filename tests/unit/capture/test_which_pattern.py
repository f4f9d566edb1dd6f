"""Which pattern of a set a photo shows."""

import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_photo import grey_table, photograph, sky

from invrender.capture.orientation import find_ball_and_orientation
from invrender.capture.settings import BALL_SEARCH
from invrender.capture.which_pattern import find_pattern
from invrender.cli.main import main
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.pattern.sets import COUNTS, pattern_set
from invrender.rig import Rig
from invrender.types import InputError

RIG, SIZE = Rig(), (540, 720)
SET = pattern_set(5, 64)


def capture_of(pattern):
    image = photograph(RIG, *SIZE, sky, grey_table, pattern)
    return Capture(Photo(np.asarray(image, np.float32)), RIG, SET[0])


@pytest.mark.parametrize("which", range(5))
def test_each_is_recognised(which):
    shown = capture_of(SET[which])
    # The last photo was taken with the phone the other way round.
    if which == 4:
        shown = replace(shown, photo=Photo(np.ascontiguousarray(shown.photo.image[::-1, ::-1])))
    found, index = find_pattern(shown, SET)
    assert index == which
    assert found.pattern is SET[which]


OTHER = np.random.default_rng(0).uniform(0.02, 1, (4, 4, 3)).repeat(16, 0).repeat(16, 1)


def test_another_pattern_is_refused():
    with pytest.raises(InputError, match="none of the set"):
        find_pattern(capture_of(OTHER), SET)


def test_a_doubtful_ball_is_one_if_it_shows_a_pattern(monkeypatch):
    doubt = replace(BALL_SEARCH, least_confidence=1.0)
    monkeypatch.setattr("invrender.capture.orientation.BALL_SEARCH", doubt)
    assert find_ball_and_orientation(capture_of(SET[0]))[1].confidence < 1
    with pytest.raises(InputError, match="no mirror ball found"):
        find_pattern(capture_of(OTHER), SET)


def test_the_same_pattern_twice_in_a_set_is_refused():
    with pytest.raises(InputError, match="as well as each other"):
        find_pattern(capture_of(SET[0]), [SET[0], SET[1], SET[0]])


def test_sets_begin_each_other_and_give_light_everywhere():
    for count in COUNTS:
        patterns = pattern_set(count, 32)
        assert len(patterns) == count
        for pattern, first in zip(patterns, pattern_set(8, 32), strict=False):
            assert np.array_equal(pattern, first)
            assert pattern.min() > 0 and pattern.max() <= 1
    with pytest.raises(InputError, match="2, 3, 5, 8"):
        pattern_set(4)


def test_inspect_tells_of_each_photo_of_a_set(tmp_path, capsys):
    write_rig(tmp_path / "rig.toml", RIG)
    for k, pattern in enumerate(SET[:2], 1):
        write_exr(tmp_path / f"pattern_{k}.exr", pattern)
    write_exr(tmp_path / "photo_1.exr", capture_of(SET[1]).photo.image)
    empty = photograph(RIG, *SIZE, sky, grey_table, SET[0], ball=None)
    write_exr(tmp_path / "photo_2.exr", np.asarray(empty, np.float32))
    assert main(["inspect", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["photo_1"]["pattern"] == 2 and told["photo_1"]["ball_confidence"] > 0.5
    assert "ball" in told["photo_2"]["left_out"]
