"""The maps of a sample's photos: where they start, and which solver they call for.

One photo or two leave much to the networks: what their materials share, then the posterior of each
pixel. `MEASURING_PHOTOS` and more measure: their joint posterior at full strength, from the maps of
the one that networks know best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from invrender.lights import Lights
from invrender.maps import Maps
from invrender.refine.flat import flat_maps
from invrender.refine.gauss_newton import Observation, Refined, refine
from invrender.refine.lobes import fit_lobes
from invrender.refine.mirrors import take_mirrors
from invrender.refine.plain import evened, keep_level, likely_relief
from invrender.refine.posterior import explain
from invrender.refine.priors import Prior, lobe_prior
from invrender.refine.several import explain_together, plain_prior
from invrender.refine.shared import light_doubt, share
from invrender.refine.texture import without_light
from invrender.refine.theta import dielectric_share, is_dielectric, to_maps, to_theta
from invrender.render.near import renderer_under
from invrender.types import Array, Mask

MEASURING_PHOTOS = 3  # photos from which these count for more than what networks know
# Of `Shared.misfit`, from which the lights on dielectrics are wrong, such as the edge of a shadow:
# of 69 photographs at most 0.1, of one with its screen's shadow elsewhere 2.1; of a mirror 3.5
# (docs/research-log/2026-11-30-a-shadow-elsewhere.md).
CONTRADICTED = 0.5
# Of a pixel of the screen's image in the ball, by which the screen is misplaced: of 20 photographs
# with few pixels (50) those of a polished sample had the screen elsewhere by that
# (docs/research-log/2026-11-30-roughness-that-goes-with-the-albedo.md).
POSE_ERROR = 0.5


@dataclass(frozen=True)
class Initial:
    """Maps before the photos are explained.

    asked: the photo that networks know best, as they were shown it; None where no network knows the
    sample. lobes: what the light's pattern says of this photo, if it was asked alone.
    """

    maps: Maps
    prior: Prior
    asked: Observation | None = None
    lobes: Maps | None = None
    interrupted: bool = False


def observe(photo: Array, lights: Lights, clipped: Mask) -> Observation:
    """A photo of the sample with its forward model."""
    mask = clipped if clipped.any() else None
    doubt, exponent = light_doubt(lights.fit), lights.fit.get("curve_exponent", 0.0)
    away = lights.rig.lens_distance(*photo.shape[:2]).astype(np.float32) if lights.fit else None
    return Observation(
        photo, renderer_under(lights), mask, doubt, lights.lamps, exponent, away,
        lights.fit.get("light_deviation", 0.0), _pose_deviation(lights),
    )  # fmt: skip


def _pose_deviation(lights: Lights) -> float:
    """Of the directions to the screen's points, radians; nought of lights that are known."""
    pixels, rig = lights.fit.get("pixels", 0.0), lights.rig
    if not pixels or not rig.has_screen:
        return 0.0
    width, depth = rig.screen_sides
    return float(POSE_ERROR * np.sqrt(width * depth / pixels) / rig.screen_height)


def flat_start(photos: Sequence[Observation], samples: int) -> Initial:
    """Without a network: constant maps, and what the light's pattern says of the materials."""
    first = photos[0]
    prior = lobe_prior(fit_lobes(first.photo, first.renderer, samples))
    return Initial(flat_maps(first.photo, first.renderer, samples), prior)


def plain_start(photos: Sequence[Observation], samples: int) -> Initial:
    """For several photos without a display: what all of them say of a flat sample."""
    prior = plain_prior(photos, samples)
    return Initial(to_maps(prior.mean), prior)


def explain_photos(
    photos: Sequence[Observation],
    initial: Initial,
    samples: int,
    progress: Callable[[float], None],
    step: Callable[[int, float], None],
) -> tuple[Refined, list[Observation]]:
    """Maps that explain the photos, and these with the lights as they were found to be.

    ``progress`` is told the share done, ``step`` each step of a flat start and the photo's error.
    Ctrl-C ends it with what was found so far.
    """
    kept, prior = list(photos), initial.prior
    if initial.interrupted:
        return Refined(to_maps(prior.mean), prior.expected, interrupted=True), kept
    measured = len(photos) >= MEASURING_PHOTOS
    if initial.asked is None and not measured:
        return refine(photos, prior, samples=samples, progress=step), kept
    if initial.asked is not None:
        few = [initial.asked] if measured else photos
        result, observed = _explain_few(few, initial, samples)
        if not measured:
            return result, observed
        if result.interrupted:
            return result, kept
        prior = Prior(to_theta(result.maps), result.sigma, prior.correlation)
    return explain_together(photos, prior, samples=samples, progress=progress), kept


def _explain_few(
    photos: Sequence[Observation], initial: Initial, samples: int
) -> tuple[Refined, list[Observation]]:
    """`explain_photos` for one photo or two, of which networks know the sample."""
    prior = initial.prior
    if initial.lobes is not None:
        prior = take_mirrors(photos[0], prior, initial.lobes, samples=samples)
    known = share(photos, likely_relief(prior), samples=samples)
    if known.interrupted:
        result = Refined(to_maps(known.prior.mean), known.prior.expected, interrupted=True)
        result.factors = known.factors
        return result, known.observations
    start = initial.maps
    dielectric = is_dielectric(dielectric_share(known.prior.mean))
    if dielectric and known.misfit > CONTRADICTED:  # pixels say what the lights are off by
        return Refined(start, initial.prior.expected, contradicted=True), list(photos)
    prior = without_light(known.observations, known.prior, start.roughness, samples=samples)
    kept, prior, level = keep_level(known.observations, prior, start.diffuse)
    result = explain(kept, prior, samples=samples)
    result.maps = to_maps(evened(to_theta(result.maps)))
    result.converged &= known.converged
    result.factors = [
        (level * screen, level * room, level * lamps) for screen, room, lamps in known.factors
    ]
    result.seen, result.cameras = [o.photo for o in kept], known.cameras
    return result, kept
