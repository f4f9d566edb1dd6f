"""Refinement: from initial maps and their uncertainty to the maps that explain the photo.

First what all pixels of a material tell together (`invrender.lobes`), unless the initial maps know
better; then each pixel's nine parameters θ = (k_d, k_s, ρ, slopes p and q of n ∝ (p, q, 1)) at the
maximum of their posterior,

    photo ~ N(I(θ), R),     θ ~ N(θ₀, Σ),

by damped Gauss–Newton steps with the exact Jacobian J of the forward model. They are taken in the
three-dimensional space of the photo, like a Kalman filter's,

    θ ← θ₀ + ΣJᵀ(JΣJᵀ + R)⁻¹ (photo - I(θ) + J(θ - θ₀)),

so where the photo says nothing about a parameter, J is small and the parameter keeps its prior
value; and Σ - ΣJᵀ(JΣJᵀ + R)⁻¹JΣ is the uncertainty that remains.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.backend import Float, dr, vector
from invrender.maps import Maps
from invrender.render import Material, Tables, Unbiased, pixel_jacobian
from invrender.scene import make_view

Array = NDArray[np.floating[Any]]
D, S, R, N = slice(0, 3), slice(3, 6), 6, slice(7, 9)  # places of the parameters in θ

MIN_ROUGHNESS = 0.03
MAX_SLOPE = 3.0  # 72 degrees
PHOTO_NOISE = (0.02, 0.01)  # relative to the pixel, and to the photo's mean: sensor and model
TRUST = (0.1, 0.2)  # how far one step may move roughness and slopes
SHARE = np.array([1] * 6 + [0] + [0.2] * 2, np.float32)  # of its step that each of θ takes
LIGHT_NOISE = (0.1, 0.05)  # as PHOTO_NOISE, for what the lights' estimate adds to it
UNLIKELY = 1.0  # mean squared residual, in its expected spread, from which a pixel counts less
STOP = 0.02  # relative decrease of the mean cost below which steps end
ROUNDING = 1e-5  # of the prior variance: what single precision can tell of the rest


@dataclass
class Prior:
    """What is known of θ before the photo is fitted: a Gaussian a pixel.

    mean, sigma: (H, W, 9) in the order of θ; correlation: (9, 9), of the deviations.
    """

    mean: Array
    sigma: Array
    correlation: Array


@dataclass
class Refined:
    """Maps, their posterior standard deviations (H, W, 9) in the order of θ, how the fit went."""

    maps: Maps
    sigma: Array
    history: list[dict[str, float]] = field(default_factory=list)
    converged: bool = False


def lobe_prior(maps: Maps) -> Prior:
    """The uncertainty within a material of maps from `invrender.lobes`: mostly shade and relief."""
    mean = to_theta(maps)
    sigma = np.zeros_like(mean)
    metal = np.clip((maps.specular - 0.06) / 0.3, 0, 1)
    sigma[..., D] = 0.01 + 0.05 * maps.diffuse
    sigma[..., S] = 0.002 + 0.05 * metal
    sigma[..., R], sigma[..., N] = 0.02, 0.05
    correlation = np.eye(9)
    for k, r in ((D, 0.98), (S, 0.95)):  # an albedo's channels vary together
        correlation[k, k] = r + (1 - r) * np.eye(3)
    return Prior(mean, sigma, correlation.astype(np.float32))


def network_prior(maps: Maps, sigma: dict[str, Array]) -> Prior:
    """The uncertainty of a network's maps, from what it expects of its errors, (H, W) a map.

    ``sigma`` of normals is that of n/2 + 1/2. An albedo's error within a material is at most a
    share of it.
    """
    mean = to_theta(maps)
    spread = np.empty_like(mean)
    spread[..., D] = np.minimum(sigma["diffuse"][..., None], 0.01 + 0.15 * maps.diffuse)
    spread[..., S] = np.minimum(sigma["specular"][..., None], 0.01 + 0.3 * maps.specular)
    spread[..., R] = sigma["roughness"]
    spread[..., N] = 2 * sigma["normal"][..., None]
    correlation = np.eye(9)
    for k, r in ((D, 0.9), (S, 0.95)):
        correlation[k, k] = r + (1 - r) * np.eye(3)
    return Prior(mean, np.maximum(spread, 1e-4), correlation.astype(np.float32))


def to_theta(maps: Maps) -> Array:
    """θ (H, W, 9) of maps."""
    slopes = maps.normal[..., :2] / np.maximum(maps.normal[..., 2:], 0.1)
    parts = [maps.diffuse, maps.specular, maps.roughness[..., None], slopes]
    return project(np.concatenate(parts, -1).astype(np.float32))


def to_maps(theta: Array) -> Maps:
    """Maps of θ."""
    normal = np.concatenate([theta[..., N], np.ones_like(theta[..., :1])], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    parts = (theta[..., D], theta[..., S], theta[..., R], normal)
    return Maps(*(np.ascontiguousarray(p, dtype=np.float32) for p in parts))


def project(theta: Array) -> Array:
    """θ within its physical range, in place."""
    theta[..., :6] = np.clip(theta[..., :6], 0, 1)
    theta[..., R] = np.clip(theta[..., R], MIN_ROUGHNESS, 1)
    slope = np.linalg.norm(theta[..., N], axis=-1, keepdims=True)
    theta[..., N] *= np.minimum(1, MAX_SLOPE / np.maximum(slope, 1e-9))
    return theta


def linearise(
    prepared: Tables | Unbiased, theta: Array, samples: int, seed: int = 0
) -> tuple[Array, Array]:
    """Radiance (H, W, 3) at θ (H, W, 9) and its Jacobian (H, W, 3, 9)."""
    h, w = theta.shape[:2]
    flat = np.ascontiguousarray(theta.reshape(-1, 9).T)
    vec3 = vector(Float, 3)
    normal = vec3(Float(flat[7]), Float(flat[8]), Float(1))
    material = Material(vec3(flat[:3]), vec3(flat[3:6]), Float(flat[6]), normal)
    j = pixel_jacobian(prepared, make_view(prepared.scene, h, w, seed), material, samples)
    slope_p = j.tangent_s * j.s.x + j.tangent_t * j.t.x
    slope_q = j.tangent_s * j.s.y + j.tangent_t * j.t.y
    dr.eval(j.radiance, j.diffuse, j.specular, j.roughness, slope_p, slope_q)

    def rows(x: Any) -> Array:
        return np.asarray(x).T.reshape(h, w, 3)

    jacobian = np.zeros((h, w, 3, 9), np.float32)
    for c in range(3):
        jacobian[..., c, c] = rows(j.diffuse)[..., c]
        jacobian[..., c, 3 + c] = rows(j.specular)[..., c]
    for k, derivative in ((R, j.roughness), (7, slope_p), (8, slope_q)):
        jacobian[..., k] = rows(derivative)
    return rows(j.radiance).copy(), np.nan_to_num(jacobian, posinf=0, neginf=0)


def _noise(
    photo: Array, mean: float, share: tuple[float, float], clipped: NDArray[np.bool_] | None
) -> Array:
    """Variance (H, W, 3) of the photo: shares of the pixel and of the mean, or nothing measured."""
    noise = (share[0] * photo) ** 2 + (share[1] * mean) ** 2
    if clipped is not None:
        noise = np.where(clipped[..., None], np.float32(1e12) * mean**2, noise)
    return noise


def _photo_error(residual: Array, mean: float, clipped: NDArray[np.bool_] | None) -> float:
    """RMS residual of what the photo measures, over its mean."""
    seen = residual if clipped is None else residual[~clipped]
    return float(np.sqrt(np.mean(seen**2))) / mean if seen.size else 0.0


def refine(
    photo: Array,
    prepared: Tables | Unbiased,
    prior: Prior,
    *,
    samples: int = 64,
    iterations: int = 10,
    clipped: NDArray[np.bool_] | None = None,
    progress: Callable[[int, float], None] = lambda i, error: None,
) -> Refined:
    """The pixels' maximum a posteriori for a photo (H, W, 3) of the sample, linear radiance.

    clipped (H, W): pixels that the photo does not measure; they keep their prior. Starts at the
    prior's mean, stops when a step lowers the mean cost by less than `STOP`. A pixel whose step
    would raise its cost stays, and tries a shorter one next.
    """
    began = time.perf_counter()
    mean = max(float(photo.mean()), 1e-12)
    noise = _noise(photo, mean, PHOTO_NOISE, clipped)
    sigma, correlation = prior.sigma, prior.correlation
    precision = np.linalg.inv(correlation)

    def evaluate(theta: Array) -> tuple[Array, Array, Array]:
        image, jacobian = linearise(prepared, theta, samples)
        z = (theta - prior.mean) / sigma
        residual = photo - image
        misfit = (residual**2 / noise).sum(-1)
        return residual, jacobian, misfit + np.einsum("hwp,pq,hwq->hw", z, precision, z)

    theta = project(prior.mean.copy())
    residual, jacobian, cost = evaluate(theta)
    length = np.ones(cost.shape, np.float32)
    result = Refined(to_maps(theta), sigma)
    for i in range(iterations + 1):
        error = _photo_error(residual, mean, clipped)
        seconds = time.perf_counter() - began
        result.history.append(
            {"seconds": seconds, "photo_error": error, "cost": float(cost.mean())}
        )
        progress(i, error)
        if i and result.history[-2]["cost"] - cost.mean() <= STOP * cost.mean():
            result.converged = True
            break
        if i == iterations:
            break
        a = jacobian * sigma[..., None, :]
        ac = a @ correlation
        spread = ac @ np.swapaxes(a, -1, -2)
        spread[..., range(3), range(3)] += noise
        gain = np.swapaxes(ac, -1, -2) @ np.linalg.inv(spread)
        z = (theta - prior.mean) / sigma
        target = residual + np.einsum("hwcp,hwp->hwc", a, z)
        step = sigma * (np.einsum("hwpc,hwc->hwp", gain, target) - z)
        step[..., R] = np.clip(step[..., R], -TRUST[0], TRUST[0])
        step[..., N] = np.clip(step[..., N], -TRUST[1], TRUST[1])
        trial = project(theta + length[..., None] * step)
        new = evaluate(trial)
        better = new[2] < cost
        for old, fresh in zip((theta, residual, jacobian, cost), (trial, *new), strict=True):
            old[better] = fresh[better]
        length = np.where(better, np.minimum(2 * length, 1), length / 4)
        left = 1 - np.einsum("hwpc,hwcp->hwp", gain, ac)
        result.sigma = sigma * np.sqrt(np.clip(left, ROUNDING, 1))
    result.maps = to_maps(theta)
    return result


def correct(
    photo: Array,
    prepared: Tables | Unbiased,
    prior: Prior,
    *,
    samples: int = 64,
    clipped: NDArray[np.bool_] | None = None,
) -> Refined:
    """One cautious step from a prior whose errors are shared by whole materials.

    A network errs alike over a material, so what a pixel's own three numbers say of roughness or
    slopes is mostly an error of something else. As in the Schmidt–Kalman filter, every parameter's
    uncertainty counts in the expected spread of the residual, but each takes only its `SHARE` of
    the step. The posterior is that of this suboptimal gain K: (1 - KJ)Σ(1 - KJ)ᵀ + KRKᵀ.
    """
    began = time.perf_counter()
    mean = max(float(photo.mean()), 1e-12)
    noise = _noise(photo, mean, LIGHT_NOISE, clipped)
    theta = project(prior.mean.copy())
    image, jacobian = linearise(prepared, theta, samples)
    residual = photo - image
    a = jacobian * prior.sigma[..., None, :]
    ac = a @ prior.correlation
    spread = ac @ np.swapaxes(a, -1, -2)
    spread[..., range(3), range(3)] += noise
    inverse = np.linalg.inv(spread)
    surprise = np.einsum("hwc,hwcd,hwd->hw", residual, inverse, residual) / 3
    trust = np.sqrt(np.minimum(1, UNLIKELY / np.maximum(surprise, 1e-12)))
    gain = SHARE[:, None] * trust[..., None, None] * (np.swapaxes(ac, -1, -2) @ inverse)
    z = np.einsum("hwpc,hwc->hwp", gain, residual)
    theta = project((theta + prior.sigma * z).astype(np.float32))
    rest = np.eye(9, dtype=np.float32) - gain @ a
    variance = np.einsum("hwpq,qr,hwpr->hwp", rest, prior.correlation, rest)
    measured = np.where(noise > 1e6 * mean**2, 0, noise)  # where clipped, the gain is nought
    variance += np.einsum("hwpc,hwc,hwpc->hwp", gain, measured, gain)
    error = _photo_error(residual, mean, clipped)
    history = [{"seconds": time.perf_counter() - began, "photo_error": error}]
    sigma = prior.sigma * np.sqrt(np.clip(variance, 0, None))
    return Refined(to_maps(theta), sigma, history, converged=True)


if __name__ == "__main__":
    from invrender.cli import main

    sys.exit(main(["refine", *sys.argv[1:]]))
