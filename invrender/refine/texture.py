"""The roughness that leaves none of the light's pattern in the albedo.

A network's albedo explains the photo with the network's roughness ρ, whatever that is: where it is
wrong by δ, the light that the lobe lacks stands in the albedo. With k the albedo that explains each
pixel, T = (∂I/∂ρ)/(∂I/∂k) and L likewise of the room, whose strength is off by ε,

    k = k_true + δ·T + ε·L.

A sample knows nothing of the light that falls on it, so k_true follows neither. All pixels of
dielectrics together tell δ, by least squares on the differences of neighbouring parts' means, of
the mean colour and of two across it. How well is told by the texture itself: what it shows of T
mirrored and turned, in which no δ stands, is the error of δ, and so is what parts of other sizes
find. Parts at the edge of another material differ by much and count little (Student's t).

Where a material's roughness goes with its albedo, as that of wet or worn places does, δ is β times
details of log k, and T makes these stronger under some of the light and weaker under other light.
So β is found in the same way, of the details of k.

Either the maps are right, or the first network was, whose roughness a correction has changed, or
neither: three priors of δ, and the photo chooses. That a lobe is narrower than the maps' shows more
surely than that it is wider, which half of the photos that say so are wrong about; a screen that is
elsewhere than it was found makes narrow lobes seem wider too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from invrender.refine.gauss_newton import Observation, linearise
from invrender.refine.plain import details, texture_details
from invrender.refine.priors import Prior
from invrender.refine.theta import D, N, R, dielectric_share, is_dielectric, project
from invrender.sampling import centres, resize
from invrender.types import TINY, Array


@dataclass(frozen=True)
class Settings:
    """Chosen by hand on 66 simulated photographs
    (docs/research-log/2026-11-30-starts-and-the-light-in-the-albedo.md), `wider` on 117
    (docs/research-log/2026-11-30-roughness-kept-and-found.md), the last five on 128
    (docs/research-log/2026-11-30-roughness-that-goes-with-the-albedo.md)."""

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
    freedom: float = 4.0  # Student's, of the difference of two parts
    normal_median: float = 0.455  # of the square of what is normal, over its variance
    varied: float = 0.16  # deviation of β, of the mean roughness
    matt: float = 0.5  # roughness from which that grows no more
    varied_error: float = 1.5  # times what is measured of β, its error


TEXTURE_SETTINGS = Settings()


@dataclass(frozen=True)
class Measured:
    """δ, its variance, and T (h, w, 3) of a plane; β and its variance."""

    delta: float
    variance: float
    light: Array
    slope: float = 0.0
    slope_variance: float = np.inf


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
    rho = float(np.average(prior.mean[..., R], weights=weight))
    precisions = []
    for o, m in zip(observations, found, strict=True):
        variance = m.variance + s.doubt**2
        if m.delta > 0:  # a screen elsewhere widens the lobe as relief does
            wider = float(np.sqrt(np.hypot(rho**2, o.pose))) - rho
            variance = s.wider**2 * m.variance + s.doubt**2 + wider**2
        precisions.append(1 / variance)
    measured = sum(m.delta * p for m, p in zip(found, precisions, strict=True)) / sum(precisions)
    usual, back = (
        float(np.average(x, weights=weight))
        for x in (prior.expected[..., R], first - prior.mean[..., R])
    )
    starts = ((0.0, s.near), (back, s.near), (0.0, usual))
    delta, variance = _chosen(measured, 1 / sum(precisions), starts, s.starts)
    light = resize(np.mean([m.light for m in found], 0), *weight.shape)
    theta, total = prior.mean.copy(), prior.expected.copy()
    told = [1 / (s.varied_error**2 * m.slope_variance) for m in found]
    expected = (s.varied * min(rho, s.matt)) ** 2
    slope = sum(m.slope * p for m, p in zip(found, told, strict=True)) / (sum(told) + 1 / expected)
    change = weight * np.float32(delta + slope * texture_details(theta))
    theta[..., R] += change
    theta[..., D] -= change[..., None] * light
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
    slope = _follows(k, light, texture_details(theta), weight, inner)
    return Measured(float(delta), float(variance + scatter), light, *slope)


def _follows(
    k: Array, light: Array, texture: Array, weight: Array, inner: tuple[slice, ...]
) -> tuple[float, float]:
    """β and its variance, by images (h, w, 3) of k and T and details of log k (h, w)."""
    weight, found = weight[inner].ravel(), details(k)[inner]
    flat = np.stack([np.ones_like(weight), texture[inner].ravel()], 1)
    inverse = np.linalg.pinv((flat * weight[:, None]).T @ flat)

    def without_texture(image: Array) -> Array:
        """Colours (pixels, 3) by the root of their weight, without what any light shows of it."""
        colours = image.reshape(len(weight), -1)
        left = colours - flat @ (inverse @ (flat.T @ (weight[:, None] * colours)))
        return np.asarray(np.sqrt(weight)[:, None] * left)

    y = without_texture(found)
    noise = np.mean(y**2, 0) + TINY

    def seen(t: Array) -> tuple[float, float]:
        """What T shows: the precision of β, and that times β."""
        x = without_texture(details(texture[..., None] * (t - t[inner].mean((0, 1))))[inner])
        return float((x * x / noise).sum()) + TINY, float((x * y / noise).sum())

    precision, product = seen(light)
    others = [seen(t) for t in _turned(light)]
    spread = float(np.mean([b**2 / a for a, b in others]))
    return product / precision, max(spread, 1.0) / precision


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
    trust = [np.ones_like(each) for each in y]
    for _ in range(s.rounds):
        hessian, gradient = np.diag([TINY, 1.0]), np.zeros(2)
        for each, column, v, w in zip(y, columns, noise, trust, strict=True):
            weighted = (w[:, None] * column).T / v
            hessian += weighted @ column
            gradient += weighted @ each
        best = np.linalg.solve(hessian, gradient)
        left = [each - column @ best for each, column in zip(y, columns, strict=True)]
        trust = [_trust(r, s) for r in left]
        noise = [
            (
                float(np.mean([(w * r @ u) ** 2 / (u @ u + TINY) for u in ways]))
                + float(r @ r) / r.size
            )
            / 2
            + TINY
            for r, w, ways in zip(left, trust, turned, strict=True)
        ]
    return best[0], np.linalg.inv(hessian)[0, 0]


def _trust(left: Array, s: Settings) -> Array:
    """Weights of residuals, by Student's t of the deviation that their median tells."""
    variance = float(np.median(left**2)) / s.normal_median + TINY
    return np.asarray((s.freedom + 1) / (s.freedom + left**2 / variance))


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
