"""The posterior of a sample's pixels under several photos, each pixel by itself.

`invrender.refine.several` tells what is maximised. Sums over the photos are kept, not their
Jacobians: memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from invrender.refine.flat import PLAIN_ROUGHNESS
from invrender.refine.gauss_newton import Observation, linearise
from invrender.refine.priors import channel_correlation
from invrender.refine.theta import D, N, R, S, project
from invrender.sampling import centres, resize
from invrender.types import TINY, Array

MOST = 1e12  # mean squared residual over its variance, so that its square is finite
CHI_SQUARED_QUARTILE = 1.213  # the lower one, of three degrees of freedom
LEAST_FREE = 0.1  # share of the noise that a fit leaves, at least
FREE_DIFFUSE = 1.15  # k_d, as it is solved for


@dataclass(frozen=True)
class Settings:
    """Numbers of the joint posterior, chosen by hand on simulated photos of eight held-out
    materials (docs/research-log/2026-11-29-several-photos.md)."""

    photo_noise: tuple[float, float] = (0.01, 0.004)  # of the pixel and the photo's mean, at least
    grey_noise: float = 0.7  # correlation of the colours' noise: 0.2 to 0.95 at the true maps
    quantile: float = 0.25  # of the residuals, by which noise is judged: many pixels may be lost
    rounds: int = 3  # of the photos' factors and noise, and of the relief
    unlikely: float = 9.0  # mean squared residual over its variance that counts half
    diffuse: float = 0.3  # prior deviations of θ, of a dielectric
    around: int = 3  # pixels a side whose misfits are taken together
    most_misfit: float = 1e6  # of a photo, that is counted
    trusted: float = 1.0  # times what is expected of the initial maps' errors, of that of k_d
    least_diffuse: float = 0.01  # that deviation, at least
    dielectric_f0: float = 0.003  # with 0.01 it grows with the photos, and takes up their errors
    roughness: float = 0.25
    slope: float = 0.6  # at most, of what the photos show of the relief
    least_slope: float = 0.01
    most_share: float = 1.5  # of the initial slopes, that photos show of them
    metal_diffuse: float = 0.01  # and of a metal
    metal_f0: float = 0.3
    f0_range: tuple[float, float] = (0.08, 0.2)  # surely dielectric; surely metal
    metal_start: float = 0.6  # f0 of a metal of which nothing else is known
    black: float = 0.01  # diffuse albedo, which is nought where a lobe is taken too wide
    metal_better: float = 0.5  # cost of an area's pixels as metal, over that as dielectric, at most
    # Of a sample of which nothing is known: what is tried as if it were flat, with slopes of so
    # little; and the cost, over the least, of what explains the photos about as well.
    flat_roughness: tuple[float, ...] = (0.06, *PLAIN_ROUGHNESS)
    flat_slope: float = 0.02
    about_as_well: float = 1.03
    area: int = 5  # pixels a side of such an area, of `grid`
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
    # Of what is found of a material's roughness, the share of the spread that is the pixels' own,
    # as materials are told apart for the first and for the second time; photos' errors are the
    # rest. A third time changes maps by 0.5%.
    spread: tuple[float, ...] = (1.0, 0.25)
    least_roughness: float = 0.015  # that deviation, at least
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


@dataclass(frozen=True)
class Photo:
    """A photo, its exposure divided out, with its noise in units of `Settings.photo_noise`."""

    observation: Observation
    mean: float
    noise: float = 1.0

    @classmethod
    def of(cls, observation: Observation) -> Photo:
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

    def at(self, height: int, width: int) -> Photo:
        """The pixels nearest to the centres of so few."""
        o = self.observation
        at = np.ix_(centres(height, len(o.photo)), centres(width, o.photo.shape[1]))
        clipped = None if o.clipped is None else o.clipped[at]
        return replace(self, observation=Observation(o.photo[at], o.renderer, clipped))

    def shrunk(self, height: int, width: int) -> Photo:
        """The means of so few."""
        o = self.observation
        clipped = None
        if o.clipped is not None:
            clipped = resize(o.clipped.astype(np.float32), height, width) > 0
        photo = resize(o.photo, height, width)
        return replace(self, observation=Observation(photo, o.renderer, clipped))


@dataclass
class Point:
    """Of each pixel at some θ: the cost (h, W), minus its gradient (h, W, 9), its Hessian as Gauss
    and Newton have it; and for each photo (n, h, W) the mean squared residual over its variance."""

    theta: Array
    cost: Array
    gradient: Array
    hessian: Array
    misfit: Array

    def take(self, other: Point, where: NDArray[np.bool_]) -> None:
        for name in ("theta", "cost", "gradient", "hessian"):
            getattr(self, name)[where] = getattr(other, name)[where]
        self.misfit[:, where] = other.misfit[:, where]


@dataclass(frozen=True)
class Term:
    """Of a photo at some θ: its rendering (h, W, 3); the residual (h, W, 3) and the Jacobian
    (h, W, 3, 9), both times ``root`` (h, W, 3, 3), of the residual's weight; and the mean squared
    residual over its variance (h, W)."""

    image: Array
    residual: Array
    jacobian: Array
    root: Array
    misfit: Array


@dataclass(frozen=True)
class Problem:
    """The posterior of a band of rows; mean, sigma (h, W, 9): of the prior; height: of the whole
    image."""

    photos: Sequence[Photo]
    mean: Array
    sigma: Array
    rows: slice
    height: int
    samples: int
    s: Settings

    def evaluate(self, theta: Array) -> Point:
        hessian = self.prior_precision()
        off = theta - self.mean
        gradient = -np.einsum("hwpq,hwq->hwp", hessian, off)
        cost = -np.einsum("hwp,hwp->hw", gradient, off)
        misfits = []
        for term in self.terms(theta):
            cost += 3 * term.misfit / (1 + term.misfit / self.s.unlikely)
            hessian += np.swapaxes(term.jacobian, -1, -2) @ term.jacobian
            gradient += np.einsum("hwcp,hwc->hwp", term.jacobian, term.residual)
            misfits.append(term.misfit)
        return Point(theta, cost, gradient, hessian, np.stack(misfits))

    def prior_precision(self) -> Array:
        """Of θ before the photos are seen, (h, W, 9, 9)."""
        return precision_of(self.sigma, self.s)

    def terms(self, theta: Array) -> Iterator[Term]:
        """What each photo says of θ, one after another."""
        white = whitening(self.s)
        for photo in self.photos:
            image, jacobian = linearise(
                photo.observation.renderer, theta, self.samples,
                top=self.rows.start, height=self.height,
            )  # fmt: skip
            variance = photo.variance(self.rows, self.s)
            root = white / np.sqrt(variance)[..., None, :]
            residual = (root @ (photo.observation.photo[self.rows] - image)[..., None])[..., 0]
            misfit = np.minimum((residual**2).mean(-1), np.float32(MOST))
            forgotten = 1 + misfit / self.s.unlikely
            root /= forgotten[..., None, None]
            yield Term(image, residual / forgotten[..., None], root @ jacobian, root, misfit)

    def left_free(self, point: Point) -> Array:
        """Of each photo's noise (n,), the share that a fit of θ leaves: the median of pixels."""
        covariance = np.linalg.inv(point.hessian)
        fitted = [
            np.einsum("hwcp,hwpq,hwcq->hw", t.jacobian, covariance, t.jacobian) / 3
            for t in self.terms(point.theta)
        ]
        return np.array([max(1 - float(np.median(f)), LEAST_FREE) for f in fitted])

    def search(self, start: Array, steps: int) -> tuple[Point, bool]:
        """`solve`; and where pixels are lost, the better of it and of steps that a narrow lobe or a
        bad start does not stop: first with wider lobes, and without forgetting what is far off."""
        point, done = self.solve(start, steps)
        if self._lost(point).mean() <= self.s.few_lost:
            return point, done
        s = replace(self.s, unlikely=self.s.forgiving * self.s.unlikely)
        mean, sigma, start = self.mean.copy(), self.sigma.copy(), start.copy()
        mean[..., R] = start[..., R] = np.maximum(self.mean[..., R], s.blurred)
        sigma[..., R] = s.fixed
        found = replace(self, mean=mean, sigma=sigma, s=s).solve(start, s.few)[0].theta
        found[..., R] = self.mean[..., R]
        other, _ = replace(self, s=s).solve(found, s.few)
        lost = self._lost(other)
        if lost.mean() > s.few_lost:
            other = self._slopes_tried(other.theta, lost, s)
        other, done = self.solve(other.theta, steps)
        point.take(other, other.cost < point.cost)
        return point, done

    def _lost(self, point: Point) -> NDArray[np.bool_]:
        """Which pixels are at no optimum."""
        return np.asarray(point.misfit.mean(0) > self.s.lost)

    def _slopes_tried(self, found: Array, lost: NDArray[np.bool_], s: Settings) -> Point:
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

    def solve(self, start: Array, steps: int) -> tuple[Point, bool]:
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


def precision_of(sigma: Array, s: Settings) -> Array:
    """Of θ with these deviations (h, W, 9), the colours of an albedo varying together."""
    precision = np.linalg.inv(channel_correlation(*s.correlation)).astype(np.float32)
    return np.asarray(precision / (sigma[..., :, None] * sigma[..., None, :]))


def wide_deviations(theta: Array, rho: Array, s: Settings) -> Array:
    """Prior deviations of θ (h, W, 9), given those of ρ (h, W)."""
    low, high = s.f0_range
    metal = np.clip((theta[..., S].mean(-1, keepdims=True) - low) / (high - low), 0, 1)
    sigma = np.empty_like(theta)
    sigma[..., D] = (1 - metal) * s.diffuse + metal * s.metal_diffuse
    sigma[..., S] = (1 - metal) * s.dielectric_f0 + metal * s.metal_f0
    sigma[..., R], sigma[..., N] = rho, s.slope
    return sigma


def noise_of(misfit: Array, s: Settings, free: Array | None = None) -> Array:
    """Each photo's noise (n,) in units of the one that its variance assumes, by the lower quartile
    of the pixels' misfits (n, h, W). free: the share (n,) of the noise that a fit leaves."""
    free = np.full(len(misfit), free_share(len(misfit))) if free is None else free
    scatter = np.quantile(misfit.reshape(len(misfit), -1), s.quantile, 1)
    return np.asarray(np.sqrt(scatter / (CHI_SQUARED_QUARTILE / 3 * free)))


def whitening(s: Settings) -> Array:
    """(3, 3): what makes colours' correlated noise independent."""
    values, vectors = np.linalg.eigh(np.full((3, 3), s.grey_noise) + (1 - s.grey_noise) * np.eye(3))
    return np.asarray(vectors @ np.diag(values**-0.5) @ vectors.T, np.float32)


def free_share(photos: int) -> float:
    """Of the noise, what a fit of six unknowns leaves of so many photos' three numbers a pixel."""
    return max(1 - 2 / photos, 1 / 3)
