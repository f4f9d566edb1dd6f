"""What a plain dielectric's maps keep of what the photo asks for: little that is noise or light.

- **Level.** Where the photo asks for an albedo off the first network's by no more than what the
  lights' strength, told by a ball, is known to, they take it: one per cent, ten in a JPEG whose
  screen is saturated.
- **Variation.** Roughness varies little within a material; of what networks see of it most is noise
  of the photo, or its light. Details that go with the albedo's are the texture's own and stay.
  There is no texture where neighbouring pixels hardly vary together: then the albedo's variation is
  noise too, and none is kept.
- **Relief.** A network's slopes are wrinkles of its own where all of them are shallow; else it sees
  their wide shades too steep, which the light's resemble, and the details too shallow.

The level and the albedo's variation are shrunk by what is expected of such errors, c, as a change
or a deviation x: by 1 - (c/x)² or the square of that, and wholly below c (Breiman's garrote, 1995).
What is well above stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from invrender.refine.gauss_newton import Observation
from invrender.refine.priors import Prior
from invrender.refine.shared import KNOWN, material_means
from invrender.refine.theta import D, N, R, dielectric_share, is_dielectric, project
from invrender.sampling import resize
from invrender.types import TINY, Array


@dataclass(frozen=True)
class Settings:
    """Chosen by hand on 66 simulated photographs (docs/research-log/2026-11-30-plain-samples.md),
    what is kept of roughness on 113 (docs/research-log/2026-11-30-roughness-kept-and-found.md),
    levels and relief on these (docs/research-log/2026-11-30-levels-of-jpegs.md,
    docs/research-log/2026-11-30-what-slopes-mean.md)."""

    level: float = 0.01  # of the lights' strength in each colour, that is not told, at least
    of_gain: float = 0.6  # and of what the screen's is known to (`Observation.level`)
    fine: float = 1 / 16  # of the side: the Gaussian beyond which a detail of roughness is shade
    dark: float = 0.01  # added to the albedo, whose logarithm such details are compared with
    roughness: float = 0.2  # of the other details that is kept
    wrinkles: float = 0.012  # slopes, RMS of a sample, of which half are
    wide: float = 1 / 64  # of the side: the Gaussian of slopes' wide shades
    slopes: tuple[float, float] = (0.65, 1.1)  # true over found, of wide shades and of details
    side: int = 256  # pixels a side of which neighbours are compared
    contrast: tuple[float, float] = (0.03, 0.003)  # they share on plain samples: of k_d; at least
    alone: float = 0.4  # of a pixel's own deviation, that counts too: a weave's neighbours differ


PLAIN_SETTINGS = Settings()


def likely_relief(prior: Prior, s: Settings = PLAIN_SETTINGS) -> Prior:
    """The prior with the slopes that a network's are likely to mean."""
    mean = prior.mean.copy()
    slopes = mean[..., N]
    wide = gaussian_filter(slopes, (*(s.wide * n for n in mean.shape[:2]), 0))
    square = float(np.mean(slopes**2))
    of_wide, of_fine = s.slopes
    mean[..., N] = of_wide * wide + of_fine * (slopes - wide)
    mean[..., N] *= square / (square + s.wrinkles**2)
    return replace(prior, mean=project(mean))


def keep_level(
    observations: Sequence[Observation], prior: Prior, first: Array, s: Settings = PLAIN_SETTINGS
) -> tuple[list[Observation], Prior, Array]:
    """The photos, the prior with the albedo's level as the photo lets it be, and by what RGB their
    lights were multiplied for that.

    first: the first network's albedo (H, W, 3).
    """
    weight = dielectric_share(prior.mean)
    if not is_dielectric(weight) or any(o.doubt == KNOWN for o in observations):
        return list(observations), prior, np.ones(3, np.float32)
    asked, before = (_mean(x, weight) + TINY for x in (prior.mean[..., D], first))
    change = np.log(asked / before)
    doubt = np.hypot(s.level, s.of_gain * min(o.level for o in observations))
    left = np.exp(change * np.minimum(1, (doubt / (np.abs(change) + TINY)) ** 2))
    left = left.astype(np.float32)
    mean = prior.mean.copy()
    mean[..., D] *= 1 + weight[..., None] * (1 / left - 1)
    shots = [replace(o, renderer=o.renderer.scaled(left, left)) for o in observations]
    return shots, replace(prior, mean=mean), left


def evened(theta: Array, s: Settings = PLAIN_SETTINGS) -> Array:
    """Maps θ (H, W, 9) without what of their variation is noise; in place."""
    weight = dielectric_share(theta)
    if not is_dielectric(weight):
        return theta
    uneven = theta[..., R] - material_means(theta, theta[..., R])
    mean = _mean(theta[..., D], weight)
    size = tuple(min(s.side, n) for n in weight.shape)
    varied = resize(theta[..., D], *size) - np.float32(mean)
    rows, columns = varied[1:] * varied[:-1], varied[:, 1:] * varied[:, :-1]
    pairs = (rows.sum() + columns.sum()) / max(rows.size + columns.size, 1)
    shared = max(pairs, s.alone**2 * np.mean(varied**2), TINY)
    of, least = s.contrast
    plain = (of * mean.mean()) ** 2 + least**2
    noise = min(1.0, plain / float(shared)) ** 2
    fine, texture = details(uneven, s), texture_details(theta, s)
    follows = np.average(fine * texture, weights=weight)
    follows /= np.average(texture**2, weights=weight) + TINY
    kept = s.roughness * fine + (1 - s.roughness) * follows * texture
    theta[..., R] -= weight * (uneven - (1 - noise) * kept)
    theta[..., D] -= noise * weight[..., None] * (theta[..., D] - np.float32(mean))
    return project(theta)


def details(image: Array, s: Settings = PLAIN_SETTINGS) -> Array:
    """An image (H, W) or (H, W, C) without its wide shades."""
    height, width, *rest = image.shape
    wide = gaussian_filter(image, [s.fine * height, s.fine * width, *(0 for _ in rest)])
    return np.asarray(image - wide)


def texture_details(theta: Array, s: Settings = PLAIN_SETTINGS) -> Array:
    """Details (H, W) of the logarithm of the albedo of maps θ (H, W, 9)."""
    return details(np.log(theta[..., D].mean(-1) + s.dark), s)


def _mean(image: Array, weight: Array) -> Array:
    """Weighted mean (3,) of an image (H, W, 3)."""
    total = np.einsum("hwc,hw->c", image, weight, dtype=np.float64)
    return np.asarray(total / weight.sum(dtype=np.float64))
