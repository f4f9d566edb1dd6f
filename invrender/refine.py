"""Refinement: from initial maps and their uncertainty to the maps that explain the photo.

The posterior of each pixel's nine parameters θ = (k_d, k_s, ρ, slopes p and q of n ∝ (p, q, 1)):

    photo ~ N(I(θ), R),     θ = θ₀ + δ_material + δ_pixel,   δ ~ N(0, Σ),

maximised by iterated Gauss–Newton steps in the three-dimensional space of the photo, with the exact
Jacobian J of the forward model,

    θ ← θ₀ + ΣJᵀ(JΣJᵀ + R)⁻¹ (photo - I(θ) + J(θ - θ₀)).

Where the photo says nothing about a parameter, J is small and the parameter keeps its initial value.
The offset that pixels of one material share is found first, from all of them at once: each sees
another part of the pattern, and together they pin down what a single pixel cannot.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from invrender.backend import Float, dr, vector
from invrender.maps import Maps
from invrender.render import Material, Tables, Unbiased, pixel_jacobian
from invrender.scene import make_view

Array = NDArray[np.floating[Any]]
D, S, R, N = slice(0, 3), slice(3, 6), 6, slice(7, 9)  # places of the parameters in θ

MIN_ROUGHNESS = 0.03
MAX_SLOPE = 3.0  # 72 degrees
PHOTO_NOISE = (0.02, 0.01)  # relative to the pixel, and to the photo's mean: sensor and model


@dataclass
class Prior:
    """How far the truth may lie from the initial maps: standard deviations.

    Arrays (H, W, 9) in the order of θ, or anything that broadcasts to it. ``shared``: the part of
    it that pixels of one material have in common.
    """

    pixel: Array
    shared: Array


@dataclass
class Refined:
    """Maps, their posterior standard deviations (H, W, 9) and how the fit went."""

    maps: Maps
    sigma: Array
    history: list[dict[str, float]] = field(default_factory=list)
    converged: bool = False


def flat_prior(start: Maps) -> Prior:
    """The uncertainty of `invrender.initial.flat_maps`: one lobe, no relief, light left in k_d."""
    h, w = start.shape
    pixel, shared = np.zeros((h, w, 9), np.float32), np.zeros((h, w, 9), np.float32)
    metal = np.clip((start.specular - 0.06) / 0.3, 0, 1)
    pixel[..., D], shared[..., D] = 0.02 + 0.3 * start.diffuse, 0.03 + 0.1 * start.diffuse
    pixel[..., S], shared[..., S] = 0.002 + 0.1 * metal, 0.005 + 0.1 * metal
    pixel[..., R], shared[..., R] = 0.06, 0.2
    pixel[..., N], shared[..., N] = 0.15, 0.01
    return Prior(pixel, shared)


def to_theta(maps: Maps) -> Array:
    """θ (H, W, 9) of maps."""
    slopes = maps.normal[..., :2] / np.maximum(maps.normal[..., 2:], 0.1)
    return np.concatenate(
        [maps.diffuse, maps.specular, maps.roughness[..., None], slopes], -1
    ).astype(np.float32)


def to_maps(theta: Array) -> Maps:
    """Maps of θ, within their physical ranges."""
    normal = np.concatenate([theta[..., N], np.ones_like(theta[..., :1])], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Maps(
        np.clip(theta[..., D], 0, 1),
        np.clip(theta[..., S], 0, 1),
        np.clip(theta[..., R], MIN_ROUGHNESS, 1),
        normal.astype(np.float32),
    )


def _project(theta: Array) -> Array:
    theta[..., :6] = np.clip(theta[..., :6], 0, 1)
    theta[..., R] = np.clip(theta[..., R], MIN_ROUGHNESS, 1)
    slope = np.linalg.norm(theta[..., N], axis=-1, keepdims=True)
    theta[..., N] *= np.minimum(1, MAX_SLOPE / np.maximum(slope, 1e-9))
    return theta


def linearise(
    prepared: Tables | Unbiased, theta: Array, samples: int, seed: int = 0
) -> tuple[Array, Array]:
    """Radiance (H, W, 3) at θ and its Jacobian (H, W, 3, 9)."""
    h, w = theta.shape[:2]
    flat = np.ascontiguousarray(theta.reshape(-1, 9).T)
    vec3 = vector(Float, 3)
    normal = vec3(Float(flat[7]), Float(flat[8]), Float(1))
    material = Material(vec3(flat[:3]), vec3(flat[3:6]), Float(flat[6]), normal)
    j = pixel_jacobian(prepared, make_view(prepared.scene, h, w, seed), material, samples)
    slope_p = j.tangent_s * j.s.x + j.tangent_t * j.t.x
    slope_q = j.tangent_s * j.s.y + j.tangent_t * j.t.y
    dr.schedule(j.radiance, j.diffuse, j.specular, j.roughness, slope_p, slope_q)
    rows = lambda x: np.asarray(x).T.reshape(h, w, 3)  # noqa: E731
    jacobian = np.zeros((h, w, 3, 9), np.float32)
    for c in range(3):
        jacobian[..., c, c] = rows(j.diffuse)[..., c]
        jacobian[..., c, 3 + c] = rows(j.specular)[..., c]
    jacobian[..., R], jacobian[..., 7], jacobian[..., 8] = map(
        rows, (j.roughness, slope_p, slope_q)
    )
    return rows(j.radiance).copy(), jacobian


def materials(start: Maps, photo: Array, count: int) -> NDArray[np.intp]:
    """Labels (H, W) of pixels that look alike in their initial maps."""
    theta = to_theta(start)[..., :7].reshape(-1, 7).astype(np.float64)
    theta[:, D] = np.sqrt(theta[:, D])
    theta /= np.maximum(theta.std(0), 0.05)
    if count < 2 or len(theta) < 50 * count:
        return np.zeros(start.shape, np.intp)
    rng = np.random.default_rng(0)
    some = theta[rng.choice(len(theta), min(len(theta), 4096), replace=False)]
    centres, _ = kmeans2(some, count, minit="++", rng=rng)
    distance = ((theta[:, None] - centres[None]) ** 2).sum(-1)
    return distance.argmin(1).reshape(start.shape)


def refine(
    photo: Array,
    prepared: Tables | Unbiased,
    start: Maps,
    prior: Prior,
    *,
    samples: int = 64,
    iterations: int = 12,
    clipped: NDArray[np.bool_] | None = None,
    progress: Callable[[int, float], None] = lambda i, error: None,
) -> Refined:
    """Refine maps for a photo (H, W, 3) of the sample, linear radiance.

    clipped (H, W): pixels that the photo does not measure. Stops when a step changes the photo
    error by less than 1%.
    """
    began = time.perf_counter()
    h, w = start.shape
    theta0 = to_theta(start)
    theta, offset = theta0.copy(), np.zeros_like(theta0)
    label = materials(start, photo, 6)
    mean = max(float(photo.mean()), 1e-12)
    noise = (PHOTO_NOISE[0] * photo) ** 2 + (PHOTO_NOISE[1] * mean) ** 2
    if clipped is not None:
        noise = np.where(clipped[..., None], 1e6 * mean**2, noise)
    result = Refined(start, prior.pixel)
    last = np.inf
    for i in range(iterations + 1):
        image, jacobian = linearise(prepared, theta, samples)
        residual = photo - image
        seen = residual if clipped is None else residual[~clipped]
        error = float(np.sqrt(np.mean(seen**2))) / mean
        result.history.append({"seconds": time.perf_counter() - began, "photo_error": error})
        progress(i, error)
        if i == iterations or abs(last - error) < 0.01 * error:
            result.converged = i < iterations
            break
        last = error
        # Huber: a residual that noise and prior cannot explain counts less.
        pixel = prior.pixel**2
        spread = np.einsum("hwcp,hwp,hwdp->hwcd", jacobian, pixel, jacobian)
        spread[..., range(3), range(3)] += noise
        linear = residual + np.einsum("hwcp,hwp->hwc", jacobian, theta - theta0)
        weight = np.linalg.inv(spread)
        offset = _shared_offset(label, jacobian, weight, linear, prior.shared)
        rest = linear - np.einsum("hwcp,hwp->hwc", jacobian, offset)
        step = np.einsum("hwp,hwcp,hwcd,hwd->hwp", pixel, jacobian, weight, rest)
        new = theta0 + offset + step
        theta = _project(theta + _limit(new - theta))
        result.sigma = np.sqrt(
            np.maximum(
                pixel
                - np.einsum("hwp,hwcp,hwcd,hwdp,hwp->hwp", pixel, jacobian, weight, jacobian, pixel),
                0,
            )
        )
    result.maps = to_maps(theta)
    return result


def _limit(step: Array) -> Array:
    """Trust region: how far one linearisation may move roughness and slopes."""
    step[..., R] = np.clip(step[..., R], -0.1, 0.1)
    step[..., N] = np.clip(step[..., N], -0.2, 0.2)
    return step


def _shared_offset(
    label: NDArray[np.intp], jacobian: Array, weight: Array, linear: Array, shared: Array
) -> Array:
    """The offset that the pixels of each material share, (H, W, 9), by generalised least squares."""
    offset = np.zeros_like(shared)
    for k in range(int(label.max()) + 1):
        of = label == k
        if not of.any():
            continue
        jw = np.einsum("ncp,ncd->ndp", jacobian[of], weight[of])
        information = np.einsum("ndp,ndq->pq", jw, jacobian[of]).astype(np.float64)
        force = np.einsum("ndp,nd->p", jw, linear[of]).astype(np.float64)
        scale = shared[of].mean(0).astype(np.float64)
        # Pixels side by side share texture and relief: count every one in eight as independent.
        a = information / 8 * scale[:, None] * scale[None] + np.eye(9)
        offset[of] = (scale * np.linalg.solve(a, force / 8 * scale)).astype(np.float32)
    return offset
