"""The maps that explain several photos of one sample: their joint posterior at full strength.

Three numbers a pixel leave most to the networks (`invrender.refine.posterior`); six photos have
eighteen for nine unknowns, and measure them. With the photos Iᵢ, pixel by pixel,

    θ = argmin Σᵢ ρ(‖photoᵢ - Iᵢ(θ)‖²_Rᵢ) + ‖θ - θ₀‖²_Σ,

by damped Gauss–Newton steps (Levenberg–Marquardt, each pixel its own damping). ρ is Geman and
McClure's loss, which forgets what no lights explain, such as a shadow. The prior is wide where
photos measure, so that the network is only where the search starts: slopes and the diffuse albedo.
What is dielectric keeps its f0, and a metal scatters nothing. Roughness is expected to be what the
photos say of all pixels of the material together (`invrender.refine.shared_roughness`).

Each photo's noise and its exposure are what the others leave of it: Rᵢ grows with its residuals,
and a factor a colour is taken out. A photo whose residuals are far beyond the others' is left out.
Sums over the photos are kept, not their Jacobians: memory does not grow with their number.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from invrender.maps import Maps, map_errors, turn_maps
from invrender.refine.gauss_newton import BAND, Observation, Refined, linearise
from invrender.refine.priors import Prior, channel_correlation
from invrender.refine.shared_roughness import Pooled, pool_roughness
from invrender.refine.theta import D, N, R, S, project, to_maps
from invrender.sampling import centres, resize, resize_pattern
from invrender.types import TINY, Array

CLEARLY = 0.9  # how much nearer the turned maps must be
COMPARED_CELLS = 16  # a side, by which patterns are compared
MOST = 1e12  # mean squared residual over its variance, so that its square is finite
FREE_DIFFUSE = 1.15  # k_d, as it is solved for
CHI_SQUARED_QUARTILE = 1.213  # the lower one, of three degrees of freedom


@dataclass(frozen=True)
class Settings:
    """Numbers of the joint posterior, chosen by hand on simulated photos of eight held-out
    materials (docs/research-log/2026-11-29-several-photos.md)."""

    photo_noise: tuple[float, float] = (0.01, 0.004)  # of the pixel and the photo's mean, at least
    quantile: float = 0.25  # of the residuals, by which noise is judged: many pixels may be lost
    exposure: float = 0.05  # deviation of the logarithm of a photo's factor a colour
    exposure_found: float = 0.02  # and of what is found of it
    unlikely: float = 9.0  # mean squared residual over its variance that counts half
    diffuse: float = 0.3  # prior deviations of θ, of a dielectric
    dielectric_f0: float = 0.01
    roughness: float = 0.25
    slope: float = 0.6  # at most, of what the photos show of the relief
    least_slope: float = 0.05
    tails: float = 2.0  # times their spread that slopes are expected to have: most pixels are flat
    metal_diffuse: float = 0.01  # and of a metal
    metal_f0: float = 0.3
    f0_range: tuple[float, float] = (0.08, 0.2)  # surely dielectric; surely metal
    correlation: tuple[float, float] = (0.9, 0.95)  # of the colours of k_d, and of k_s
    fixed: float = 0.01  # prior deviation of a roughness that is tried
    tried: int = 3  # steps for each of these
    blurred: float = 0.45  # roughness with which narrower lobes are looked for first
    forgiving: float = 100.0  # times `unlikely`, for the first steps
    lost: float = 20.0  # mean squared residual over its variance of a pixel at no optimum
    few_lost: float = 0.02  # share of such pixels from which other slopes are tried
    slopes: tuple[float, ...] = (0.35, 0.9)
    directions: int = 6
    steps: int = 8  # at most
    few: int = 3  # steps where a smaller size was solved before
    stop: float = 0.003  # relative decrease of the cost below which steps end
    trust: tuple[float, float, float] = (0.3, 0.15, 0.3)  # most that a step moves k, ρ, slopes
    damping: tuple[float, float] = (0.01, 5.0)  # first; factor by which it changes
    grid: int = 32  # pixels a side by which photos and materials are judged
    whole: int = 256  # pixels a side above which a smaller size is solved first
    bad: float = 4.0  # times the other photos' residuals that a photo to be left out has
    bad_at_least: float = 0.15  # and its residual, of its mean
    lights_error: float = 0.03  # relative, of all albedos: what the lights' scale may be off by


TOGETHER = Settings()


def find_turn(maps: Maps, first: Maps) -> int:
    """Quarters, counter-clockwise, by which the sample lies turned against the first photo's.

    maps, first: what either photo alone gave, in its own frame. A sample that looks the same from
    all sides counts as not turned.
    """
    errors = [map_errors(turn_maps(maps, -k), first)["average"] for k in range(4)]
    best = int(np.argmin(errors))
    return best if errors[best] < CLEARLY * errors[0] else 0


def by_pattern(patterns: Sequence[Array], known: Array) -> list[int]:
    """Which photos come first, by how like their patterns are to one that the networks know; as
    they stand where that is the same."""
    known = resize_pattern(known, COMPARED_CELLS)
    unlike = [float(np.abs(resize_pattern(p, COMPARED_CELLS) - known).mean()) for p in patterns]
    return sorted(range(len(patterns)), key=lambda i: round(unlike[i], 2))


def likeliest(
    observations: Sequence[Observation],
    priors: Sequence[Prior],
    samples: int,
    s: Settings = TOGETHER,
) -> Prior:
    """The prior whose slopes and roughness leave the least of all photos, albedos being free."""
    if len(priors) == 1:
        return priors[0]
    photos, costs = [_Photo.of(o) for o in observations], []
    for prior in priors:
        problem = _small(photos, project(prior.mean.copy()), s.fixed, samples, s)
        problem.sigma[..., N] = s.fixed
        point, _ = problem.solve(problem.mean, s.few)
        costs.append(float(point.cost.mean()))
    return priors[int(np.argmin(costs))]


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
    sigma = prior.expected.copy()
    result = Refined(to_maps(theta), sigma)
    try:
        photos, left_out = _calibrate(observations, theta, samples, s)
        progress(0.1)
        pooled = _pool(photos, theta, sigma[..., R], samples, s)
        s = replace(s, slope=_relief(photos, pooled, theta, samples, s))
        progress(0.4)
        errors, result.converged = _solve_all(photos, pooled, theta, sigma, samples, s)
        result.photo_errors, result.left_out = errors, left_out
        error = float(np.sqrt(np.mean(np.square(errors))))
        result.history = [{"seconds": time.perf_counter() - began, "photo_error": error}]
    except KeyboardInterrupt:
        result.interrupted = True
    result.maps = to_maps(theta)
    return result


@dataclass(frozen=True)
class _Photo:
    """A photo, its exposure divided out, with its noise in units of `Settings.photo_noise`."""

    observation: Observation
    mean: float
    noise: float = 1.0

    @classmethod
    def of(cls, observation: Observation) -> _Photo:
        return cls(observation, max(float(observation.photo.mean()), TINY))

    def variance(self, rows: slice, s: Settings) -> Array:
        """Of the noise of the photo's rows (h, W, 3); next to infinite where it is saturated."""
        pixel, floor = s.photo_noise
        o = self.observation
        variance = (pixel * o.photo[rows]) ** 2 + np.float32(floor * self.mean) ** 2
        variance *= np.float32(self.noise) ** 2
        if o.clipped is not None:
            variance[o.clipped[rows]] = 1e12 * self.mean**2
        return variance

    def at(self, height: int, width: int) -> _Photo:
        """The pixels nearest to the centres of so few."""
        o = self.observation
        at = np.ix_(centres(height, len(o.photo)), centres(width, o.photo.shape[1]))
        clipped = None if o.clipped is None else o.clipped[at]
        return replace(self, observation=Observation(o.photo[at], o.renderer, clipped))

    def shrunk(self, height: int, width: int) -> _Photo:
        """The means of so few."""
        o = self.observation
        clipped = None
        if o.clipped is not None:
            clipped = resize(o.clipped.astype(np.float32), height, width) > 0
        photo = resize(o.photo, height, width)
        return replace(self, observation=Observation(photo, o.renderer, clipped))


@dataclass
class _Point:
    """Of each pixel at some θ: the cost (h, W), minus its gradient (h, W, 9), its Hessian as Gauss
    and Newton have it; and for each photo (n, h, W) the mean squared residual over its variance."""

    theta: Array
    cost: Array
    gradient: Array
    hessian: Array
    misfit: Array

    def take(self, other: _Point, where: NDArray[np.bool_]) -> None:
        for name in ("theta", "cost", "gradient", "hessian"):
            getattr(self, name)[where] = getattr(other, name)[where]
        self.misfit[:, where] = other.misfit[:, where]


@dataclass(frozen=True)
class _Problem:
    """The posterior of a band of rows; mean, sigma (h, W, 9): of the prior; height: of the whole
    image."""

    photos: Sequence[_Photo]
    mean: Array
    sigma: Array
    rows: slice
    height: int
    samples: int
    s: Settings

    def evaluate(self, theta: Array) -> _Point:
        precision = np.linalg.inv(channel_correlation(*self.s.correlation))
        hessian = precision / (self.sigma[..., :, None] * self.sigma[..., None, :])
        off = theta - self.mean
        gradient = -np.einsum("hwpq,hwq->hwp", hessian, off)
        cost = -np.einsum("hwp,hwp->hw", gradient, off)
        misfits = []
        for photo in self.photos:
            image, jacobian = linearise(
                photo.observation.renderer, theta, self.samples,
                top=self.rows.start, height=self.height,
            )  # fmt: skip
            variance = photo.variance(self.rows, self.s)
            residual = photo.observation.photo[self.rows] - image
            misfit = np.minimum((residual**2 / variance).mean(-1), np.float32(MOST))
            forgotten = 1 + misfit / self.s.unlikely
            cost += 3 * misfit / forgotten
            weighted = jacobian / (variance * (forgotten**2)[..., None])[..., None]
            hessian += np.swapaxes(weighted, -1, -2) @ jacobian
            gradient += np.einsum("hwcp,hwc->hwp", weighted, residual)
            misfits.append(misfit)
        return _Point(theta, cost, gradient, hessian, np.stack(misfits))

    def search(self, start: Array, steps: int) -> tuple[_Point, bool]:
        """`solve`, after some steps that a narrow lobe or a bad start does not stop: with wider
        lobes, and without forgetting what is far off."""
        s = replace(self.s, unlikely=self.s.forgiving * self.s.unlikely)
        mean, sigma, start = self.mean.copy(), self.sigma.copy(), start.copy()
        mean[..., R] = start[..., R] = np.maximum(self.mean[..., R], s.blurred)
        sigma[..., R] = s.fixed
        found = replace(self, mean=mean, sigma=sigma, s=s).solve(start, s.few)[0].theta
        found[..., R] = self.mean[..., R]
        point, _ = replace(self, s=s).solve(found, s.few)
        lost = point.misfit.mean(0) > s.lost
        if lost.mean() > s.few_lost:
            point = self._slopes_tried(point.theta, lost, s)
        return self.solve(point.theta, steps)

    def _slopes_tried(self, found: Array, lost: NDArray[np.bool_], s: Settings) -> _Point:
        """θ with the best of several slopes where it is lost, after a few steps."""
        forgiving = replace(self, s=s)
        best = forgiving.evaluate(found)
        for slope in s.slopes:
            for k in range(s.directions):
                angle = 2 * np.pi * (k + slope) / s.directions  # so that none come twice
                trial = self.mean.copy()
                trial[..., N] = slope * np.cos(angle), slope * np.sin(angle)
                point = forgiving.evaluate(trial)
                best.take(point, lost & (point.cost < best.cost))
        return forgiving.solve(best.theta, s.few)[0]

    def solve(self, start: Array, steps: int) -> tuple[_Point, bool]:
        """Damped Gauss–Newton steps from θ; and whether they converged."""
        point = self.evaluate(start.copy())
        first, factor = self.s.damping
        damping = np.full(point.cost.shape, first, np.float32)
        albedo, rho, slope = self.s.trust
        trust = np.array([albedo] * 6 + [rho] + [slope] * 2, np.float32)
        i = np.arange(9)
        for _ in range(steps):
            damped = point.hessian.copy()
            damped[..., i, i] *= 1 + damping[..., None]
            step = np.linalg.solve(damped, point.gradient[..., None])[..., 0]
            trial = self.evaluate(_in_range(point.theta + np.clip(step, -trust, trust)))
            better = trial.cost < point.cost
            gained = float((point.cost - trial.cost)[better].sum(dtype=np.float64))
            point.take(trial, better)
            damping = np.where(better, damping / factor, damping * factor)
            if gained < self.s.stop * float(point.cost.sum(dtype=np.float64)):
                return point, True
        return point, False


def _in_range(theta: Array) -> Array:
    """θ within its range, in place; but k_d may be a little above one, since lights may be told too
    dark, and nothing else should make up for that."""
    diffuse = np.clip(theta[..., D], 0, FREE_DIFFUSE)
    project(theta)
    theta[..., D] = diffuse
    return theta


def _deviations(theta: Array, rho: Array, s: Settings) -> Array:
    """Prior deviations of θ (h, W, 9), given those of ρ (h, W)."""
    low, high = s.f0_range
    metal = np.clip((theta[..., S].mean(-1, keepdims=True) - low) / (high - low), 0, 1)
    sigma = np.empty_like(theta)
    sigma[..., D] = (1 - metal) * s.diffuse + metal * s.metal_diffuse
    sigma[..., S] = (1 - metal) * s.dielectric_f0 + metal * s.metal_f0
    sigma[..., R], sigma[..., N] = rho, s.slope
    return sigma


def _small(
    photos: Sequence[_Photo], theta: Array, rho: float, samples: int, s: Settings
) -> _Problem:
    """The problem of few pixels of all, with the deviation of their roughness."""
    size = min(s.grid, len(theta)), min(s.grid, theta.shape[1])
    at = np.ix_(*(centres(n, of) for n, of in zip(size, theta.shape, strict=False)))
    mean = theta[at]
    sigma = _deviations(mean, np.full(size, rho, np.float32), s)
    few = [p.at(*size) for p in photos]
    return _Problem(few, mean, sigma, slice(0, size[0]), size[0], samples, s)


def _calibrate(
    observations: Sequence[Observation], theta: Array, samples: int, s: Settings
) -> tuple[list[_Photo], list[int]]:
    """The photos with their noise and without their own exposure, by what the others leave of
    them; and which are left out."""
    photos = dict(enumerate(map(_Photo.of, observations)))
    while True:
        problem = _small(list(photos.values()), theta, s.roughness, samples, s)
        point, _ = problem.solve(problem.mean, s.tried)
        scatter = np.sqrt(np.quantile(point.misfit.reshape(len(photos), -1), s.quantile, 1))
        excess = [
            own / max(float(np.median(np.delete(scatter, i))), 1e-6) if len(photos) > 2 else 0.0
            for i, own in enumerate(scatter)
        ]
        worst = int(np.argmax(excess))
        if excess[worst] < s.bad or scatter[worst] * s.photo_noise[0] < s.bad_at_least:
            break
        del photos[list(photos)[worst]]
    few = problem.photos
    unknowns = min(1.0, 2 / len(few))  # a share of what the noise leaves is fitted
    logs = np.zeros((len(few), 3))
    for i, photo in enumerate(few):
        image, _ = linearise(photo.observation.renderer, point.theta, samples)
        ratio = np.log(np.maximum(photo.observation.photo, TINY) / np.maximum(image, TINY))
        logs[i] = np.median(ratio.reshape(-1, 3), 0)
    logs -= logs.mean(0)
    spread = s.exposure**2
    logs *= spread / (spread + s.exposure_found**2)
    out = []
    for photo, own, log in zip(photos.values(), scatter, logs, strict=True):
        o = photo.observation
        exposed = Observation(o.photo * np.exp(-log).astype(np.float32), o.renderer, o.clipped)
        noise = float(own / np.sqrt(CHI_SQUARED_QUARTILE / 3 * max(1 - unknowns, 1 / 3)))
        out.append(replace(_Photo.of(exposed), noise=max(1.0, noise)))
    return out, [i for i in range(len(observations)) if i not in photos]


def _pool(
    photos: Sequence[_Photo], theta: Array, sigma: Array, samples: int, s: Settings
) -> Pooled:
    """The roughness of the sample's materials; sigma: the error (H, W) that is expected of θ's."""
    problem = _small(photos, theta, s.fixed, samples, s)
    size = problem.mean.shape[:2]
    few = sigma[np.ix_(*(centres(n, of) for n, of in zip(size, sigma.shape, strict=True)))]

    def solve(rho: float, start: Array) -> tuple[Array, Array]:
        problem.mean[..., R] = rho
        start = start.copy()
        start[..., R] = rho
        point, _ = problem.solve(start, s.tried)
        return point.theta, point.cost

    first = problem.mean.copy()
    return pool_roughness(first, few, solve)


def _relief(
    photos: Sequence[_Photo], pooled: Pooled, theta: Array, samples: int, s: Settings
) -> float:
    """The deviation of slopes from θ's that photos show: the spread of what is found of few pixels,
    without its own error (moments' estimate)."""
    problem = _small(photos, theta, s.fixed, samples, s)
    problem.mean[..., R], problem.sigma[..., R] = pooled.roughness(problem.mean)
    point, _ = problem.search(problem.mean, s.steps)
    variance = np.linalg.inv(point.hessian)[..., (7, 8), (7, 8)]
    square = (point.theta[..., N] - problem.mean[..., N]) ** 2
    weight = 1 / (variance + s.least_slope**2)
    excess = float((weight * (square - variance)).sum() / weight.sum())
    return float(np.clip(s.tails * np.sqrt(max(excess, 0)), s.least_slope, s.slope))


def _solve_all(
    photos: Sequence[_Photo], pooled: Pooled, theta: Array, sigma: Array, samples: int, s: Settings
) -> tuple[list[float], bool]:
    """Solve all pixels, θ and its deviations in place; the photos' errors, and whether it
    converged. A large image starts from itself shrunk."""
    height, width = theta.shape[:2]
    rho, spread = pooled.roughness(theta)
    mean = theta.copy()
    mean[..., R] = rho
    prior = _deviations(mean, spread, s)
    start, steps = mean, s.steps
    if max(height, width) > s.whole:
        scale = s.whole / max(height, width)
        low = max(1, round(height * scale)), max(1, round(width * scale))
        coarse = project(resize(theta, *low))
        before = coarse.copy()
        before[..., R] = pooled.roughness(coarse)[0]
        few = [p.shrunk(*low) for p in photos]
        _solve_all(few, pooled, coarse, np.empty_like(coarse), samples, s)
        start, steps = project(mean + resize(coarse - before, height, width)), s.few
    squares, seen, converged = np.zeros(len(photos)), np.zeros(len(photos)), True
    rows = max(1, BAND // width)
    for top in range(0, height, rows):
        band = slice(top, min(top + rows, height))
        problem = _Problem(photos, mean[band], prior[band], band, height, samples, s)
        go = problem.search if start is mean else problem.solve
        point, done = go(start[band], steps)
        converged &= done
        theta[band] = project(point.theta.copy())
        variance = np.einsum("hwpp->hwp", np.linalg.inv(point.hessian))
        variance[..., :6] += (s.lights_error * point.theta[..., :6]) ** 2
        sigma[band] = np.sqrt(variance)
        for i, photo in enumerate(photos):
            o = photo.observation
            image, _ = linearise(o.renderer, point.theta, samples, top=top, height=height)
            use = np.ones(image.shape[:2], bool) if o.clipped is None else ~o.clipped[band]
            squares[i] += float(((o.photo[band] - image)[use] ** 2).mean(-1).sum(dtype=np.float64))
            seen[i] += use.sum()
    means = np.array([p.mean for p in photos])
    return list(np.sqrt(squares / np.maximum(seen, 1)) / means), converged
