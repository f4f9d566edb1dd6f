"""Several photos of one sample: how each saw it turned, and the lights of all in one frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from invrender.maps import Maps, map_errors, turn_maps
from invrender.rig import Array, Rig
from invrender.sphere import rotate_environment

CLEARLY = 0.9  # how much nearer the turned maps must be


def find_turn(maps: Maps, first: Maps) -> int:
    """Quarters, counter-clockwise, by which the sample lies turned against the first photo's.

    maps, first: what either photo alone gave, in its own frame. A sample that looks the same from
    all sides counts as not turned.
    """
    errors = [map_errors(turn_maps(maps, -k), first)["average"] for k in range(4)]
    best = int(np.argmin(errors))
    return best if errors[best] < CLEARLY * errors[0] else 0


def turned_rig(rig: Rig, quarters: int) -> Rig:
    """Screen and camera turned about the sample's normal, counter-clockwise.

    It is for the forward model alone: the ball stays, and photos are not taken along.
    """
    return rig.turned(Rotation.from_rotvec([0, 0, 90 * quarters], degrees=True), np.zeros(3))


def turned_environment(environment: Array, quarters: int) -> Array:
    """The surroundings turned about the zenith, counter-clockwise; (H, 2H, 3)."""
    return rotate_environment(environment, quarters % 4 * np.pi / 2)
