"""Whether photos, brought onto each other, show one sample: those that have nothing in common.

What is compared is what a plain sample of one material does not explain of each photo under its
lights: a glossy one mirrors the pattern, which is no texture of its own. A sample that has none is
nobody's stranger, since nothing tells it from another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.optimize import nnls

from invrender.capture.placement import PLACEMENT, best_shift, features
from invrender.refine.flat import plane_terms
from invrender.refine.gauss_newton import Observation
from invrender.refine.shared_roughness import TRIED_ROUGHNESS
from invrender.sampling import resize
from invrender.types import TINY, Array, InputError


@dataclass(frozen=True)
class SameSampleSettings:
    """Numbers of the comparison, chosen by hand (docs/research-log/
    2026-11-30-five-photos-against-one.md)."""

    side: int = 96  # pixels a side that are compared
    least_side: int = 32  # of photos that are compared at all
    local: float = 0.06  # `PlacementSettings.local`: large shades are the lights'
    reach: float = 0.1  # shift that is looked for
    least: float = 0.1  # correlation: of one sample 0.23 and more, of two seldom above 0.14
    texture: float = 0.03  # RMS of the logarithm's local changes, from which there is any
    samples: int = 16  # of the specular lobe


SAME_SAMPLE = SameSampleSettings()


def strangers(photos: Sequence[Observation], s: SameSampleSettings = SAME_SAMPLE) -> list[int]:
    """Which photos of several show another sample than most of the others.

    Raises `InputError` where no two of them have anything in common.
    """
    side = min(s.side, len(photos[0].photo))
    if len(photos) < 2 or side < s.least_side:
        return []
    if len(_largest(_alike([_features(_log(p, side), s) for p in photos], s))) == len(photos):
        return []
    own = [_without_lights(p, side, s) for p in photos]
    textured = [i for i, (_, spread) in enumerate(own) if spread > s.texture]
    if len(textured) < 2:
        return []
    group = _largest(_alike([_features(own[i][0], s) for i in textured], s))
    if len(group) == 1:
        raise InputError(
            f"the {len(photos)} photos show different samples: one result is of one square of one "
            "sample, so refine each by itself"
        )
    return [i for k, i in enumerate(textured) if k not in group]


def _largest(alike: Array) -> set[int]:
    """The largest group of what hangs together; the one with the first, where two are as large."""
    from scipy.sparse.csgraph import connected_components

    label = connected_components(alike, directed=False)[1]
    return set(np.flatnonzero(label == np.argmax(np.bincount(label))).tolist())


def _alike(images: Sequence[Array], s: SameSampleSettings) -> Array:
    """Which have texture or relief in common, (n, n)."""
    settings = replace(PLACEMENT, farthest=s.reach, doubt=0.0)
    windows = (np.ones(images[0].shape[1:], np.float32),) * 2
    alike = np.zeros((len(images),) * 2, bool)
    for i, image in enumerate(images):
        for j in range(i):
            alike[i, j] = best_shift(image, images[j], windows, settings)[0] > s.least
    return alike


def _features(log: Array, s: SameSampleSettings) -> Array:
    return features(np.exp(log)[..., None], replace(PLACEMENT, local=s.local))


def _log(photo: Observation, side: int) -> Array:
    grey = resize(photo.photo, side, side).mean(-1)
    return np.asarray(np.log(np.maximum(grey, 0) + 1e-2 * float(grey.mean()) + TINY))


def _without_lights(photo: Observation, side: int, s: SameSampleSettings) -> tuple[Array, float]:
    """The logarithm of a photo less that of the plain sample that leaves least of its local
    changes; and the RMS of what it leaves of them."""
    log, grey = _log(photo, side), resize(photo.photo, side, side).mean(-1)
    width = s.local * side / 2

    def local(x: Array) -> Array:
        fine = ndimage.gaussian_filter(x, PLACEMENT.fine * side / 2, mode="nearest")
        return np.asarray(fine - ndimage.gaussian_filter(x, width, mode="nearest"))

    best, least = log, local(log)
    for rho in TRIED_ROUGHNESS:
        terms = plane_terms(photo.renderer, side, side, float(rho), s.samples)
        e, b, a = (t.mean(-1) for t in terms)
        weight = 1 / (grey + float(grey.mean()) + TINY)
        columns = [(t * weight).ravel() for t in (e, b + a)]
        k, _ = nnls(np.stack(columns, -1).astype(float), (grey * weight).ravel().astype(float))
        plain = k[0] * e + k[1] * (b + a)
        rest = log - np.log(plain + 1e-2 * float(plain.mean()) + TINY)
        left = local(rest)
        if np.mean(left**2) < np.mean(least**2):
            best, least = rest, left
    return best, float(np.sqrt(np.mean(least**2)))
