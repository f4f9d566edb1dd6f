"""The roughness that leaves none of the light's pattern in the albedo.

A network's albedo explains the photo with the network's roughness ρ, whatever that is: where it is
wrong by δ, the light that the lobe lacks stands in the albedo. With k the albedo that explains each
pixel and T = (∂I/∂ρ)/(∂I/∂k),

    k = k_true + δ·T.

A sample knows nothing of the light that falls on it, so k_true does not follow T. All pixels of
dielectrics together tell δ, by least squares on the differences of neighbouring parts' means, of
the mean colour and of two across it. How well is told by the texture itself: what it shows of T
mirrored and turned, in which no δ stands, is the error of δ.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from invrender.refine.gauss_newton import Observation, linearise
from invrender.refine.priors import Prior
from invrender.refine.theta import D, N, R, dielectric_share, project
from invrender.sampling import centres, resize
from invrender.types import TINY, Array


@dataclass(frozen=True)
class Settings:
    """Chosen by hand on 42 simulated photographs
    (docs/research-log/2026-11-30-light-in-the-albedo.md)."""

    side: int = 128  # pixels a side that are judged
    parts: int = 8  # a side, whose means are compared
    margin: float = 0.04  # of the side, at the border, that is not judged
    least_fill: float = 0.3  # of a part that is dielectric
    least_part: float = 0.9  # of the sample that is: pixels beside metal have some of its light
    least_light: float = 0.2  # of a plane's, that a pixel gets
    roughness: float = 0.05  # deviation of δ that is expected
    doubt: float = 0.02  # of what is measured of it: lights, relief
    times: float = 3.0  # by which its own error exceeds what the texture tells
    shared_error: float = 0.5  # of a network's squared error that a material shares


TEXTURE_SETTINGS = Settings()


@dataclass(frozen=True)
class Measured:
    """δ, its variance, and T (h, w, 3) of a plane."""

    delta: float
    variance: float
    light: Array


def without_light(
    observations: Sequence[Observation],
    prior: Prior,
    *,
    samples: int = 64,
    s: Settings = TEXTURE_SETTINGS,
) -> Prior:
    """The prior, of maps that explain the photos, with the roughness that the light's pattern in
    the albedo tells, and the albedo that it leaves."""
    weight = dielectric_share(prior.mean)
    if weight.mean() < s.least_part:
        return prior
    found = [measure_light(o, prior.mean, weight, samples, s) for o in observations]
    precisions = [1 / (s.times**2 * m.variance + s.doubt**2) for m in found]
    left = 1 / (1 + s.roughness**2 * sum(precisions))  # of the expected variance
    weighted = sum(m.delta * p for m, p in zip(found, precisions, strict=True))
    delta = np.float32(weighted * left * s.roughness**2)
    light = resize(np.mean([m.light for m in found], 0), *weight.shape)
    theta, total = prior.mean.copy(), prior.expected.copy()
    theta[..., R] += delta * weight
    theta[..., D] -= delta * weight[..., None] * light
    total[..., R] *= np.sqrt(1 - s.shared_error * (1 - left) * weight)
    return replace(prior, mean=project(theta), total=total)


def measure_light(
    o: Observation, theta: Array, weight: Array, samples: int = 64, s: Settings = TEXTURE_SETTINGS
) -> Measured:
    """What a photo tells of maps θ (H, W, 9), whose pixels count by their weight (H, W)."""
    at = np.ix_(*(centres(min(s.side, n), n) for n in weight.shape))
    theta, weight, photo = theta[at], weight[at], o.photo[at]
    if o.clipped is not None:
        weight = weight * ~o.clipped[at]
    plane = theta.copy()
    plane[..., N], plane[..., R] = 0, np.median(theta[..., R])
    image, jacobian = linearise(o.renderer, theta, samples)
    flat = linearise(o.renderer, plane, samples)[1]
    own, of = (np.maximum(j[..., range(3), range(3)], TINY) for j in (jacobian, flat))
    light = flat[..., R] / of
    weight = weight * (own > s.least_light * of).all(-1)
    k = np.clip(theta[..., D] + (photo - image) / own, -1, 2)
    inner = tuple(slice(int(s.margin * n), n - int(s.margin * n)) for n in weight.shape)
    parts = tuple(min(s.parts, n) for n in weight[inner].shape)
    fill = resize(weight[inner], *parts)
    k, t = (
        resize(weight[inner][..., None] * x[inner], *parts) / np.maximum(fill, TINY)[..., None]
        for x in (k, light)
    )
    fill = np.where(fill > s.least_fill, fill, 0)
    colour = (fill[..., None] * k).sum((0, 1))
    tops = bottoms = 0.0
    for axis in np.linalg.svd(np.outer(colour, colour))[0].T:
        y, x = (_differences(image @ axis, fill) for image in (k, t))
        delta = _slope(y, x)
        seen = [_slope(y - delta * x, _differences(u, fill)) for u in _turned(t @ axis)]
        variance = float(np.mean(np.square(seen))) + TINY
        tops, bottoms = tops + delta / variance, bottoms + 1 / variance
    variance = 1 / bottoms if fill.any() else np.inf
    return Measured(tops / bottoms, variance, light)


def _differences(image: Array, fill: Array) -> Array:
    """Of neighbouring parts (h, w), by how full both are."""
    found = []
    for axis, n in enumerate(image.shape):
        first, second = (fill.take(range(i, i + n - 1), axis) for i in (0, 1))
        found.append((np.diff(image, axis=axis) * np.sqrt(first * second)).ravel())
    return np.concatenate(found).astype(np.float64)


def _slope(y: Array, x: Array) -> float:
    """Of y against x by least squares."""
    return float((x @ y) / (x @ x + TINY))


def _turned(image: Array) -> Iterator[Array]:
    """An image (h, w) mirrored and turned in every way that keeps its shape, but as it is."""
    for k in (0, 1, 2, 3) if image.shape[0] == image.shape[1] else (0, 2):
        turned = np.rot90(image, k)
        if k:
            yield turned
        yield turned[:, ::-1]
