"""Whether photos, brought onto each other, show one sample: those that have nothing in common.

What is compared is what a plain sample of one material does not explain of each photo under its
lights: a glossy one mirrors the pattern, which is no texture of its own. A sample that has none is
nobody's stranger, since nothing tells it from another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.sparse.csgraph import connected_components

from invrender.capture.placement import PLACEMENT, best_shift, features
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
    floor: float = 0.01  # of the mean radiance, below which nothing counts
    texture: float = 0.03  # RMS of the logarithm's local changes, from which there is any


SAME_SAMPLE = SameSampleSettings()


def strangers(
    photos: Sequence[Array],
    plain: Callable[[int], Array],
    s: SameSampleSettings = SAME_SAMPLE,
) -> list[int]:
    """Which photos (H, W, 3) of several show another sample than most of the others.

    plain: what a sample of one material would show in a photo of that number. Raises `InputError`
    where no two have anything in common.
    """
    side = min(s.side, len(photos[0]))
    if len(photos) < 2 or side < s.least_side:
        return []
    logs = [_log(p, side) for p in photos]
    if len(_largest(_alike(logs, s))) == len(photos):
        return []
    own = [log - _log(plain(i), side) for i, log in enumerate(logs)]
    textured = [i for i, log in enumerate(own) if _texture(log, s) > s.texture]
    if len(textured) < 2:
        return []
    group = _largest(_alike([own[i] for i in textured], s))
    if len(group) == 1:
        raise InputError(
            f"the {len(photos)} photos show different samples: one result is of one square of one "
            "sample, so refine each by itself"
        )
    return [i for k, i in enumerate(textured) if k not in group]


def _largest(alike: Array) -> set[int]:
    """The largest group of what hangs together; the one with the first, where two are as large."""
    label = connected_components(alike, directed=False)[1]
    return set(np.flatnonzero(label == np.argmax(np.bincount(label))).tolist())


def _alike(logs: Sequence[Array], s: SameSampleSettings) -> Array:
    """Which have texture or relief in common, (n, n)."""
    settings = replace(PLACEMENT, farthest=s.reach, doubt=0.0, local=s.local)
    windows = (np.ones(logs[0].shape, np.float32),) * 2
    images = [features(np.exp(log)[..., None], settings) for log in logs]
    alike = np.zeros((len(images),) * 2, bool)
    for i, image in enumerate(images):
        for j in range(i):
            alike[i, j] = best_shift(image, images[j], windows, settings)[0] > s.least
    return alike


def _log(photo: Array, side: int) -> Array:
    grey = resize(photo, side, side).mean(-1)
    return np.asarray(np.log(np.maximum(grey, 0) + SAME_SAMPLE.floor * float(grey.mean()) + TINY))


def _texture(log: Array, s: SameSampleSettings) -> float:
    """RMS of a logarithm's local changes, without noise."""
    half = len(log) / 2
    fine = ndimage.gaussian_filter(log, PLACEMENT.fine * half, mode="nearest")
    local = fine - ndimage.gaussian_filter(log, s.local * half, mode="nearest")
    return float(np.sqrt(np.mean(local**2)))
