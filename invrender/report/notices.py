"""What is doubtful about maps, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from invrender.lights import Lights
from invrender.types import Mask, Notice

if TYPE_CHECKING:  # Dr.Jit compiles where the refinement is imported
    from invrender.refine.gauss_newton import Refined

FAR_OFF = 0.1  # of its size that the screen may hang off before the rig is in doubt
# `coarse_error` from which the maps are in doubt; from a flat start each pixel's albedo explains
# more.
POOR_FIT = {"network": 0.25, "flat": 0.1}
BAKED = 0.6  # correlation of albedo and light, negative, from which the lights are in doubt


def map_notices(
    lights: Lights, clipped: Mask, refined: Refined, init: str, baked: float, coarse: float
) -> list[Notice]:
    """What a person should know of refined maps.

    clipped: where the photo is saturated. baked: `baked_light` of the albedo. coarse:
    `coarse_error` of the rendering.
    """
    fit, notices = lights.fit, []

    def note(code: str, text: str) -> None:
        notices.append(Notice(code, text))

    shift = fit.get("screen_shift", 0)
    if shift and shift > FAR_OFF * max(lights.rig.screen_sides):
        note(
            "screen-far-off",
            f"in the ball, the screen hangs {1000 * shift:.0f} mm from where "
            "rig.toml says: check its sizes, above all the screen's height",
        )
    if fit.get("border_unseen"):
        note(
            "border-unseen",
            "the sample's border is not to be seen in the photo, so that the maps may be shifted "
            "by some millimetres: lay it on a plain table of other brightness, or use the sheet",
        )
    if clipped.any():
        note(
            "sample-saturated",
            f"{clipped.mean():.1%} of the sample is saturated in the photo; the maps keep their "
            "initial values there: expose for the highlights",
        )
    if refined.interrupted:
        note("interrupted", "interrupted: these are the best maps so far")
    elif refined.contradicted:
        note(
            "lights-contradicted",
            "the photo contradicts the light that the ball shows, as where a shadow's edge lies "
            "elsewhere; the maps are what the networks said first: check the rig's sizes",
        )
    elif not refined.converged:
        note("not-converged", "refinement had not converged when it reached its step limit")
    if baked > BAKED:
        note(
            "albedo-follows-light",
            f"the albedo's colours follow the light's (correlation -{baked:.1f}): the light is "
            "probably not where or what it is taken for; check the rig's sizes and the ball",
        )
    if coarse > POOR_FIT[init]:
        note(
            "poor-fit",
            f"even the large shades of the photo are explained only to within {coarse:.0%} of its "
            "mean: check the rig's sizes, the pattern and the ball",
        )
    return notices
