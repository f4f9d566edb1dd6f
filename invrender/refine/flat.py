"""Initial maps without a network: a flat sample with the commonest lobe, diffuse from the rest."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from invrender.maps import Maps, constant_maps
from invrender.render.backend import dr, vector
from invrender.render.renderer import Renderer
from invrender.render.scene import make_view
from invrender.sampling import resize
from invrender.types import TINY, Array

USUAL_ROUGHNESS, USUAL_SPECULAR = 0.55, 0.04  # medians of common materials
PLAIN_ROUGHNESS = 0.12, 0.22, 0.33, 0.45, 0.57, 0.69, 0.8, 0.92  # that are tried, by hand
PLAIN_SIDE, PLAIN_SAMPLES = 96, 16  # pixels of a plain sample at most; of its specular lobe


def flat_maps(photo: Array, renderer: Renderer, samples: int = 64) -> Maps:
    """Maps of a flat sample for a photo (H, W, 3) of it, linear radiance."""
    height, width = photo.shape[:2]
    terms = plane_terms(renderer, height, width, USUAL_ROUGHNESS, samples)
    k_s = np.full(3, USUAL_SPECULAR)
    maps = constant_maps(height, width, 0.0, k_s, USUAL_ROUGHNESS)
    maps.diffuse = diffuse_rest(photo, terms, k_s)
    return maps


def plain_image(photo: Array, renderer: Renderer) -> Array:
    """What a flat sample of one grey material shows (h, w, 1), the one that is most like a photo
    (H, W, 3), at `PLAIN_SIDE` pixels a side."""
    side = min(PLAIN_SIDE, len(photo))
    grey = resize(photo, side, side).mean(-1)
    weight = 1 / (grey + float(grey.mean()) + TINY)
    best, least = grey, np.inf
    for rho in PLAIN_ROUGHNESS:
        e, b, a = (t.mean(-1) for t in plane_terms(renderer, side, side, rho, PLAIN_SAMPLES))
        columns = np.stack([(t * weight).ravel() for t in (e, a + b)], -1)
        k, left = nnls(columns.astype(float), (grey * weight).ravel().astype(float))
        if left < least:
            best, least = k[0] * e + k[1] * (a + b), left
    return np.asarray(best[..., None], np.float32)


def diffuse_rest(photo: Array, terms: tuple[Array, Array, Array], k_s: Array) -> Array:
    """The diffuse albedo that explains what a lobe (E, B, A) of f0 k_s leaves of the photo.

    What a surface mirrors it cannot scatter too: at most 1 - k_s.
    """
    e, b, a = terms
    rest = (photo - k_s * b - a) * np.pi / np.maximum(e, TINY)
    return np.clip(rest, 0, 1 - k_s).astype(np.float32)


def plane_terms(
    renderer: Renderer, height: int, width: int, rho: float, samples: int
) -> tuple[Array, Array, Array]:
    """E, B and A of I = k_d·E/π + k_s·B + A for a flat sample, each (H, W, 3)."""
    scalar = renderer.scene.scalar
    view = make_view(renderer.scene, height, width)
    shading = renderer.shade(view, dr.opaque(scalar, rho), vector(scalar, 3)(0, 0, 1), samples)
    parts = shading.irradiance, shading.b, shading.a
    dr.eval(parts)  # one launch for all
    e, b, a = (np.asarray(x).T.reshape(height, width, 3) for x in parts)
    return e, b, a
