"""The light on a sample: the display as physics, and the room."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from invrender.rig import Rig
from invrender.sphere import rotate_environment
from invrender.types import Array, InputError, Vec3

Mixing = tuple[Vec3, Vec3, Vec3]
NO_MIXING: Mixing = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
STEEPEST_FALLOFF = 8.0  # exponent of the falloff; measured displays have 0.3 to 1.6
GAMMAS = 0.1, 10.0  # exponents that a display's curve may have


@dataclass(frozen=True)
class Device:
    """How a display turns a pattern into light; by default it is ideal, and costs nothing.

    The radiance towards an angle θ from the screen's normal is

        gain · mixing · (pattern^gamma · (1 - black) + black) · cos(θ)^falloff.

    gamma: the exponent that is left of the curve of each channel, on linear values. black: what a
    black pixel emits, relative to white. mixing: row i tells how much of each channel's light
    appears in channel i; rows that sum to 1 keep white as it is. Raises `InputError` for numbers
    that no display has.

        device = Device(falloff=0.8, gamma=(1.05, 1.05, 1.1), black=0.002)
        light = device.shown(default_pattern())
    """

    falloff: float = 0.0
    gamma: Vec3 = (1.0, 1.0, 1.0)
    black: float = 0.0
    mixing: Mixing = NO_MIXING

    def __post_init__(self) -> None:
        for f in fields(self):
            value = np.asarray(getattr(self, f.name), dtype=float)
            if not np.all(np.isfinite(value)):
                raise InputError(f"device: {f.name} must be finite")
            if value.shape != {"gamma": (3,), "mixing": (3, 3)}.get(f.name, ()):
                raise InputError(f"device: {f.name} has the wrong number of values")
        if not 0 <= self.falloff <= STEEPEST_FALLOFF:
            raise InputError(f"device: falloff must lie between 0 and {STEEPEST_FALLOFF:g}")
        if not all(GAMMAS[0] <= g <= GAMMAS[1] for g in self.gamma):
            raise InputError("device: gamma must lie between {:g} and {:g}".format(*GAMMAS))
        if not 0 <= self.black < 1:
            raise InputError("device: black must be at least 0 and below 1")
        if np.min(self.mixing) < 0 or not np.all(np.sum(self.mixing, 1) > 0):
            raise InputError("device: mixing must not be negative, and no channel without light")

    def shown(self, pattern: Array) -> Array:
        """Relative radiance (H, W, 3) straight ahead of the screen that shows a pattern.

        pattern: linear RGB in [0, 1]. An ideal display returns it as it is.
        """
        light: Any = pattern
        if self.gamma != (1.0, 1.0, 1.0):
            light = np.maximum(light, 0) ** np.asarray(self.gamma)
        if self.black != 0:
            light = light * (1 - self.black) + self.black
        if self.mixing != NO_MIXING:
            light = light @ np.asarray(self.mixing).T
        return pattern if light is pattern else np.asarray(light, np.float32)

    def dimming(self, cosine: Any) -> Any:
        """Radiance towards directions whose angles from the screen's normal have these cosines,
        relative to straight ahead."""
        return np.maximum(cosine, 0) ** self.falloff


IDEAL = Device()
# A glowing sphere: its centre and radius in metres, its radiance (RGB).
Lamp = tuple[Vec3, float, Vec3]
NO_PATTERN: Array = np.zeros((1, 1, 3), np.float32)  # where the rig has no screen


@dataclass(frozen=True)
class NearLamp:
    """A lamp that is near. place: its own, metres; seen_from: where the environment shows it from;
    share (H, 2H): how much of each texel's radiance is its."""

    place: Vec3
    seen_from: Vec3
    share: Array


@dataclass(frozen=True)
class Lights:
    """The screen's light and the room's, in one unit of radiance (a photo's, where one shows them).

    rig: where screen and camera are. The screen's radiance is ``gain`` (a number or RGB) times what
    ``device`` makes of ``pattern`` (h, w, 3), linear values in [0, 1], row 0 at +y: ``shown``
    straight ahead, less towards the sides; `NO_PATTERN` of a rig without a screen. environment:
    linear RGB radiance (H, 2H, 3), row 0 at the zenith; zeros, as by default, for a dark room.

    near: the lamp in the environment that is near, if any.

    What `invrender.find_lights` adds of a photo's mirror ball. coverage: (H, 2H), the share of each
    texel of the environment that the ball really shows, the rest is filled in. lamps: (H, 2H, 3),
    what of the environment is light of saturated lamps or one behind the screen, whose radiance the
    ball does not tell; None where there are none. pattern_captured:
    (P, P, 3), the screen's radiance as the ball shows it. fit: how well all of it fits, by name:
    ``residual`` of the pattern relative to the gain, ``gain_deviation`` the standard deviation of
    the logarithm of the screen's light, ``gamma`` and ``falloff`` the device's, ``blur`` the
    camera's in pixels, ``pixels`` the number used, ``saturated`` and ``room_saturated`` the shares
    of screen and room in the ball that are saturated, ``room_raised`` how many times brighter the
    saturated lamps were made, ``gain_by_table`` by what the ball's gain was multiplied, by the
    table's shading, ``vignetting`` the share of light that the lens loses in the photo's corners,
    which was undone, ``border_unseen`` 1 where neither the sample's border nor a sheet shows the
    camera's place, ``hidden_lamp`` how many times brighter than the filling a part of
    the room behind the screen was made (1: none), ``pattern_residual`` the residual before the
    screen's pose and curve were fitted, ``screen_shift`` (metres) and ``screen_tilt`` (degrees) how
    far the screen is found from its place, ``camera_tilt`` how far the camera is found to look past
    straight down, in degrees,
    ``curve_exponent`` the standard deviation of the power of light that is left of a tone curve,
    ``ball_reflectance`` the mirror's and ``ball_reflectance_deviation`` the standard deviation of
    its logarithm (0: it was stated), with which all radiance here scales; ``light_deviation`` that
    of the logarithm of all light on the sample, and ``screen_doubt``, ``lamps_doubt`` and
    ``hidden_doubt`` what the screen, saturated lamps and the room behind the screen add to it.

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
    lamps: Array | None = None
    near: NearLamp | None = None

    @property
    def shown(self) -> Array:
        """Relative radiance (h, w, 3) straight ahead of the screen: the pattern as displayed."""
        return self.device.shown(self.pattern)

    def scaled(self, screen: Array, room: Array, lamps: Array) -> Lights:
        """With the radiance of the screen, the room and saturated lamps times RGB factors."""
        gain = np.broadcast_to(np.asarray(self.gain, np.float32), 3) * screen
        environment = self.environment * room
        if self.lamps is None:
            return replace(self, gain=gain, environment=environment)
        environment = np.maximum(environment + self.lamps * (lamps - room), 0)
        return replace(self, gain=gain, environment=environment, lamps=self.lamps * lamps)

    def placed(self, place: Array) -> Lights:
        """Seen from a sample that lies elsewhere: where the homography ``place`` (3, 3) takes the
        square of the sample, [-1, 1]², x right and y up; its shift and its turn count. For the
        forward model alone: the ball stays, and so does ``coverage``."""
        angle = float(np.arctan2(place[1, 0], place[0, 0]))
        turn = Rotation.from_rotvec([0, 0, -angle])
        half = self.rig.sample_size / 2
        by = turn.apply([*(-half * place[:2, 2] / place[2, 2]), 0.0])
        rig = self.rig.turned(turn, np.zeros(3))
        rig = replace(rig, camera_shift=tuple(np.add(rig.camera_shift, by).tolist()))
        if rig.has_screen:
            rig = replace(rig, screen_shift=tuple(np.add(rig.screen_shift, by).tolist()))
        turned = partial(rotate_environment, angle=-angle % (2 * np.pi))
        room, lamps, near = self.environment, self.lamps, self.near
        if angle:
            room, lamps = turned(room), None if lamps is None else turned(lamps)
        if near is not None:
            at, seen = (_vec3(turn.apply(p) + by) for p in (near.place, near.seen_from))
            share = turned(near.share[..., None])[..., 0] if angle else near.share
            near = NearLamp(at, seen, share)
        return replace(self, rig=rig, environment=room, lamps=lamps, near=near)


def _vec3(v: Array) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])
