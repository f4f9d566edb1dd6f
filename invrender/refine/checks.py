"""How well maps explain their photo."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from invrender.refine.flat import USUAL_ROUGHNESS, plane_terms
from invrender.render.renderer import Renderer
from invrender.types import TINY, Array

BLOCKS = 16  # parts a side, whose means the coarse error compares


def photo_error(picture: Array, photo: Array, clipped: NDArray[np.bool_]) -> float:
    """RMS difference over the photo's mean, where the photo is not saturated."""
    seen = ~clipped if not clipped.all() else np.ones_like(clipped)
    difference = (picture - photo)[seen].astype(np.float64)
    return float(np.sqrt(np.mean(difference**2)) / max(float(photo[seen].mean()), TINY))


def coarse_error(picture: Array, photo: Array, clipped: NDArray[np.bool_]) -> float:
    """RMS difference of the means of `BLOCKS` × `BLOCKS` parts over the photo's mean.

    What relief and sharp highlights leave unexplained pixel by pixel averages out; what wrong
    lights leave does not. Saturated pixels count as explained.
    """
    difference = np.where(clipped[..., None], 0, picture - photo).astype(np.float64)
    size = np.ones(clipped.shape)
    for axis, n in enumerate(clipped.shape):
        starts = np.unique(np.arange(BLOCKS) * n // BLOCKS)
        difference, size = (np.add.reduceat(x, starts, axis) for x in (difference, size))
    rms = np.sqrt(np.mean((difference / size[..., None]) ** 2))
    return float(rms / max(float(photo.mean()), TINY))


SIDE = 128  # pixels a side that the light in an albedo is looked for by
DARK_ALBEDO = 0.05  # mean albedo below which it is not
PLAIN = 0.005  # deviation of the light's log ratio that is no sign
SLIGHT = 0.05  # share of the light's log ratio that is no sign


def baked_light(diffuse: Array, renderer: Renderer, samples: int = 64) -> float:
    """How much a diffuse albedo (H, W, 3) has of the light's colours the other way round, 0 to 1.

    Per-pixel albedos explain any photo of a matt sample, under any light. Where the light is wrong
    they take up true over assumed irradiance: their log(R/G) or log(B/G) falls where that of the
    assumed irradiance rises. The greater of both correlations, by at most `SIDE`² pixels; nought
    for a sample too dark or a light too plain to tell.
    """
    if float(diffuse.mean()) < DARK_ALBEDO:
        return 0.0
    h, w = (min(SIDE, n) for n in diffuse.shape[:2])
    rows, columns = (
        ((np.arange(n) + 0.5) / n * of).astype(np.intp)
        for n, of in zip((h, w), diffuse.shape[:2], strict=True)
    )
    light = plane_terms(renderer, h, w, USUAL_ROUGHNESS, samples)[0]
    albedo = diffuse[np.ix_(rows, columns)]
    greatest = 0.0
    for c in (0, 2):
        x, y = (
            np.log(a[..., c] + least) - np.log(a[..., 1] + least)
            for a, least in ((light, 1e-6 * float(light.mean()) + TINY), (albedo, 0.01))
        )
        x, y = x - x.mean(dtype=np.float64), y - y.mean(dtype=np.float64)
        xx, xy = float((x * x).mean()), float((x * y).mean())
        if xx > PLAIN**2 and xy < -SLIGHT * xx:
            greatest = max(greatest, -xy / float(np.sqrt(xx * (y * y).mean())))
    return greatest
