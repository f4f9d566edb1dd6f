"""Maps as the refinement's nine unknowns a pixel: albedos, roughness and two slopes."""

from __future__ import annotations

import numpy as np

from invrender.maps import Maps
from invrender.types import Array

D, S, R, N = slice(0, 3), slice(3, 6), 6, slice(7, 9)  # places of the parameters in θ
MIN_FITTED_ROUGHNESS = 0.03
MAX_SLOPE = 3.0  # 72 degrees
DIELECTRIC_TO_METAL = 0.08, 0.15  # f0 of the last sure dielectric, and of the first sure metal
# Of a sample that counts as dielectric, at least: pixels beside metal have some of its light.
DIELECTRIC_PART = 0.9


def to_theta(maps: Maps) -> Array:
    """θ (H, W, 9) of maps."""
    slopes = maps.normal[..., :2] / np.maximum(maps.normal[..., 2:], 0.1)
    parts = [maps.diffuse, maps.specular, maps.roughness[..., None], slopes]
    return _in_range(np.concatenate(parts, -1).astype(np.float32))


def to_maps(theta: Array) -> Maps:
    """Maps of θ."""
    normal = np.concatenate([theta[..., N], np.ones_like(theta[..., :1])], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    parts = (theta[..., D], theta[..., S], theta[..., R], normal)
    return Maps(*(np.ascontiguousarray(p, dtype=np.float32) for p in parts))


def deviations(sigma: Array) -> dict[str, Array]:
    """Standard deviation of each map from those of θ (H, W, 9); of normals that of n/2 + 1/2."""
    slopes = np.sqrt(np.mean(sigma[..., N] ** 2, -1)) / 2
    parts = {"diffuse": sigma[..., D], "specular": sigma[..., S], "roughness": sigma[..., R]}
    return {k: np.ascontiguousarray(v, np.float32) for k, v in {**parts, "normal": slopes}.items()}


def dielectric_share(theta: Array) -> Array:
    """How surely each pixel of θ is a dielectric's, by its f0: (H, W) from 0 to 1."""
    low, high = DIELECTRIC_TO_METAL
    return np.clip((high - theta[..., S].mean(-1)) / (high - low), 0, 1)


def is_dielectric(share: Array) -> bool:
    """Whether a sample is, by the `dielectric_share` of its pixels."""
    return bool(share.mean() >= DIELECTRIC_PART)


def project(theta: Array) -> Array:
    """θ within its physical range, in place: what a surface mirrors it cannot scatter too."""
    _in_range(theta)
    theta[..., D] = np.minimum(theta[..., D], 1 - theta[..., S])
    return theta


def _in_range(theta: Array) -> Array:
    theta[..., :6] = np.clip(theta[..., :6], 0, 1)
    theta[..., R] = np.clip(theta[..., R], MIN_FITTED_ROUGHNESS, 1)
    slope = np.linalg.norm(theta[..., N], axis=-1, keepdims=True)
    theta[..., N] *= np.minimum(1, MAX_SLOPE / np.maximum(slope, 1e-9))
    return theta
