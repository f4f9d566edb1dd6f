"""The maps of a sample's photos: where they start, and which solver they call for.

One photo or two leave much to the networks: what their materials share, then the posterior of each
pixel. `MEASURING_PHOTOS` and more measure: their joint posterior at full strength.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from invrender.lights import Lights
from invrender.maps import Maps
from invrender.refine.flat import flat_maps
from invrender.refine.gauss_newton import Observation, Refined, refine
from invrender.refine.lobes import fit_lobes
from invrender.refine.mirrors import take_mirrors
from invrender.refine.posterior import explain
from invrender.refine.priors import Prior, lobe_prior, pooled
from invrender.refine.several import explain_together, likeliest, plain_prior
from invrender.refine.shared import light_doubt, share
from invrender.refine.texture import without_light
from invrender.refine.theta import to_maps
from invrender.render.near import renderer_under
from invrender.types import Array, Mask

MEASURING_PHOTOS = 3  # photos from which these count for more than what networks know


@dataclass(frozen=True)
class Initial:
    """Maps before the photos are explained.

    priors: of each photo whose maps networks estimated, or one of all. lobes: what the light's
    pattern says of a photo alone, if it was asked. flat: whether no network knows the sample.
    """

    maps: Maps
    priors: list[Prior]
    lobes: Maps | None = None
    flat: bool = False
    interrupted: bool = False

    @property
    def prior(self) -> Prior:
        """What all photos' networks say together."""
        return pooled(self.priors)


def observe(photo: Array, lights: Lights, clipped: Mask) -> Observation:
    """A photo of the sample with its forward model."""
    mask = clipped if clipped.any() else None
    return Observation(photo, renderer_under(lights), mask, light_doubt(lights.fit), lights.lamps)


def flat_start(photos: Sequence[Observation], samples: int) -> Initial:
    """Without a network: constant maps, and what the light's pattern says of the materials."""
    first = photos[0]
    prior = lobe_prior(fit_lobes(first.photo, first.renderer, samples))
    return Initial(flat_maps(first.photo, first.renderer, samples), [prior], flat=True)


def plain_start(photos: Sequence[Observation], samples: int) -> Initial:
    """For several photos without a display: what all of them say of a flat sample."""
    prior = plain_prior(photos, samples)
    return Initial(to_maps(prior.mean), [prior], flat=True)


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
    if len(photos) >= MEASURING_PHOTOS:
        if not initial.flat:
            prior = likeliest(photos, [*initial.priors, prior], samples)
        return explain_together(photos, prior, samples=samples, progress=progress), kept
    if initial.flat:
        return refine(photos, prior, samples=samples, progress=step), kept
    if initial.lobes is not None:
        prior = take_mirrors(photos[0], prior, initial.lobes, samples=samples)
    known = share(photos, prior, samples=samples)
    if known.interrupted:
        result = Refined(to_maps(known.prior.mean), known.prior.expected, interrupted=True)
    else:
        before = initial.maps.roughness
        prior = without_light(known.observations, known.prior, before, samples=samples)
        result = explain(known.observations, prior, samples=samples)
        result.converged &= known.converged
    result.factors = known.factors
    return result, list(known.observations)
