"""The light on a sample: all that the forward model needs besides the maps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from invrender.device import IDEAL, Device
from invrender.rig import Rig
from invrender.sphere import rotate_environment
from invrender.types import Array


@dataclass(frozen=True)
class Lights:
    """The screen's light and the room's, in one unit of radiance (a photo's, where one shows them).

    rig: where screen and camera are. The screen's radiance is ``gain`` (a number or RGB) times
    what ``device`` makes of ``pattern`` (h, w, 3), linear values in [0, 1], row 0 at +y: ``shown``
    straight ahead, less towards the sides. environment: linear RGB radiance (H, 2H, 3), row 0 at
    the zenith; zeros, as by default, for a dark room.

    What `invrender.find_lights` adds of a photo's mirror ball. coverage: (H, 2H), the share of each
    texel of the environment that the ball really shows, the rest is filled in. pattern_captured:
    (P, P, 3), the screen's radiance as the ball shows it. fit: how well all of it fits, by name:
    ``residual`` of the pattern relative to the gain, ``gain_deviation`` the standard deviation of
    the logarithm of the screen's light, ``gamma`` and ``falloff`` the device's, ``blur`` the
    camera's in pixels, ``pixels`` the number used, ``saturated`` and ``room_saturated`` the shares
    of screen and room in the ball that are saturated, ``room_raised`` how many times brighter the
    saturated lamps were made, ``gain_by_table`` by what the ball's gain was multiplied, by the
    table's shading, ``hidden_lamp`` how many times brighter than the filling a part of
    the room behind the screen was made (1: none), ``pattern_residual`` the residual before the
    screen's pose and curve were fitted, ``screen_shift`` (metres) and ``screen_tilt`` (degrees) how
    far the screen is found from its place, ``camera_tilt`` how far the camera is found to look past
    straight down, in degrees,
    ``ball_reflectance`` the mirror's and ``ball_reflectance_deviation`` the standard deviation of
    its logarithm (0: it was stated), with which all radiance here scales.

        lights = Lights(Rig(), default_pattern(), gain=2.0)
    """

    rig: Rig
    pattern: Array
    environment: Array = field(default_factory=lambda: np.zeros((8, 16, 3), np.float32))
    gain: Any = 1.0
    coverage: Array | None = None
    pattern_captured: Array | None = None
    fit: dict[str, float] = field(default_factory=dict)
    device: Device = IDEAL

    @property
    def shown(self) -> Array:
        """Relative radiance (h, w, 3) straight ahead of the screen: the pattern as displayed."""
        return self.device.shown(self.pattern)

    def scaled(self, screen: Array, room: Array) -> Lights:
        """With the screen's and the room's radiance times RGB factors."""
        gain = np.broadcast_to(np.asarray(self.gain, np.float32), 3) * screen
        return replace(self, gain=gain, environment=self.environment * room)

    def placed(self, place: Array) -> Lights:
        """Seen from a sample that lies elsewhere: where the homography ``place`` (3, 3) takes the
        square of the sample, [-1, 1]², x right and y up; its shift and its turn count. For the
        forward model alone: the ball stays, and so does ``coverage``."""
        angle = float(np.arctan2(place[1, 0], place[0, 0]))
        turn = Rotation.from_rotvec([0, 0, -angle])
        half = self.rig.sample_size / 2
        by = turn.apply([*(-half * place[:2, 2] / place[2, 2]), 0.0])
        rig = self.rig.turned(turn, np.zeros(3))
        rig = replace(
            rig,
            screen_shift=tuple(np.add(rig.screen_shift, by).tolist()),
            camera_shift=tuple(np.add(rig.camera_shift, by).tolist()),
        )
        room = rotate_environment(self.environment, -angle % (2 * np.pi)) if angle else None
        return replace(self, rig=rig, environment=self.environment if room is None else room)
