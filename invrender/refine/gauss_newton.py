"""Refinement: from initial maps and their uncertainty to the maps that explain the photos.

Each pixel's nine parameters θ (`invrender.refine.priors`) at the maximum of their posterior,

    photo ~ N(I(θ), R),     θ ~ N(θ₀, Σ),

by damped Gauss–Newton steps with the exact Jacobian J of the forward model. They are taken in the
space of the photo, three-dimensional, like a Kalman filter's,

    θ ← θ₀ + ΣJᵀ(JΣJᵀ + R)⁻¹ (photo - I(θ) + J(θ - θ₀)),

so where the photo says nothing about a parameter, J is small and the parameter keeps its prior
value; and Σ - ΣJᵀ(JΣJᵀ + R)⁻¹JΣ is the uncertainty that remains. Several photos of the sample are
stacked: two have six numbers a pixel. Pixels do not depend on each other here: large images are
solved in bands of rows, in bounded memory.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.maps import Maps
from invrender.refine.priors import Prior
from invrender.refine.theta import N, R, project, to_maps
from invrender.render.backend import Float, dr, vector
from invrender.render.renderer import Material, Renderer
from invrender.render.scene import aligned, make_view
from invrender.types import TINY, Array

PHOTO_NOISE = (0.02, 0.01)  # relative to the pixel, and to the photo's mean: sensor and model
TRUST = (0.1, 0.2)  # how far one step may move roughness and slopes
STOP = 0.02  # relative decrease of the mean cost below which steps end
ROUNDING = 1e-5  # of the prior variance: what single precision can tell of the rest
BAND = 1 << 17  # pixels solved at once


@dataclass(frozen=True)
class Observation:
    """A photo (H, W, 3) of the sample, linear radiance, and the lights on it.

    clipped (H, W): pixels that the photo does not measure; None where it measures all. doubt:
    deviations of the logarithms of the screen's and of the room's radiance; (0, 0) where the lights
    are known. lamps: as in `invrender.lights.Lights`, the light that the room's doubt is not about.
    exponent: deviation of the power of light that the photo's values may still be, of a JPEG's tone
    curve. away (H, W): squared distances from the photo's middle, of a corner's, for what a lens
    takes of the light; None where that is known. level: deviation of the logarithm of the screen's
    radiance by its image in the ball, by which all albedos may be off. pose: deviation of
    the directions to the screen's points, radians, by the pixels of its image in the ball.
    """

    photo: Array
    renderer: Renderer
    clipped: NDArray[np.bool_] | None = None
    doubt: tuple[float, float] = (0.0, 0.0)
    lamps: Array | None = None
    exponent: float = 0.0
    away: Array | None = None
    level: float = 0.0
    pose: float = 0.0


@dataclass(frozen=True)
class Camera:
    """What is left of a camera in a photo: the light's logarithm lacks ``loss`` times
    `Observation.away`, and the light is raised to a power 1 + ``exponent`` about ``middle``."""

    exponent: float
    loss: float
    middle: float

    def undone(self, photo: Array, away: Array) -> Array:
        """A photo (H, W, 3) as it was before its camera did that."""
        light = np.maximum(photo, 0) * np.exp(self.loss * away[..., None])
        return np.asarray(
            self.middle * (light / self.middle) ** (1 / (1 + self.exponent)), np.float32
        )


@dataclass
class Refined:
    """Maps, their posterior standard deviations (H, W, 9) in the order of θ, how the fit went.

    interrupted: by Ctrl-C; the maps are the best so far. factors: of each photo's screen, room and
    lamps, RGB, by which the lights were found to be off; seen: each photo without what was found of
    its camera, and cameras what that is; empty where they were not fitted. contradicted: the photo
    and its lights do not belong together, and the maps are the first ones. rendering: of the maps,
    where it was made already. Of several photos that were explained together: left_out, which do
    not belong to the others; photo_errors, of each that does, the RMS of what the maps leave over
    its mean.
    """

    maps: Maps
    sigma: Array
    history: list[dict[str, float]] = field(default_factory=list)
    converged: bool = False
    interrupted: bool = False
    factors: list[tuple[Array, Array, Array]] = field(default_factory=list)
    seen: list[Array] = field(default_factory=list)
    cameras: dict[int, Camera] = field(default_factory=dict)
    contradicted: bool = False
    rendering: Array | None = None
    left_out: list[int] = field(default_factory=list)
    photo_errors: list[float] = field(default_factory=list)


def linearise(
    renderer: Renderer,
    theta: Array,
    samples: int,
    seed: int = 0,
    top: int = 0,
    height: int | None = None,
) -> tuple[Array, Array]:
    """Radiance (H, W, 3) at θ (H, W, 9) and its Jacobian (H, W, 3, 9).

    θ may be a band of rows, from row ``top``, of an image of ``height`` rows.
    """
    h, w = theta.shape[:2]
    flat = theta.reshape(-1, 9).T
    vec3 = vector(Float, 3)
    diffuse, specular = (vec3(aligned(x, Float)) for x in (flat[:3], flat[3:6]))
    rho, p, q = (Float(aligned(x, Float)) for x in flat[6:])
    view = make_view(renderer.scene, height or h, w, seed, top * w, h * w)
    material = Material(diffuse, specular, rho, vec3(p, q, Float(1)))
    j = renderer.jacobian_again(view, material, samples)
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


class Band:
    """Rows of the stacked photos: ``photo`` and its variance ``noise`` (H, W, 3·photos).

    noise: shares of the pixel and of its photo's mean, or next to infinite where not ``seen``.
    """

    def __init__(
        self,
        observations: Sequence[Observation],
        rows: slice,
        share: tuple[float, float],
        samples: int,
    ) -> None:
        self.observations, self.rows, self.samples = observations, rows, samples
        photos = [s.photo[rows] for s in observations]
        means = [max(float(s.photo.mean()), TINY) for s in observations]
        seen = [
            np.ones(p.shape[:2], bool) if s.clipped is None else ~s.clipped[rows]
            for s, p in zip(observations, photos, strict=True)
        ]
        self.photo = np.concatenate(photos, -1)
        self.mean = np.repeat(np.array(means, np.float32), 3)
        self.seen = np.repeat(np.stack(seen, -1), 3, -1)
        noise = (share[0] * self.photo) ** 2 + (share[1] * self.mean) ** 2
        self.noise = np.where(self.seen, noise, np.float32(1e12) * self.mean**2)

    def residual(self, theta: Array) -> tuple[Array, Array]:
        """photo - I(θ) and the Jacobian (H, W, 3·photos, 9)."""
        height = len(self.observations[0].photo)
        parts = [
            linearise(s.renderer, theta, self.samples, top=self.rows.start, height=height)
            for s in self.observations
        ]
        image, jacobian = (np.concatenate(x, 2) for x in zip(*parts, strict=True))
        return self.photo - image, jacobian

    def squares(self, residual: Array) -> float:
        """Sum of the squared residuals of what the photos measure, over their means."""
        return float((((residual / self.mean) ** 2)[self.seen]).sum(dtype=np.float64))


def bands(
    observations: Sequence[Observation], share: tuple[float, float], samples: int
) -> Iterator[Band]:
    height, width = observations[0].photo.shape[:2]
    rows = max(1, BAND // width)
    for top in range(0, height, rows):
        yield Band(observations, slice(top, min(top + rows, height)), share, samples)


def refine(
    observations: Sequence[Observation],
    prior: Prior,
    *,
    samples: int = 64,
    iterations: int = 10,
    progress: Callable[[int, float], None] = lambda i, error: None,
) -> Refined:
    """The pixels' maximum a posteriori for the photos.

    Starts at the prior's mean, stops when a step lowers the mean cost by less than `STOP`. A pixel
    whose step would raise its cost stays, and tries a shorter one next. Ctrl-C ends it with what
    was found so far.
    """
    theta, sigma = project(prior.mean.copy()), prior.sigma.copy()
    steps: list[list[Array]] = []
    result = Refined(to_maps(theta), sigma, converged=True)
    seen = 0
    try:
        for band in bands(observations, PHOTO_NOISE, samples):
            seen += int(band.seen.sum())
            steps.append([])
            result.converged &= _solve(band, prior, theta, sigma, iterations, steps[-1], progress)
    except KeyboardInterrupt:
        result.interrupted, result.converged = True, False
    result.maps = to_maps(theta)
    # A band that ended sooner stays as it was.
    for i in range(max(map(len, steps), default=0)):
        total = np.sum([s[min(i, len(s) - 1)] for s in steps if s], 0)
        seconds, squares, cost, pixels = map(float, total)
        error = float(np.sqrt(squares / max(seen, 1)))
        result.history.append({"seconds": seconds, "photo_error": error, "cost": cost / pixels})
    return result


def _solve(
    band: Band, prior: Prior, theta: Array, sigma: Array, iterations: int,
    steps: list[Array], progress: Callable[[int, float], None],
) -> bool:  # fmt: skip
    """Gauss–Newton on a band's rows of ``theta`` and ``sigma``, in place. Whether it converged.

    steps: gets (seconds, sum of squares, sum of costs, pixels) of each step.
    """
    began = time.perf_counter()
    theta, left = theta[band.rows], sigma[band.rows]
    mean, sigma = prior.mean[band.rows], prior.sigma[band.rows]
    precision = np.linalg.inv(prior.correlation)

    def evaluate(theta: Array) -> tuple[Array, Array, Array]:
        residual, jacobian = band.residual(theta)
        z = (theta - mean) / sigma
        misfit = (residual**2 / band.noise).sum(-1)
        return residual, jacobian, misfit + np.einsum("hwp,pq,hwq->hw", z, precision, z)

    residual, jacobian, cost = evaluate(theta)
    length = np.ones(cost.shape, np.float32)
    for i in range(iterations + 1):
        squares, total = band.squares(residual), float(cost.sum(dtype=np.float64))
        steps.append(np.array([time.perf_counter() - began, squares, total, cost.size]))
        progress(i, float(np.sqrt(squares / max(int(band.seen.sum()), 1))))
        if i and steps[-2][2] - total <= STOP * total:
            return True
        if i == iterations:
            break
        a, ac, spread = expected_spread(jacobian, sigma, prior.correlation, band.noise)
        gain = np.swapaxes(ac, -1, -2) @ np.linalg.inv(spread)
        z = (theta - mean) / sigma
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
        rest = 1 - np.einsum("hwpc,hwcp->hwp", gain, ac)
        left[...] = sigma * np.sqrt(np.clip(rest, ROUNDING, 1))
    return False


def expected_spread(
    jacobian: Array, sigma: Array, correlation: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """A = J·diag(σ), A·C and the residual's expected spread A·C·Aᵀ + R."""
    a = jacobian * sigma[..., None, :]
    ac = a @ correlation
    spread = ac @ np.swapaxes(a, -1, -2)
    n = range(spread.shape[-1])
    spread[..., n, n] += noise
    return a, ac, spread
