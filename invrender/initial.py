"""Initial maps without a network: one specular lobe for the whole sample, diffuse from the rest.

With a lobe of roughness ρ and reflectance k_s on a flat surface, the photo leaves

    k_d = (I - k_s·B(ρ) - A(ρ)) π/E

for the diffuse albedo. If the lobe is wrong, the screen's pattern stays behind in k_d. So (ρ, k_s) are
those for which the rest of the photo varies least from pixel to pixel, channel by channel, since
light baked in can only add to the variation of an albedo that has nothing to do with the pattern.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.backend import dr, vector
from invrender.maps import Maps, constant_maps
from invrender.render import Tables, Unbiased, shade
from invrender.scene import make_view

Array = NDArray[np.floating[Any]]
ROUGHNESS = (0.05, 0.1, 0.16, 0.23, 0.32, 0.42, 0.55, 0.7, 0.9)
SPECULAR = np.array([0.02, 0.04, 0.06, 0.1, 0.16, 0.25, 0.36, 0.5, 0.65, 0.8, 0.9, 1.0])
PLAUSIBLE = 0.03  # how much less variation an unusual lobe must leave than a usual one


def flat_maps(photo: Array, prepared: Tables | Unbiased, samples: int = 64) -> Maps:
    """Maps of a flat sample for a photo (H, W, 3) of it, linear radiance."""
    height, width = photo.shape[:2]
    # Half the pixels a side: the lobe is one number, and noise varies from pixel to pixel too.
    step = max(1, min(height, width) // 128)
    small = ndimage.uniform_filter(photo, (step, step, 1))[step // 2 :: step, step // 2 :: step]
    best: tuple[float, float, Array] | None = None
    for rho in ROUGHNESS:
        e, b, a = plane_terms(prepared, *small.shape[:2], rho, samples)
        cost, k_s = np.zeros(3), np.zeros(3)
        for c in range(3):
            rest = [
                _variation((small[..., c] - k * b[..., c] - a[..., c]), e[..., c] / np.pi)
                * (1 + PLAUSIBLE * (abs(np.log(k / 0.04)) + abs(rho - 0.5)))
                for k in SPECULAR
            ]
            cost[c], k_s[c] = min(rest), SPECULAR[int(np.argmin(rest))]
        if best is None or cost.sum() < best[0]:
            best = float(cost.sum()), rho, k_s
    assert best is not None
    _, rho, k_s = best
    e, b, a = plane_terms(prepared, height, width, rho, samples)
    rest = photo - k_s * b - a
    maps = constant_maps(height, width, 0.0, k_s, rho)
    # What a surface mirrors it cannot scatter too: k_d ≤ 1 - k_s.
    maps.diffuse = np.clip(rest * np.pi / np.maximum(e, 1e-12), 0, 1 - k_s).astype(np.float32)
    return maps


def plane_terms(
    prepared: Tables | Unbiased, height: int, width: int, rho: float, samples: int
) -> tuple[Array, Array, Array]:
    """E, B and A (each (H, W, 3)) of a flat sample of roughness ``rho``."""
    scalar = prepared.scene.scalar
    view = make_view(prepared.scene, height, width)
    shading = shade(
        prepared, view, dr.opaque(scalar, rho), vector(scalar, 3)(0, 0, 1), samples
    )
    e, b, a = (
        np.asarray(x).T.reshape(height, width, 3)
        for x in (shading.irradiance, shading.b, shading.a)
    )
    return e, b, a


def _variation(rest: Array, irradiance: Array) -> float:
    """Mean absolute difference of neighbouring albedos, negative ones counted as light too many."""
    albedo = rest / np.maximum(irradiance, 1e-12)
    steps = np.abs(np.diff(albedo, axis=0)).mean() + np.abs(np.diff(albedo, axis=1)).mean()
    return float(steps + 2 * np.maximum(-albedo, 0).mean() + np.maximum(albedo - 1, 0).mean())
