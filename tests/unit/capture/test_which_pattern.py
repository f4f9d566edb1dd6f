"""Which pattern of a set a photo shows."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_photo import grey_table, photograph, sky

from invrender.capture.which_pattern import find_pattern
from invrender.files.capture import Capture
from invrender.files.images import Photo
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


def test_another_pattern_is_refused():
    other = np.random.default_rng(0).uniform(0.02, 1, (4, 4, 3)).repeat(16, 0).repeat(16, 1)
    with pytest.raises(InputError, match="none of the set"):
        find_pattern(capture_of(other), SET)


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
