"""Which pattern of a set a photo shows, and which way round it was taken, by the ball."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from invrender.capture.ball import no_ball
from invrender.capture.orientation import (
    find_either_ball,
    is_unlikely,
    likeness,
    posed,
    seen_patterns,
    white_of,
)
from invrender.capture.settings import BALL_SEARCH, ORIENTATION, WHICH_PATTERN
from invrender.files.capture import Capture
from invrender.sampling import resize_pattern
from invrender.types import Array, InputError


def find_pattern(capture: Capture, patterns: Sequence[Array]) -> tuple[Capture, int]:
    """The capture with the pattern of the set that its photo shows, and which of them it is.

    The ball's image of the screen is compared with every pattern, with the photo turned by every
    quarter. Raises `InputError` where there is no ball, and where it shows none of the patterns, or
    two as well as each other.
    """
    here, tilt_deviation = posed(capture)
    here, ball = find_either_ball(here, None, tilt_deviation, BALL_SEARCH.doubtful)
    small = [resize_pattern(p, ORIENTATION.cells) for p in patterns]
    white = white_of(here)
    scores = np.full((4, len(small)), -1.0)
    for turn, seen in seen_patterns(here, ball):
        scores[turn] = [likeness(seen, pattern, white) for pattern in small]
    turn, which = (int(i) for i in np.unravel_index(np.argmax(scores), scores.shape))
    best = scores.max(0)
    if is_unlikely(ball, best[which]):
        raise no_ball(ball)
    (x, y), r = ball.centre, ball.radius
    if best[which] < WHICH_PATTERN.alike:
        raise InputError(
            f"the ball ({x:.0f}, {y:.0f}, radius {r:.0f} pixels) shows none of the set's patterns"
        )
    if len(small) > 1 and np.sort(best)[-2] > best[which] - WHICH_PATTERN.better:
        raise InputError(
            f"the ball ({x:.0f}, {y:.0f}, radius {r:.0f} pixels) shows two of the set's patterns "
            "as well as each other: is the photo sharp?"
        )
    # Photos are turned by `find_lights`, once it knows the pattern.
    return replace(capture, pattern=patterns[which]), which
