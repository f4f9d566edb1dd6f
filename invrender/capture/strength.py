"""How well the strength of the light on the sample is known: every albedo scales with it."""

from __future__ import annotations

import math

import numpy as np

from invrender.capture.settings import STRENGTH, TABLE_METER
from invrender.capture.table import room_irradiance, screen_irradiance
from invrender.lights import Lights
from invrender.sphere import resample_environment
from invrender.types import TINY, Array, Notice

# What makes the light doubtful, by its name in `Lights.fit`, and what to do about it.
CAUSES = {
    "screen_doubt": "the screen's light is read from a tone curve or from what of it is not "
    "saturated in the ball: take a raw photo, or a bracket that begins shorter",
    "lamps_doubt": "lamps are saturated in the ball, and the table's shading alone tells how "
    "bright they are: expose shorter, or turn them off",
    "hidden_doubt": "the screen hides a part of the room from the ball that lights the sample: "
    "turn the rig until no lamp or window is behind the screen",
    "ball_reflectance_deviation": "the ball's reflectance is known no better: set [ball] "
    "reflectance in rig.toml",
}


def light_doubts(lights: Lights, filling: Array, screen: float, lamps: float) -> dict[str, float]:
    """By how much, of its logarithm, the light on the sample's middle is in doubt: for `Lights.fit`
    by its cause, but for the ball's reflectance.

    filling: (H, 2H, 3), what of the environment is filled in. screen, lamps: deviations of the
    logarithms of the screen's light and of the raised lamps'.
    """
    middle, rows = np.zeros((1, 3)), TABLE_METER.environment_rows
    lit = lights.pattern, lights.gain, lights.device

    def room(light: Array) -> float:
        light = resample_environment(np.asarray(light, np.float32), rows)
        return float(room_irradiance(lights.rig, middle, light).mean())

    raised = np.zeros_like(lights.environment) if lights.lamps is None else lights.lamps
    rest = lights.environment - raised
    by_screen = float(screen_irradiance(lights.rig, middle, lit, TABLE_METER.screen_cells).mean())
    assert lights.coverage is not None
    hidden = rest * (lights.coverage <= 0)[..., None]
    beside = STRENGTH.beside * room(np.maximum(hidden - filling, 0))
    by_lamps = room(raised)
    total = by_screen + by_lamps + room(rest) + TINY
    return {
        "screen_doubt": screen * by_screen / total,
        "lamps_doubt": math.hypot(lamps, STRENGTH.lamps) * by_lamps / total,
        "hidden_doubt": math.hypot(STRENGTH.hidden * room(filling), beside) / total,
    }


def light_deviation(fit: dict[str, float]) -> float:
    """The deviation of the logarithm of the light on the sample, of all `CAUSES`."""
    return math.hypot(*(fit.get(cause, 0.0) for cause in CAUSES))


def strength_warnings(fit: dict[str, float]) -> tuple[Notice, ...]:
    """That the light on the sample is in doubt, and why."""
    deviation = fit.get("light_deviation", 0.0)
    if deviation < STRENGTH.warned:
        return ()
    cause = max(CAUSES, key=lambda name: fit.get(name, 0.0))
    text = (
        f"the light on the sample is known to ± {deviation:.0%}, and every albedo no better: "
        f"{CAUSES[cause]}"
    )
    return (Notice("light-doubtful", text),)
