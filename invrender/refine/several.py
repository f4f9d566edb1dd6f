"""The maps that explain several photos of one sample: their joint posterior at full strength.

Three numbers a pixel leave most to the networks (`invrender.refine.posterior`); six photos have
eighteen for nine unknowns, and measure them. With the photos Iᵢ, pixel by pixel,

    θ = argmin Σᵢ ρ(‖photoᵢ - Iᵢ(θ)‖²_Rᵢ) + ‖θ - θ₀‖²_Σ,

by damped Gauss–Newton steps (Levenberg–Marquardt, each pixel its own damping). ρ is Geman and
McClure's loss, which forgets what no lights explain, such as a shadow. The prior is wide where
photos measure, so that the network is only where the search starts: slopes and the diffuse albedo.
What is dielectric keeps its f0, and a metal scatters nothing. Roughness is expected to be what the
photos say of all pixels of the material together (`invrender.refine.shared_roughness`).

Each photo's noise and its light are what the others leave of it: Rᵢ grows with its residuals, and
a factor a colour, which changes evenly across the photo, is taken out. A photo whose residuals are
far beyond the others' is left out. Slopes are expected to be as large a share of the initial ones
as the photos show, and spread about that as they show: none on a flat sample. A pixel's noise is at
least as large as what θ leaves of its photos.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from invrender.refine.enlarge import fitting
from invrender.refine.flat import USUAL_ROUGHNESS, flat_maps
from invrender.refine.gauss_newton import BAND, Observation, Refined, linearise
from invrender.refine.pixels import (
    TOGETHER,
    Photo,
    Point,
    Problem,
    Settings,
    free_share,
    noise_of,
    wide_deviations,
)
from invrender.refine.priors import Prior, channel_correlation
from invrender.refine.registration import factor_image, find_factors
from invrender.refine.shared_roughness import Pooled, pool_roughness
from invrender.refine.theta import D, N, R, S, project, to_maps, to_theta
from invrender.sampling import centres, resize, resize_pattern
from invrender.types import TINY, Array

COMPARED_CELLS = 16  # a side, by which patterns are compared


def by_pattern(patterns: Sequence[Array], known: Array) -> list[int]:
    """Which photos come first, by how like their patterns are to one that the networks know; as
    they stand where that is the same."""
    known = resize_pattern(known, COMPARED_CELLS)
    unlike = [float(np.abs(resize_pattern(p, COMPARED_CELLS) - known).mean()) for p in patterns]
    return sorted(range(len(patterns)), key=lambda i: round(unlike[i], 2))


def plain_prior(observations: Sequence[Observation], samples: int, s: Settings = TOGETHER) -> Prior:
    """A flat sample's prior, without what networks say: theirs is of a display's light. Its diffuse
    albedo is the photos' median, its roughness what explains them; but where bare metal of its hue
    explains the photos of an area better by far, it is that. What is black has no hue."""
    flat = [flat_maps(o.photo, o.renderer, samples) for o in observations]
    theta = to_theta(flat[0])
    theta[..., D] = np.median([f.diffuse for f in flat], 0)
    photos = [Photo.of(o) for o in observations]
    metal = theta.copy()
    colour = theta[..., D] + s.black
    metal[..., S] = np.clip(colour / colour.mean(-1, keepdims=True) * s.metal_start, 0, 1)
    metal[..., D] = 0
    costs = []
    for trial in (theta, metal):
        problem = _small(photos, trial, s.roughness, samples, s)
        cost = problem.search(problem.mean, s.tried)[0].cost
        costs.append(ndimage.uniform_filter(cost, s.area, mode="nearest"))
    share = np.asarray(costs[1] < s.metal_better * costs[0], np.float32)
    is_metal = resize(share[..., None], *theta.shape[:2]) > 0.5
    theta[..., R] = _flat_roughness(photos, theta, samples, s)
    theta = np.where(is_metal, metal, theta).astype(np.float32)
    sigma = wide_deviations(theta, np.full(theta.shape[:2], s.roughness, np.float32), s)
    return Prior(theta, sigma, channel_correlation(*s.correlation))


def _flat_roughness(photos: Sequence[Photo], theta: Array, samples: int, s: Settings) -> float:
    """Of the roughnesses with which a flat sample explains the photos about as well as with any,
    the commonest: lamps that no pixel mirrors leave a mirror and a matt sample alike."""
    costs = []
    for rho in s.flat_roughness:
        problem = _small(photos, theta, s.fixed, samples, replace(s, slope=s.flat_slope))
        problem.mean[..., R] = rho
        costs.append(float(problem.solve(problem.mean, s.tried)[0].cost.mean()))
    able = np.array(s.flat_roughness)[np.array(costs) <= s.about_as_well * min(costs)]
    return float(able[np.argmin(np.abs(able - USUAL_ROUGHNESS))])


@dataclass
class Found:
    """The mode θ (H, W, 9) of the pixels under materials and their priors; maps and their expected
    errors, of what that and the initial maps say; the photos' errors; and whether it converged."""

    mode: Array
    theta: Array
    sigma: Array
    photo_errors: list[float]
    converged: bool = True


def explain_together(
    observations: Sequence[Observation],
    prior: Prior,
    *,
    samples: int = 64,
    progress: Callable[[float], None] = lambda share: None,
    s: Settings = TOGETHER,
) -> Refined:
    """The mode of the posterior of two photos or more, registered, from a prior's mean.

    Of the prior, its mean says where to start and what is metal. Ctrl-C ends it with what was found
    so far. ``progress`` is told the share done.
    """
    began = time.perf_counter()
    theta = project(prior.mean.copy())
    result = Refined(to_maps(theta), prior.expected.copy())
    try:
        photos, result.left_out, wide = _calibrate(observations, theta, samples, s)
        photos, share, spread = _lights_and_relief(photos, theta, wide, samples, s)
        progress(0.1)
        theta[..., N] *= share
        s = replace(s, slope=spread)
        found = _explain_all(photos, theta, prior.expected, samples, progress, s)
        result.maps, result.sigma = to_maps(found.theta), found.sigma
        result.photo_errors, result.converged = found.photo_errors, found.converged
        error = float(np.sqrt(np.mean(np.square(found.photo_errors))))
        result.history = [{"seconds": time.perf_counter() - began, "photo_error": error}]
    except KeyboardInterrupt:
        result.interrupted = True
    return result


def _explain_all(
    photos: Sequence[Photo], theta: Array, sigma: Array, samples: int,
    progress: Callable[[float], None], s: Settings,
) -> Found:  # fmt: skip
    """From initial maps θ and their expected errors. A large image starts from itself shrunk."""
    height, width = theta.shape[:2]
    if max(height, width) > s.whole:
        low = fitting(theta, s.whole)
        coarse = project(resize(theta, *low))
        few = [p.shrunk(*low) for p in photos]
        found = _explain_all(few, coarse, resize(sigma, *low), samples, progress, s)
        mode, shares = project(theta + resize(found.mode - coarse, height, width)), s.spread[-1:]
    else:
        mode, shares = theta, s.spread
    pooled = _pool(photos, theta, mode, sigma[..., R], samples, s)
    for k, own in enumerate(shares):
        if k:  # materials are told apart by what was found, in which there is less light
            pooled = _pool(photos, theta, mode, sigma[..., R], samples, s)
        found = _solve_all(photos, pooled, own, theta, mode, sigma, samples, s)
        mode = found.mode
        progress(0.1 + 0.9 * (k + 1) / len(shares))
    return found


def _small(photos: Sequence[Photo], theta: Array, rho: float, samples: int, s: Settings) -> Problem:
    """The problem of few pixels of all, with the deviation of their roughness."""
    size = min(s.grid, len(theta)), min(s.grid, theta.shape[1])
    at = np.ix_(*(centres(n, of) for n, of in zip(size, theta.shape, strict=False)))
    mean = theta[at]
    sigma = wide_deviations(mean, np.full(size, rho, np.float32), s)
    few = [p.at(*size) for p in photos]
    return Problem(few, mean, sigma, slice(0, size[0]), size[0], samples, s)


def _calibrate(
    observations: Sequence[Observation], theta: Array, samples: int, s: Settings
) -> tuple[list[Photo], list[int], Array]:
    """The photos with their noise, by what the others leave of them; which are left out; and θ of
    few pixels as they show it with next to no prior."""
    photos = dict(enumerate(map(Photo.of, observations)))
    while True:
        problem = _small(list(photos.values()), theta, s.roughness, samples, s)
        point, _ = problem.search(problem.mean, s.tried)
        if len(photos) > 2:
            factors = find_factors(problem, point, np.zeros((len(photos), 3, 3)))
            exposed = [_without_factor(*p) for p in zip(photos.values(), factors, strict=True)]
            problem = _small(exposed, theta, s.roughness, samples, s)
            point, _ = problem.solve(point.theta, s.tried)
        scatter = noise_of(point.misfit, s)
        excess = [
            own / max(float(np.median(np.delete(scatter, i))), 1e-6) if len(photos) > 2 else 0.0
            for i, own in enumerate(scatter)
        ]
        worst = int(np.argmax(excess))
        if excess[worst] < s.bad or scatter[worst] * s.photo_noise[0] < s.bad_at_least:
            break
        del photos[list(photos)[worst]]
    scatter = np.maximum(scatter, 1.0)
    noisy = [replace(p, noise=float(k)) for p, k in zip(photos.values(), scatter, strict=True)]
    return noisy, [i for i in range(len(observations)) if i not in photos], point.theta


def _lights_and_relief(
    photos: Sequence[Photo], theta: Array, wide: Array, samples: int, s: Settings
) -> tuple[list[Photo], float, float]:
    """The photos without their own factors, with the noise that is left then; and of the slopes the
    share of the initial ones, θ's, that photos show, and the spread about it. wide: of
    `_calibrate`.

    A factor that changes across a photo looks like slopes of all pixels; so factors are found with
    slopes that spread no more than the photos show.
    """
    factors: Array = np.zeros((len(photos), 3, 3))
    noise = np.array([p.noise for p in photos])
    found, share, spread = list(photos), 1.0, s.slope
    for _ in range(s.rounds):
        problem = _small(found, theta, s.roughness, samples, s)
        point, _ = problem.solve(wide, s.tried)
        wide = point.theta
        share, spread = _relief(point, problem, s)
        narrow = _small(found, theta, s.roughness, samples, replace(s, slope=spread))
        narrow.mean[..., N] *= share
        point, _ = narrow.solve(wide, s.tried)
        noise = np.maximum(noise * noise_of(point.misfit, s, narrow.left_free(point)), 1.0)
        factors = find_factors(narrow, point, factors)
        found = [
            replace(_without_factor(p, f), noise=float(k))
            for p, f, k in zip(photos, factors, noise, strict=True)
        ]
    return found, share, spread


def _without_factor(photo: Photo, factor: Array) -> Photo:
    """The photo, its factor divided out."""
    o = photo.observation
    shown = o.photo / factor_image(factor, *o.photo.shape[:2])
    return replace(photo, observation=replace(o, photo=shown))


def _pool(
    photos: Sequence[Photo], theta: Array, mode: Array, sigma: Array, samples: int, s: Settings
) -> Pooled:
    """The roughness of the sample's materials, which are told apart by what was found, ``mode``;
    sigma: the error (H, W) that is expected of θ's roughness."""
    problem = _small(photos, theta, s.fixed, samples, s)
    size = problem.mean.shape[:2]
    at = np.ix_(*(centres(n, of) for n, of in zip(size, sigma.shape, strict=True)))

    def solve(rho: float, start: Array) -> tuple[Array, Array]:
        problem.mean[..., R] = rho
        start = start.copy()
        start[..., R] = rho
        point, _ = problem.solve(start, s.tried)
        return point.theta, point.cost

    return pool_roughness(_features_of(mode, theta)[at], sigma[at], solve)


def _features_of(mode: Array, theta: Array) -> Array:
    """By what materials are told apart: what was found, but the initial roughness."""
    both = mode.copy()
    both[..., R] = theta[..., R]
    return both


def _relief(point: Point, problem: Problem, s: Settings) -> tuple[float, float]:
    """The share of the initial slopes that photos show, and the deviation of the slopes from it:
    regression and moments, without the error of what is found with next to no prior."""
    variance = np.linalg.inv(point.hessian)[..., (7, 8), (7, 8)]
    initial, slopes = problem.mean[..., N], point.theta[..., N]
    weight = 1 / (variance + s.least_slope**2)
    share = float((weight * slopes * initial).sum() / max((weight * initial**2).sum(), TINY))
    share = float(np.clip(share, 0, s.most_share))
    square = (slopes - share * initial) ** 2
    excess = float((weight * (square - variance)).sum() / weight.sum())
    return share, float(np.clip(np.sqrt(max(excess, 0)), s.least_slope, s.slope))


def _solve_all(
    photos: Sequence[Photo], pooled: Pooled, own: float, theta: Array, mode: Array, sigma: Array,
    samples: int, s: Settings,
) -> Found:  # fmt: skip
    """Solve all pixels, from ``mode``; own: the share of roughness' spread that is the pixels'."""
    height, width = theta.shape[:2]
    rho, spread = pooled.roughness(_features_of(mode, theta))
    spread = np.maximum(own * spread, s.least_roughness)
    mean = theta.copy()
    mean[..., R] = rho
    prior = wide_deviations(mean, spread, s)
    # What networks know of the diffuse albedo is worth something where photos do not measure it.
    prior[..., D] = np.minimum(
        prior[..., D], np.maximum(s.trusted * sigma[..., D], s.least_diffuse)
    )
    found = Found(mode.copy(), theta.copy(), sigma.copy(), [])
    found.mode[..., R] = rho
    squares, seen = np.zeros(len(photos)), np.zeros(len(photos))
    large = max(height, width) > s.whole
    rows = max(1, BAND // width)
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        problem = Problem(photos, mean[band], prior[band], band, height, samples, s)
        solve, steps = (problem.solve, s.few) if large else (problem.search, s.steps)
        point, done = solve(found.mode[band], steps)
        found.converged &= done
        found.mode[band] = point.theta
        weighed, covariance = _weighed(problem, point)
        found.theta[band] = project(weighed)
        variance = np.einsum("hwpp->hwp", covariance)
        variance[..., :6] += (s.lights_error * point.theta[..., :6]) ** 2
        found.sigma[band] = np.sqrt(variance)
        for i, photo in enumerate(photos):
            o = photo.observation
            image, _ = linearise(o.renderer, found.theta[band], samples, top=top, height=height)
            use = np.ones(image.shape[:2], bool) if o.clipped is None else ~o.clipped[band]
            squares[i] += float(((o.photo[band] - image)[use] ** 2).mean(-1).sum(dtype=np.float64))
            seen[i] += use.sum()
    means = np.array([p.mean for p in photos])
    found.photo_errors = list(np.sqrt(squares / np.maximum(seen, 1)) / means)
    return found


def _weighed(problem: Problem, point: Point) -> tuple[Array, Array]:
    """θ (h, W, 9) and its covariance, with noise as large as what θ leaves of a pixel's photos.

    What no θ explains, such as relief finer than a pixel, has measured little: there the prior
    counts for most.
    """
    s = problem.s
    misfit = np.minimum(point.misfit, s.most_misfit)
    trust = ((1 + misfit / s.unlikely) ** -2).mean(0)  # what it counts for already
    misfit = misfit.mean(0) / free_share(len(misfit))
    misfit = np.maximum(misfit, ndimage.median_filter(misfit, s.around, mode="nearest"))
    excess = np.maximum(misfit * trust, 1.0)[..., None]
    wide = problem.prior_precision()
    drawn = np.einsum("hwpq,hwq->hwp", wide, point.theta - problem.mean)
    data = (point.hessian - wide) / excess[..., None]
    pull = (point.gradient + drawn) / excess - drawn
    covariance = np.linalg.inv(data + wide)
    return point.theta + np.einsum("hwpq,hwq->hwp", covariance, pull), covariance
