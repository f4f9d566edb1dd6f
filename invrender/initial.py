"""Initial maps without a network: a flat sample with the commonest lobe, diffuse from the rest."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.backend import dr, vector
from invrender.maps import Maps, constant_maps
from invrender.render import Tables, Unbiased, shade
from invrender.scene import make_view

Array = NDArray[np.floating[Any]]
USUAL_ROUGHNESS, USUAL_SPECULAR = 0.55, 0.04  # medians of common materials
SIDE = 128  # pixels a side that the light in an albedo is looked for by
DARK = 0.05  # mean albedo below which it is not
PLAIN, SLIGHT = 0.005, 0.05  # deviation of the light's log ratio, and share of it, that are no sign


def flat_maps(photo: Array, prepared: Tables | Unbiased, samples: int = 64) -> Maps:
    """Maps of a flat sample for a photo (H, W, 3) of it, linear radiance."""
    height, width = photo.shape[:2]
    terms = plane_terms(prepared, height, width, USUAL_ROUGHNESS, samples)
    k_s = np.full(3, USUAL_SPECULAR)
    maps = constant_maps(height, width, 0.0, k_s, USUAL_ROUGHNESS)
    maps.diffuse = diffuse_rest(photo, terms, k_s)
    return maps


def diffuse_rest(photo: Array, terms: tuple[Array, Array, Array], k_s: Array) -> Array:
    """The diffuse albedo that explains what a lobe (E, B, A) of f0 k_s leaves of the photo.

    What a surface mirrors it cannot scatter too: at most 1 - k_s.
    """
    e, b, a = terms
    rest = (photo - k_s * b - a) * np.pi / np.maximum(e, 1e-12)
    return np.clip(rest, 0, 1 - k_s).astype(np.float32)


def plane_terms(
    prepared: Tables | Unbiased, height: int, width: int, rho: float, samples: int
) -> tuple[Array, Array, Array]:
    """E, B and A of I = k_d·E/π + k_s·B + A for a flat sample, each (H, W, 3)."""
    scalar = prepared.scene.scalar
    view = make_view(prepared.scene, height, width)
    shading = shade(prepared, view, dr.opaque(scalar, rho), vector(scalar, 3)(0, 0, 1), samples)
    parts = shading.irradiance, shading.b, shading.a
    dr.eval(parts)  # one launch for all
    e, b, a = (np.asarray(x).T.reshape(height, width, 3) for x in parts)
    return e, b, a


def baked_light(diffuse: Array, prepared: Tables | Unbiased, samples: int = 64) -> float:
    """How much a diffuse albedo (H, W, 3) has of the light's colours the other way round, 0 to 1.

    Per-pixel albedos explain any photo of a matt sample, under any light. Where the light is wrong
    they take up true over assumed irradiance: their log(R/G) or log(B/G) falls where that of the
    assumed irradiance rises. The greater of both correlations, by at most `SIDE`² pixels; nought
    for a sample too dark or a light too plain to tell.
    """
    if float(diffuse.mean()) < DARK:
        return 0.0
    h, w = (min(SIDE, n) for n in diffuse.shape[:2])
    rows, columns = (
        ((np.arange(n) + 0.5) / n * of).astype(np.intp)
        for n, of in zip((h, w), diffuse.shape[:2], strict=True)
    )
    light = plane_terms(prepared, h, w, USUAL_ROUGHNESS, samples)[0]
    albedo = diffuse[np.ix_(rows, columns)]
    greatest = 0.0
    for c in (0, 2):
        x, y = (
            np.log(a[..., c] + least) - np.log(a[..., 1] + least)
            for a, least in ((light, 1e-6 * float(light.mean()) + 1e-12), (albedo, 0.01))
        )
        x, y = x - x.mean(dtype=np.float64), y - y.mean(dtype=np.float64)
        xx, xy = float((x * x).mean()), float((x * y).mean())
        if xx > PLAIN**2 and xy < -SLIGHT * xx:
            greatest = max(greatest, -xy / float(np.sqrt(xx * (y * y).mean())))
    return greatest
