"""Several photos of one sample: how each saw it turned."""

from __future__ import annotations

import numpy as np

from invrender.maps import Maps, map_errors, turn_maps

CLEARLY = 0.9  # how much nearer the turned maps must be


def find_turn(maps: Maps, first: Maps) -> int:
    """Quarters, counter-clockwise, by which the sample lies turned against the first photo's.

    maps, first: what either photo alone gave, in its own frame. A sample that looks the same from
    all sides counts as not turned.
    """
    errors = [map_errors(turn_maps(maps, -k), first)["average"] for k in range(4)]
    best = int(np.argmin(errors))
    return best if errors[best] < CLEARLY * errors[0] else 0
