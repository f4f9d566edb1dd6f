"""Photos of one sample brought onto each other by the maps that explain all of them.

Every photo has another shading, so that photos are not compared with each other, but each with what
the maps of all make of it. A photo's crop is off by Φ(x)·δ, a homography, and by a factor
exp(Ψ(x)·g) of each colour, as lights that are a little wrong make it; with the pixels' unknowns θ,

    photo(x + Φ(x)·δ) = I(θ)·exp(Ψ(x)·g) + noise.

δ and g of all photos are found by Gauss–Newton steps in which θ is eliminated pixel by pixel (the
Schur complement of bundle adjustment: Triggs et al., 2000). So their expected error is the one that
is left while relief and albedo are free. A prior, of how well the square of the sample was found,
keeps a photo in its place where it has no texture. The first photo's place is everybody's frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.refine.gauss_newton import Observation
from invrender.refine.pixels import (
    TOGETHER,
    Photo,
    Point,
    Problem,
    Settings,
    Term,
    noise_of,
    wide_deviations,
)
from invrender.refine.shared import SHARED_SETTINGS
from invrender.refine.theta import project
from invrender.sampling import resize
from invrender.types import Array

PLACE, FACTOR = 8, 9  # unknowns of a photo: of its homography; of three colours' factors


@dataclass(frozen=True)
class RegistrationSettings:
    """Numbers of the registration, chosen by hand; lengths in halves of the sample's side."""

    sides: tuple[int, ...] = (64, 64, 128, 128)  # pixels a side of each round
    steps: tuple[int, ...] = (3, 1, 1, 1)  # of the pixels in each round
    samples: int = 16  # of the specular lobe
    noise: float = 5.0  # of the photos before they are registered, in units of `Photo`'s
    shift: float = 0.01  # prior deviations of a place: shift and affine part
    perspective: float = 0.003
    factor: float = 0.05  # of the logarithm of a factor
    slant: float = 0.03  # and of what it changes by from the middle to the border
    # The same without a screen, whose lamps' light and place are known better: to 0.01 and 0.002 on
    # 12 simulated photos.
    alone: tuple[float, float] = (0.02, 0.01)
    independent: float = 0.1  # share of the pixels whose errors are independent
    trust: float = 0.04  # most that a step moves a corner


REGISTRATION = RegistrationSettings()


@dataclass(frozen=True)
class Registered:
    """places (n, 3, 3): homographies from the first photo's sample square, [-1, 1]², x right and y
    up, to each photo's; factors (n, 3, 3): of each photo's colours the logarithm's value in the
    middle and its slopes along x and y; deviations (n,): expected RMS error of a place, in halves
    of the sample's side; nought for the first."""

    places: Array
    factors: Array
    deviations: Array


def register(
    observations: Sequence[Observation],
    mean: Array,
    *,
    s: Settings = TOGETHER,
    r: RegistrationSettings = REGISTRATION,
) -> Registered:
    """Places and factors of photos whose crops are nearly registered, to within a pixel or two of
    64; mean (H, W, 9): θ to start from."""
    n = len(observations)
    places, factors = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 3))
    deviations, noise = np.zeros(n), np.full(n, r.noise)
    place = [r.shift] * 6 + [r.perspective] * 2
    expected = [factor_deviations(o, r) for o in observations]
    deviation = np.array([[*place, *[middle, slant, slant] * 3] for middle, slant in expected])
    keep = np.arange(n * (PLACE + FACTOR)).reshape(n, -1) >= PLACE  # the first photo stays
    theta: Array | None = None
    last = 0
    for side, steps in zip(r.sides, r.steps, strict=True):
        height, width = (min(side, k) for k in mean.shape[:2])
        start = project(resize(mean, height, width))
        if theta is not None:
            theta = theta if height == last else project(resize(theta, height, width))
        last = height
        sigma = wide_deviations(start, np.full((height, width), s.roughness, np.float32), s)
        moved = [
            replace(_moved(Photo.of(o), h, f).shrunk(height, width), noise=k)
            for o, h, f, k in zip(observations, places, factors, noise, strict=True)
        ]
        problem = Problem(moved, start, sigma, slice(0, height), height, r.samples, s)
        point, _ = problem.solve(start if theta is None else theta, steps)
        theta = point.theta
        noise = np.maximum(noise * noise_of(point.misfit, s), 1.0)
        now = np.concatenate([np.zeros((n, PLACE)), factors.reshape(n, FACTOR)], 1)
        shown = [p.observation.photo for p in moved]

        def derivative(i: int, term: Term, shown: Sequence[Array] = shown) -> Array:
            return _derivative(term, shown[i])

        step, covariance = _step(problem, theta, point.hessian, derivative, now, deviation, keep, r)
        for i in range(n):
            places[i] = places[i] @ _homography(step[i, :PLACE], r)
            places[i] /= places[i, 2, 2]
            factors[i] += step[i, PLACE:].reshape(3, 3)
        factors -= factors.mean(0)  # what all share is the albedo's
        deviations = np.array([_deviation(c[:PLACE, :PLACE]) for c in covariance])
    return Registered(places, factors, deviations)


def factor_deviations(
    observation: Observation, r: RegistrationSettings = REGISTRATION
) -> tuple[float, float]:
    """Expected deviations of a photo's factor: of its logarithm in the middle, and of what that
    changes by to the border."""
    if observation.renderer.scene.pattern is not None:
        return r.factor, r.slant
    middle, slant = r.alone
    return max(middle, observation.doubt[1] - SHARED_SETTINGS.room_doubt), slant


def plane_grid(height: int, width: int) -> tuple[Array, Array]:
    """x and y (H, W) of pixels' centres in the square [-1, 1]², row 0 at +y."""
    x = (np.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (np.arange(height) + 0.5) / height * 2
    return np.broadcast_to(x, (height, width)), np.broadcast_to(y[:, None], (height, width))


def apply_place(place: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Where a homography of the square takes points."""
    px, py, w = (row[0] * x + row[1] * y + row[2] for row in place)
    return px / w, py / w


def factor_image(factor: Array, height: int, width: int) -> Array:
    """A photo's factor (H, W, 3), by its logarithm's value and slopes (3, 3)."""
    x, y = plane_grid(height, width)
    log = np.stack([np.ones_like(x), x, y], -1) @ factor.T
    return np.exp(log).astype(np.float32)


def _moved(photo: Photo, place: Array, factor: Array) -> Photo:
    """The photo where it shows the first one's square, its factor divided out; not measured where
    that is outside."""
    o = photo.observation
    height, width = o.photo.shape[:2]
    x, y = apply_place(place, *plane_grid(height, width))
    at = np.stack([(1 - y) * height / 2 - 0.5, (x + 1) * width / 2 - 0.5])
    lost = (np.abs(x) > 1) | (np.abs(y) > 1)
    image = o.photo
    if not np.array_equal(place, np.eye(3)):
        planes = [ndimage.map_coordinates(image[..., c], at, order=3, mode="nearest")
                  for c in range(3)]  # fmt: skip
        image = np.maximum(np.stack(planes, -1), 0).astype(np.float32)
        if o.clipped is not None:
            there = o.clipped.astype(np.float32)
            lost |= ndimage.map_coordinates(there, at, order=1, mode="nearest") > 0
    elif o.clipped is not None:
        lost |= o.clipped
    image = image / factor_image(factor, height, width)
    return replace(photo, observation=Observation(image, o.renderer, lost if lost.any() else None))


def _fields(height: int, width: int) -> tuple[Array, Array, Array]:
    """Displacements along x and y (H, W, 8) by each of a homography's unknowns, and Ψ (H, W, 3)."""
    x, y = plane_grid(height, width)
    one, none = np.ones_like(x), np.zeros_like(x)
    dx = np.stack([one, x, y, none, none, none, -x * x, -x * y], -1)
    dy = np.stack([none, none, none, one, x, y, -x * y, -y * y], -1)
    return dx, dy, np.stack([one, x, y], -1)


def _homography(step: Array, r: RegistrationSettings) -> Array:
    """The homography of a step's eight unknowns, shortened to what is trusted."""
    corners = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], float)
    dx = step[0] + corners @ step[1:3] - corners[:, 0] * (corners @ step[6:])
    dy = step[3] + corners @ step[4:6] - corners[:, 1] * (corners @ step[6:])
    step = step * min(1.0, r.trust / max(float(np.hypot(dx, dy).max()), 1e-12))
    c, a, b, f, d, e, g, h = step
    return np.array([[1 + a, b, c], [d, 1 + e, f], [g, h, 1]])


def _derivative(term: Term, photo: Array) -> Array:
    """Of a photo's residual by δ and g (H, W, 3, 17), with the sign of the Jacobian by θ.

    Gradients are the mean of the photo's and of its rendering's (Malis 2004): of second order.
    """
    height, width = photo.shape[:2]
    dx, dy, _ = _fields(height, width)
    down, right = np.gradient((photo + term.image) / 2, axis=(0, 1))
    by_x, by_y = right * (width / 2), -down * (height / 2)
    out = np.zeros((height, width, 3, PLACE + FACTOR), np.float32)
    out[..., :PLACE] = -(by_x[..., None] * dx[:, :, None] + by_y[..., None] * dy[:, :, None])
    out[..., PLACE:] = _factor_derivative(term.image)
    return out


def _factor_derivative(image: Array) -> Array:
    """Of a photo's rendering by g (H, W, 3, 9)."""
    psi = _fields(*image.shape[:2])[2]
    out = np.zeros((*image.shape, FACTOR), np.float32)
    for c in range(3):
        out[..., c, 3 * c : 3 * c + 3] = image[..., c : c + 1] * psi
    return out


def find_factors(problem: Problem, point: Point, factors: Array) -> Array:
    """The photos' factors (n, 3, 3), of which ``factors`` are divided out of the problem's photos,
    as they are likeliest while all pixels' θ are free within their prior; what all share is the
    albedo's."""
    r = REGISTRATION
    expected = [factor_deviations(p.observation, r) for p in problem.photos]
    deviation = [[middle, slant, slant] * 3 for middle, slant in expected]
    n = len(factors)
    step, _ = _step(
        problem, point.theta, point.hessian, lambda i, term: _factor_derivative(term.image),
        factors.reshape(n, FACTOR), np.array(deviation), np.ones((n, FACTOR), bool), r,
    )  # fmt: skip
    factors = factors + step.reshape(n, 3, 3)
    return np.asarray(factors - factors.mean(0))


def _step(
    problem: Problem, theta: Array, hessian: Array, derivative: Callable[[int, Term], Array],
    now: Array, deviation: Array, keep: NDArray[np.bool_], r: RegistrationSettings,
) -> tuple[Array, Array]:  # fmt: skip
    """The next step (n, m) of what all pixels of a photo share, and each photo's covariance.

    derivative: of photo i's residual by it, (H, W, 3, m), with the sign of the Jacobian by θ. now,
    deviation (n, m): of its prior, whose mean is nought. keep (n, m): what is free."""
    n, size = now.shape
    root = np.linalg.inv(np.linalg.cholesky(hessian))  # L⁻¹
    data, right = np.zeros((n * size, n * size)), np.zeros(n * size)
    coupled = []
    pull = -np.einsum("hwpq,hwq->hwp", problem.prior_precision(), theta - problem.mean)
    for i, term in enumerate(problem.terms(theta)):
        d = term.root @ derivative(i, term)
        at = slice(i * size, (i + 1) * size)
        rows = d.reshape(-1, size).T.astype(np.float64)
        data[at, at] += rows @ d.reshape(-1, size)
        right[at] += rows @ term.residual.reshape(-1)
        cross = np.swapaxes(term.jacobian, -1, -2) @ d
        coupled.append((root @ cross).reshape(-1, size))
        pull += np.einsum("hwcp,hwc->hwp", term.jacobian, term.residual)
    stacked = np.concatenate(coupled, 1).astype(np.float64)
    data -= stacked.T @ stacked
    right -= stacked.T @ (root @ pull[..., None]).reshape(-1).astype(np.float64)
    precision = r.independent * data + np.diag(1 / deviation.ravel() ** 2)
    right = r.independent * right - (now / deviation**2).ravel()
    keep = keep.ravel()
    covariance = np.zeros_like(precision)
    covariance[np.ix_(keep, keep)] = np.linalg.inv(precision[np.ix_(keep, keep)])
    step = (covariance @ right).reshape(n, size)
    return step, np.stack([covariance[i * size : (i + 1) * size, i * size : (i + 1) * size]
                           for i in range(n)])  # fmt: skip


def _deviation(covariance: Array) -> float:
    """RMS error over the square of a place whose unknowns have this covariance (8, 8)."""
    dx, dy, _ = _fields(16, 16)
    square = sum(np.einsum("hwm,mn,hwn->hw", d, covariance, d) for d in (dx, dy))
    return float(np.sqrt(np.mean(square)))
