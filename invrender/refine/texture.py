"""The roughness that leaves none of the light's pattern in the albedo.

A network's albedo explains the photo with the network's roughness ρ, whatever that is: where it is
wrong by δ, the light that the lobe lacks stands in the albedo. With k the albedo that explains each
pixel, T = (∂I/∂ρ)/(∂I/∂k) and L likewise of the room, whose strength is off by ε,

    k = k_true + δ·T + ε·L.

A sample knows nothing of the light that falls on it, so k_true follows neither. All pixels of
dielectrics together tell δ, by least squares on the differences of neighbouring parts' means, of
the mean colour and of two across it. How well is told by the texture itself: what it shows of T
mirrored and turned, in which no δ stands, is the error of δ, and so is what parts of other sizes
find.

Either the maps are right, or the first network was, whose roughness a correction has changed, or
neither: three priors of δ, and the photo chooses. That a lobe is narrower than the maps' shows more
surely than that it is wider, which half of the photos that say so are wrong about.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from invrender.refine.gauss_newton import Observation, linearise
from invrender.refine.priors import Prior
from invrender.refine.theta import D, N, R, dielectric_share, is_dielectric, project
from invrender.sampling import centres, resize
from invrender.types import TINY, Array


@dataclass(frozen=True)
class Settings:
    """Chosen by hand on 66 simulated photographs
    (docs/research-log/2026-11-30-starts-and-the-light-in-the-albedo.md), `wider` on 117
    (docs/research-log/2026-11-30-roughness-kept-and-found.md)."""

    side: int = 128  # pixels a side that are judged
    parts: tuple[int, ...] = (6, 7, 8, 9, 10)  # a side, whose means are compared
    margin: float = 0.04  # of the side, at the border, that is not judged
    least_fill: float = 0.3  # of a part that is dielectric
    least_light: float = 0.2  # of a plane's, that a pixel gets
    rounds: int = 4  # of least squares and of the weights of colours
    doubt: float = 0.02  # of what is measured of δ: lights, relief
    starts: tuple[float, ...] = (1, 1, 2)  # odds of these maps, of the first network's, of neither
    near: float = 0.015  # deviation of δ where a start is right
    wider: float = 3.0  # times its error that a δ above nought is off by
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
    first: Array,
    *,
    samples: int = 64,
    s: Settings = TEXTURE_SETTINGS,
) -> Prior:
    """The prior, of maps that explain the photos, with the roughness that the light's pattern in
    the albedo tells, and the albedo that it leaves.

    first: roughness (H, W) as it was before a correction.
    """
    weight = dielectric_share(prior.mean)
    if not is_dielectric(weight):
        return prior
    found = [measure_light(o, prior.mean, weight, samples, s) for o in observations]
    times = [1 if m.delta < 0 else s.wider for m in found]
    precisions = [1 / (t**2 * m.variance + s.doubt**2) for t, m in zip(times, found, strict=True)]
    measured = sum(m.delta * p for m, p in zip(found, precisions, strict=True)) / sum(precisions)
    usual, back = (
        float(np.average(x, weights=weight))
        for x in (prior.expected[..., R], first - prior.mean[..., R])
    )
    starts = ((0.0, s.near), (back, s.near), (0.0, usual))
    delta, variance = _chosen(measured, 1 / sum(precisions), starts, s.starts)
    light = resize(np.mean([m.light for m in found], 0), *weight.shape)
    theta, total = prior.mean.copy(), prior.expected.copy()
    theta[..., R] += weight * np.float32(delta)
    theta[..., D] -= delta * weight[..., None] * light
    left = min(1.0, variance / usual**2)  # of the expected variance
    total[..., R] *= np.sqrt(1 - s.shared_error * (1 - left) * weight)
    return replace(prior, mean=project(theta), total=total)


def _chosen(
    measured: float, variance: float, starts: Sequence[tuple[float, float]], odds: Sequence[float]
) -> tuple[float, float]:
    """Mean and variance of what is measured with that variance, whose prior is a mixture of
    Gaussians: means and deviations of ``starts``, and their odds."""
    mean, deviation = np.array(starts).T
    spread = variance + deviation**2
    likely = np.array(odds) * np.exp(-((measured - mean) ** 2) / (2 * spread)) / np.sqrt(spread)
    likely /= likely.sum()
    each = (measured * deviation**2 + mean * variance) / spread
    best = float(likely @ each)
    return best, float(likely @ (deviation**2 * variance / spread + (each - best) ** 2))


def measure_light(
    o: Observation, theta: Array, weight: Array, samples: int = 64, s: Settings = TEXTURE_SETTINGS
) -> Measured:
    """What a photo tells of maps θ (H, W, 9), whose pixels count by their weight (H, W)."""
    at = np.ix_(*(centres(min(s.side, n), n) for n in weight.shape))
    theta, weight, photo = theta[at], weight[at], o.photo[at]
    if o.clipped is not None:
        weight = weight * ~o.clipped[at]
    plane = np.broadcast_to(np.median(theta, (0, 1)), theta.shape).astype(np.float32)
    plane[..., N] = 0
    image, jacobian = linearise(o.renderer, theta, samples)
    flat = linearise(o.renderer, plane, samples)[1]
    room = linearise(o.renderer.scaled(0.0, 1.0), plane, samples)[0] * o.doubt[1]
    own, of = (np.maximum(j[..., range(3), range(3)], TINY) for j in (jacobian, flat))
    light = flat[..., R] / of
    weight = weight * (own > s.least_light * of).all(-1)
    k = np.clip(theta[..., D] + (photo - image) / own, -1, 2)
    inner = tuple(slice(int(s.margin * n), n - int(s.margin * n)) for n in weight.shape)
    images = [x[inner] for x in (k, light, room / of)]
    found = np.array([_regress(images, weight[inner], parts, s) for parts in s.parts])
    (delta, variance), scatter = found.mean(0), found[:, 0].var()
    return Measured(float(delta), float(variance + scatter), light)


def _regress(
    images: Sequence[Array], weight: Array, parts: int, s: Settings
) -> tuple[float, float]:
    """δ and its variance by images (h, w, 3) of k, T and L and their means of so many parts a
    side; L has the deviation that is expected of ε in it."""
    size = tuple(min(parts, n) for n in weight.shape)
    fill = resize(weight, *size)
    k, t, room = (
        resize(weight[..., None] * x, *size) / np.maximum(fill, TINY)[..., None] for x in images
    )
    fill = np.where(fill > s.least_fill, fill, 0)
    colour = (fill[..., None] * k).sum((0, 1))
    axes = np.linalg.svd(np.outer(colour, colour))[0].T
    y, *x = ([_differences(image @ axis, fill) for axis in axes] for image in (k, t, room))
    columns = [np.stack(both, 1) for both in zip(*x, strict=True)]
    turned = [[_differences(u, fill) for u in _turned(t @ axis)] for axis in axes]
    noise = [float(each @ each) / max(each.size, 1) + TINY for each in y]
    for _ in range(s.rounds):
        hessian, gradient = np.diag([TINY, 1.0]), np.zeros(2)
        for each, column, v in zip(y, columns, noise, strict=True):
            hessian += column.T @ column / v
            gradient += column.T @ each / v
        best = np.linalg.solve(hessian, gradient)
        left = [each - column @ best for each, column in zip(y, columns, strict=True)]
        noise = [
            float(np.mean([(r @ u) ** 2 / (u @ u + TINY) for u in ways])) + TINY
            for r, ways in zip(left, turned, strict=True)
        ]
    return best[0], np.linalg.inv(hessian)[0, 0]


def _differences(image: Array, fill: Array) -> Array:
    """Of neighbouring parts (h, w), by how full both are."""
    found = []
    for axis, n in enumerate(image.shape):
        first, second = (fill.take(range(i, i + n - 1), axis) for i in (0, 1))
        found.append((np.diff(image, axis=axis) * np.sqrt(first * second)).ravel())
    return np.concatenate(found).astype(np.float64)


def _turned(image: Array) -> Iterator[Array]:
    """An image (h, w) mirrored and turned in every way that keeps its shape, but as it is."""
    for k in (0, 1, 2, 3) if image.shape[0] == image.shape[1] else (0, 2):
        turned = np.rot90(image, k)
        if k:
            yield turned
        yield turned[:, ::-1]
