"""The display as physics: from a pattern's values to the radiance that leaves the screen."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

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
