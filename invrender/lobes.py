"""The specular lobe of each material of a sample, from all of its pixels at once.

For a flat sample of one material the photo is I_c = k_d,c·E_c/π + k_s,c·B_c(ρ) + A_c(ρ): linear in
the albedos once ρ is given. The pattern makes E, B and A differ from place to place and colour to
colour, so many pixels together tell the lobe that one cannot: the roughness that leaves the least,
of a list, and its k_s by least squares. First for the sample as a whole, then for each group of
pixels of like albedo. Relief widens the lobe that is found.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from invrender.initial import USUAL_ROUGHNESS, USUAL_SPECULAR, diffuse_rest, plane_terms
from invrender.maps import Maps
from invrender.render import Tables, Unbiased

Array = NDArray[np.floating[Any]]
Labels = NDArray[np.intp]
ROUGHNESS = np.array([0.05, 0.1, 0.16, 0.23, 0.32, 0.42, 0.55, 0.7, 0.85, 1.0])
SPREAD = 0.25  # of ρ around its usual value
SPREAD_F0 = (0.02, 0.1)  # of k_s: as usual, or anything
UNUSUAL_F0 = 6  # by how much -2 log-likelihood must fall for a lobe of another f0
FIT_SIZE = 128  # pixels a side of the fit: what decides is as wide as the pattern's features
MEASUREMENTS = 100.0  # that a photo's worth of pixels counts for: texture repeats
MATERIALS, ROUNDS = 4, 2


def fit_lobes(photo: Array, prepared: Tables | Unbiased, samples: int = 64) -> Maps:
    """Maps of a flat sample with up to `MATERIALS` lobes for a photo (H, W, 3), linear radiance."""
    height, width = photo.shape[:2]
    h, w = min(FIT_SIZE, height), min(FIT_SIZE, width)
    rows = ((np.arange(h) + 0.5) / h * height).astype(int)
    columns = ((np.arange(w) + 0.5) / w * width).astype(int)
    small = photo[np.ix_(rows, columns)]
    terms = [plane_terms(prepared, h, w, float(rho), samples) for rho in ROUGHNESS]
    everywhere = np.ones((h, w), bool)
    lobe = np.full((h, w), -1)
    usual = USUAL_ROUGHNESS, np.full(3, USUAL_SPECULAR)
    rho, k_s = _fit(small, terms, everywhere, usual, MEASUREMENTS)
    lobe[:], f0 = rho, np.broadcast_to(k_s, (h, w, 3)).copy()
    albedo = _diffuse(small, terms, lobe, f0)
    label, centres = np.zeros((h, w), np.intp), np.zeros((1, 3))
    for _ in range(ROUNDS):
        label, centres = _group(albedo)
        for k in range(len(centres)):
            of = label == k
            if of.any():
                whole = float(ROUGHNESS[rho]), k_s
                lobe[of], f0[of] = _fit(small, terms, of, whole, MEASUREMENTS * of.mean())
        albedo = _diffuse(small, terms, lobe, f0)

    # To full size: each pixel takes the lobe of the group to which its albedo belongs.
    near = np.ix_(
        np.minimum((np.arange(height) * h) // height, h - 1),
        np.minimum((np.arange(width) * w) // width, w - 1),
    )
    roughness, specular = ROUGHNESS[lobe][near].astype(np.float32), f0[near].astype(np.float32)
    diffuse = np.zeros_like(photo, dtype=np.float32)
    for rho in np.unique(lobe):
        of = roughness == np.float32(ROUGHNESS[rho])
        full = plane_terms(prepared, height, width, float(ROUGHNESS[rho]), samples)
        diffuse[of] = diffuse_rest(photo, full, specular)[of]
    normal = np.zeros((height, width, 3), np.float32)
    normal[..., 2] = 1
    return Maps(diffuse, specular, roughness, normal)


def _diffuse(photo: Array, terms: list[Any], lobe: Labels, f0: Array) -> Array:
    albedo = np.zeros_like(photo)
    for k in np.unique(lobe):
        of = lobe == k
        albedo[of] = diffuse_rest(photo, terms[k], f0)[of]
    return albedo


def _group(albedo: Array) -> tuple[Labels, Array]:
    """Labels (H, W) of pixels of like albedo, by k-means on its square root."""
    points = np.sqrt(albedo.reshape(-1, 3)).astype(np.float64)
    if len(np.unique(points.round(3), axis=0)) < 10 * MATERIALS:
        return np.zeros(albedo.shape[:2], np.intp), points[:1]
    centres, label = kmeans2(points, MATERIALS, minit="++", rng=np.random.default_rng(0))
    return label.reshape(albedo.shape[:2]), centres


def _fit(
    photo: Array, terms: list[Any], of: Any, usual: tuple[float, Array], measurements: float
) -> tuple[int, Array]:
    """Index of the roughness and f0 (3,) of the pixels ``of``, drawn to the usual."""
    pixels = photo[of]
    level = photo.mean((0, 1)) + 1e-12
    weight = 1 / np.sqrt(level * (pixels + 0.1 * level))
    n = len(ROUGHNESS)
    # Two hypotheses: a lobe as usual, or any f0. -2 log-likelihood of each at each roughness.
    cost, f0 = np.zeros((2, n)), np.zeros((2, n, 3))
    for i, (e, b, a) in enumerate(terms):
        for c in range(3):
            w = weight[:, c]
            x, y, z = w * e[of][:, c] / np.pi, w * b[of][:, c], w * (pixels[:, c] - a[of][:, c])
            variance = _least_squares(x, y, z, 0.0, 0.0)[1]
            for k, spread in enumerate(SPREAD_F0):
                pull = variance / measurements / spread**2
                f0[k, i, c], residual = _least_squares(x, y, z, pull, float(usual[1][c]))
                cost[k, i] += residual / 3
    cost = measurements * np.log(cost + 1e-9) + ((ROUGHNESS - usual[0]) / SPREAD) ** 2
    cost[1] += UNUSUAL_F0
    k, best = np.unravel_index(np.argmin(cost), cost.shape)
    return int(best), f0[k, best]


def _least_squares(x: Array, y: Array, z: Array, pull: float, usual: float) -> tuple[float, float]:
    """k_s of z ≈ k_d·x + k_s·y with both in [0, 1], and the mean squared residual.

    pull: weight of (k_s - usual)².
    """
    xx, xy, xz = (x * x).mean() + 1e-20, (x * y).mean(), (x * z).mean()
    yy, yz = (y * y).mean() + pull + 1e-20, (y * z).mean() + pull * usual
    k_d = np.clip((yy * xz - xy * yz) / max(xx * yy - xy * xy, 1e-30), 0, 1)
    k_s = float(np.clip((yz - xy * k_d) / yy, 0, 1))
    k_d = np.clip((xz - xy * k_s) / xx, 0, 1)
    return k_s, float(((z - k_d * x - k_s * y) ** 2).mean())
