"""What a sample's materials share, and what its lights are off by, from all pixels at once.

A network errs on a material as a whole: its roughness is off by much the same everywhere, its
albedo is tinted. One pixel cannot tell, a thousand under different parts of the pattern can. With
a network's maps θ₀, weights w of the materials and the deviations S of what a material is off by,

    θ = θ₀ + Σ_k w_k·S·z_k + e,
    photo ~ gain·I_screen(θ) + room·I_room(θ) + lamps·I_lamps(θ) + noise;

unknowns are z, (materials, 7), the logarithms of gain, room and lamps of each photo, RGB, and what
its camera may still do: raise the light to a power, and lose some of it towards the corners. They
are found by Gauss–Newton steps with each pixel's own e marginalised: the photo is compared by the
means of parts of each material, whose expected spread J·Σ_e·Jᵀ + R includes e. What is far beyond
it counts little (Student's t).

- **Lights.** The prior of gain and room is what the capture says of them (`Observation.doubt`):
  the screen's image in the ball fits to a part in a thousand. Of lamps that are saturated there the
  radiance is a guess, but not the place: they have a factor of their own, and the room none of
  their doubt. Lights that are known are no unknowns, and cost nothing.
- **Dielectrics** mirror alike in all colours and places. A network's f0 follows the light's
  pattern, and the roughness with it: before anything is fitted f0 becomes the usual one.
- **Relief** that the maps do not resolve widens the lobe, like a greater roughness. What the photo
  asks for is shared out between the two by their variances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from invrender.refine.flat import USUAL_SPECULAR
from invrender.refine.gauss_newton import BAND, Camera, Observation, linearise
from invrender.refine.groups import group
from invrender.refine.priors import Prior, channel_correlation
from invrender.refine.theta import D, N, R, S, dielectric_share, project
from invrender.render.renderer import Renderer
from invrender.sampling import centres
from invrender.types import TINY, Array

UNKNOWNS = 7  # of a material: what θ has but slopes
KNOWN = (0.0, 0.0)  # doubt of lights that are known


@dataclass(frozen=True)
class Settings:
    """All chosen by hand on 9 simulated captures, of which 5 others told whether it carries over
    (docs/research-log/2026-11-29-what-materials-share.md). Pairs: a constant, and a share of the
    albedo or of ρ."""

    side: int = 64  # pixels a side that are compared
    parts: int = 16  # a side, whose means are compared
    independent: float = 0.3  # of the parts: what the model lacks is wider than one of them
    noise: tuple[float, float] = (0.03, 0.01)  # of the pixel and of the photo's mean
    mixing: float = 0.6  # of what neighbours differ by: blur, resampling, colours of a JPEG
    neighbour: int = 2  # pixels away
    freedom: float = 4.0  # Student's, of a part's residual
    steps: int = 5
    settled: float = 0.3  # decrease of the cost, -2 log posterior, that ends the steps
    longest: float = 0.1  # step of roughness
    shorter: tuple[float, ...] = (1.0, 1 / 3, 1 / 9)  # of a step that would raise the cost
    least_fill: float = 0.05  # of a part that a material has
    # what a material is off by
    shared_diffuse: tuple[float, float] = (0.01, 0.1)
    shared_specular: tuple[float, float] = (0.002, 0.2)
    shared_roughness: tuple[float, float] = (0.01, 0.03)  # of a dielectric
    shared_metal_roughness: float = 0.05  # of a metal, whose lobe is all that the photo shows
    alike: tuple[float, float] = (0.9, 0.3)  # correlation of materials: of one kind; of two
    # what a part is off by
    part_diffuse: tuple[float, float] = (0.013, 0.1)
    part_specular: tuple[float, float] = (0.002, 0.02)
    part_roughness: tuple[float, float] = (0.01, 0.0)
    part_slope: tuple[float, float] = (0.005, 0.15)  # at least; of a pixel's expected error
    correlation: tuple[float, float] = (0.9, 0.95)  # of the channels of k_d, and of k_s
    relief: float = 1.0  # deviation of the share of the unresolved slopes that widens the lobe
    metal_f0: tuple[float, float] = (0.06, 0.36)  # k_s of no metal, and of nothing but metal
    least_doubt: float = 0.001  # of the logarithm of the screen's radiance, at least
    room_doubt: float = 0.05  # of the room's
    lamp_doubt: float = 0.3  # of saturated lamps, whose brightness the table tells
    hidden_doubt: float = 0.1  # where a lamp behind the screen was added
    channels: float = 0.5  # of the lights' doubt, by which each colour may differ
    corner: float = 0.1  # of the logarithm of the light in a photo's corner: lenses
    # the materials: groups of like sqrt(k_d), sqrt(f0) and ρ
    materials: int = 4
    mirror_weight: float = 1.5  # of sqrt(f0)
    alike_distance: float = 0.12  # of groups that are one
    softness: float = 0.05  # deviation of a pixel from its group
    least_part: float = 0.02  # of the sample that a group has
    shared_error: float = 0.5  # of a network's squared error that a material shares


SHARED_SETTINGS = Settings()


Factors = tuple[Array, Array, Array]  # of screen, room and lamps, RGB


@dataclass(frozen=True)
class Shared:
    """prior: with the maps as their materials are found to be. observations: with the lights as
    they are found, the photos without what is found of their cameras. factors: of each photo's
    screen, room and lamps, RGB. cameras: by photo, where they are not known. converged: the steps
    ended by themselves. misfit: mean square of the parts' residuals over what is expected."""

    prior: Prior
    observations: list[Observation]
    factors: list[Factors] = field(default_factory=list)
    cameras: dict[int, Camera] = field(default_factory=dict)
    converged: bool = True
    misfit: float = 0.0
    interrupted: bool = False


def share(
    observations: Sequence[Observation],
    prior: Prior,
    *,
    samples: int = 64,
    s: Settings = SHARED_SETTINGS,
) -> Shared:
    """The prior and the lights after what all pixels tell together.

    prior: a network's maps (H, W, 9), ``total`` their expected errors.
    """
    theta = plain_dielectric(project(prior.mean.copy()))
    centres = materials(theta[grid(theta, s)], s)
    problem = _Problem(observations, prior, theta, centres, samples, s)
    solved = _solve(problem, s)
    z, left = problem.offsets(solved.u, solved.covariance)
    total = prior.expected.copy()
    rows = max(1, BAND // theta.shape[1])
    for top in range(0, len(theta), rows):
        part = slice(top, top + rows)
        weight = belongs(theta[part], centres, s)
        less = 1 - s.shared_error * np.clip(weight @ (1 - left), 0, 1)
        total[part, :, :UNKNOWNS] *= np.sqrt(less)
        theta[part, :, :UNKNOWNS] += shared_sigma(theta[part], s) * (weight @ z)
        project(theta[part])
    factors = problem.factors(solved.u)
    shots = [
        o if o.doubt == KNOWN else replace(o, renderer=_scaled(o, *f))
        for o, f in zip(observations, factors, strict=True)
    ]
    cameras = {}
    for i, found in problem.camera.items():
        away = shots[i].away
        assert away is not None
        exponent, loss = map(float, solved.u[found])
        level = float(np.median(_raised(shots[i].photo, away, loss)))
        cameras[i] = Camera(exponent, loss, max(level, TINY))
        shots[i] = replace(shots[i], photo=cameras[i].undone(shots[i].photo, away))
    return Shared(
        replace(prior, mean=theta, total=total), shots, factors, cameras,
        solved.converged, solved.misfit, solved.interrupted,
    )  # fmt: skip


def _with_camera(image: Array, away: Array, exponent: float, loss: float) -> tuple[Array, Array]:
    """A photo (H, W, 3) of an image as a camera makes it, about the image's median; and its
    derivatives by ``exponent`` and by ``loss`` (H, W, 3, 2)."""
    log = np.log(image / max(float(np.median(image)), TINY))
    lost = np.broadcast_to(away[..., None], image.shape)
    photo = image * np.exp(exponent * log - loss * lost)
    return photo, photo[..., None] * np.stack([log, -lost], -1)


def _raised(photo: Array, away: Array, loss: float) -> Array:
    """A photo with the light that its lens took."""
    return np.asarray(np.maximum(photo, 0) * np.exp(np.float32(loss) * away[..., None]))


def _scaled(o: Observation, screen: Any, room: Any, lamps: Any) -> Renderer:
    """Under an observation's lights times factors."""
    added = None if o.lamps is None else o.lamps * (np.float32(lamps) - np.float32(room))
    return o.renderer.scaled(screen, room, added)


def light_doubt(fit: dict[str, float], s: Settings = SHARED_SETTINGS) -> tuple[float, float]:
    """Deviations of the logarithms of screen and room, by `Lights.fit`; nought of known lights."""
    if not fit:
        return KNOWN
    room = s.room_doubt + s.hidden_doubt * (fit.get("hidden_lamp", 1.0) > 1)
    return max(float(fit.get("residual", 0.0)), s.least_doubt), room


def plain_dielectric(theta: Array) -> Array:
    """Maps θ in which every dielectric has the usual f0, grey; in place."""
    theta[..., S] += dielectric_share(theta)[..., None] * (USUAL_SPECULAR - theta[..., S])
    return theta


def shared_sigma(theta: Array, s: Settings = SHARED_SETTINGS) -> Array:
    """Deviations (H, W, 7) of what a material is off by."""
    sigma = _sigma(theta, s.shared_diffuse, s.shared_specular, s.shared_roughness, s)
    metal = _metal(theta[..., S].mean(-1), s)
    sigma[..., R] += metal * (s.shared_metal_roughness - sigma[..., R])
    return sigma


def _metal(f0: Array, s: Settings) -> Array:
    """By how much an f0 is a metal's."""
    none, all_ = s.metal_f0
    return np.clip((f0 - none) / (all_ - none), 0, 1)


def _sigma(
    theta: Array, diffuse: tuple[float, float], specular: tuple[float, float],
    roughness: tuple[float, float], s: Settings,
) -> Array:  # fmt: skip
    k_s = theta[..., S]
    sigma = np.empty((*theta.shape[:-1], UNKNOWNS), np.float32)
    sigma[..., D] = diffuse[0] + diffuse[1] * theta[..., D]
    sigma[..., S] = specular[0] + specular[1] * k_s * _metal(k_s, s)
    sigma[..., R] = roughness[0] + roughness[1] * theta[..., R]
    return sigma


def _features(theta: Array, s: Settings) -> Array:
    mirror = s.mirror_weight * np.sqrt(theta[..., S].mean(-1, keepdims=True))
    return np.concatenate([np.sqrt(theta[..., D]), mirror, theta[..., R : R + 1]], -1)


def materials(theta: Array, s: Settings = SHARED_SETTINGS) -> Array:
    """Centres (materials, 5) of like pixels of maps θ."""
    points = _features(theta, s).reshape(-1, 5)
    if points.std(0).max() < s.softness:
        return points.mean(0, keepdims=True)
    centres, label = group(points, s.materials)
    shares = np.bincount(label) / len(points)
    kept: list[Array] = []
    for k in np.argsort(-shares):
        apart = all(np.linalg.norm(centres[k] - c) > s.alike_distance for c in kept)
        if shares[k] >= s.least_part and apart:
            kept.append(centres[k])
    return np.array(kept)


def belongs(theta: Array, centres: Array, s: Settings = SHARED_SETTINGS) -> Array:
    """How much each pixel is of each material (H, W, materials), together one."""
    apart = ((_features(theta, s)[..., None, :] - centres) ** 2).sum(-1)
    weight = np.exp((apart.min(-1, keepdims=True) - apart) / (2 * s.softness**2))
    return (weight / weight.sum(-1, keepdims=True)).astype(np.float32)


def material_means(theta: Array, image: Array, s: Settings = SHARED_SETTINGS) -> Array:
    """An image (H, W) averaged over each material of maps θ, weighed by what a pixel is of it."""
    at = grid(theta, s)
    centres = materials(theta[at], s)
    weight = belongs(theta[at], centres, s)
    means = np.einsum("hw,hwk->k", image[at], weight) / np.maximum(weight.sum((0, 1)), TINY)
    found = np.empty_like(image)
    rows = max(1, BAND // image.shape[1])
    for top in range(0, len(image), rows):
        found[top : top + rows] = belongs(theta[top : top + rows], centres, s) @ means
    return found


def grid(image: Array, s: Settings = SHARED_SETTINGS) -> tuple[Array, Array]:
    """Indices of the pixels that are compared."""
    rows, columns = (centres(min(s.side, n), n) for n in image.shape[:2])
    return np.ix_(rows, columns)  # type: ignore[return-value]


def contrast(photo: Array, s: Settings = SHARED_SETTINGS) -> Array:
    """By how much the pixels that are compared differ from the mean of four neighbours."""
    rows, columns = grid(photo, s)
    height, width = photo.shape[:2]
    near = np.zeros((rows.size, columns.size, *photo.shape[2:]), np.float32)
    for step in (-s.neighbour, s.neighbour):
        near += photo[np.clip(rows + step, 0, height - 1), columns] / 4
        near += photo[rows, np.clip(columns + step, 0, width - 1)] / 4
    return np.abs(near - photo[rows, columns])


def parts_of(height: int, width: int, s: Settings = SHARED_SETTINGS) -> Any:
    """Which part each pixel lies in (H·W), from 0."""
    rows, columns = (np.arange(n) * min(s.parts, n) // n for n in (height, width))
    return (rows[:, None] * (columns[-1] + 1) + columns).ravel()


class _Problem:
    """The unknowns u: z of each material, then the logarithms of the lights' factors of each
    doubtful photo: screen and room (6), and the lamps where there are any (9); then the exponent
    and the loss of each photo whose camera is not known."""

    def __init__(
        self, observations: Sequence[Observation], prior: Prior, theta: Array, centres: Array,
        samples: int, s: Settings,
    ) -> None:  # fmt: skip
        at = grid(theta, s)
        self.s, self.samples, self.observations = s, samples, observations
        self.theta = theta[at]
        self.weight = belongs(self.theta, centres, s)
        self.photos = [o.photo[at] for o in observations]
        self.mixing = [(s.mixing * contrast(o.photo, s)) ** 2 for o in observations]
        self.seen = [
            np.ones(self.theta.shape[:2]) if o.clipped is None else ~o.clipped[at] * 1.0
            for o in observations
        ]
        self.fewer = [_fewer(o) for o in observations]
        self.shared = shared_sigma(self.theta, s)
        total = prior.expected[at]
        own = _sigma(self.theta, s.part_diffuse, s.part_specular, s.part_roughness, s)
        least, of = s.part_slope
        slopes = np.maximum(least, of * total[..., N])
        self.own = np.concatenate([own, slopes], -1).astype(np.float32)
        self.correlation = channel_correlation(*s.correlation)
        # Unresolved relief: α² grows by twice the slopes' variance. Of real relief there is about
        # as much again as networks find.
        rho = self.theta[..., R]
        unresolved = (total[..., N] ** 2 + self.theta[..., N] ** 2).mean(-1)
        widened = (rho**4 + 2 * unresolved) ** 0.25 - rho
        size = np.maximum(self.weight.sum((0, 1)), 1e-9)
        self.rough, widened = (
            np.einsum("hw,hwk->k", x, self.weight) / size for x in (self.shared[..., R], widened)
        )  # deviations of each material's roughness
        self.apparent = np.ones((len(centres), UNKNOWNS))  # deviation of z as it is seen
        self.apparent[:, R] = np.hypot(1, s.relief * widened / self.rough)
        metal = _metal(self.theta[..., S].mean(-1), s)
        self.metal = np.einsum("hw,hwk->k", metal, self.weight) / size
        height, width = self.theta.shape[:2]
        self.part = parts_of(height, width, s)
        self.parts = int(self.part[-1]) + 1
        self.materials = len(centres)
        self.light: dict[int, slice] = {}
        self.size = self.materials * UNKNOWNS
        for i, fewer in enumerate(self.fewer):
            if fewer:
                self.light[i] = slice(self.size, self.size + 3 * (1 + len(fewer)))
                self.size = self.light[i].stop
        self.camera: dict[int, slice] = {}
        for i, o in enumerate(observations):
            if o.away is not None:
                self.camera[i] = slice(self.size, self.size + 2)
                self.size = self.camera[i].stop
        self.away = [None if o.away is None else o.away[at] for o in observations]
        self.precision = np.linalg.inv(self._covariance())

    def _covariance(self) -> Array:
        """Of the unknowns before the photo is seen."""
        s, n = self.s, self.materials * UNKNOWNS
        same, other = s.alike
        alike = same - (same - other) * np.abs(self.metal[:, None] - self.metal)
        alike += np.diag(1 - np.diag(alike))
        covariance = np.zeros((self.size, self.size))
        covariance[:n, :n] = np.kron(alike, self.correlation[:UNKNOWNS, :UNKNOWNS])
        for i, light in self.light.items():
            doubts = [*self.observations[i].doubt, s.lamp_doubt]
            for k, sigma in zip(range(light.start, light.stop, 3), doubts, strict=False):
                at = slice(k, k + 3)
                each = np.eye(3) * s.channels**2
                covariance[at, at] = max(sigma, 1e-4) ** 2 * (1 + each)
        for i, camera in self.camera.items():
            exponent = max(self.observations[i].exponent, 1e-4)
            covariance[camera, camera] = np.diag([exponent**2, self.s.corner**2])
        return covariance

    def factors(self, u: Array) -> list[Factors]:
        """Of each photo's screen, room and lamps, RGB."""
        found = []
        for i in range(len(self.observations)):
            logs = np.zeros((3, 3))
            if i in self.light:
                own = u[self.light[i]].reshape(-1, 3)
                logs[: len(own)] = own
            screen, room, lamps = np.exp(logs).astype(np.float32)
            found.append((screen, room, lamps))
        return found

    def offsets(self, u: Array, covariance: Array) -> tuple[Array, Array]:
        """z (materials, 7) without what relief makes of roughness, and the share of the prior's
        variance that is left of each."""
        n = self.materials * UNKNOWNS
        true = 1 / self.apparent**2  # share of what is seen
        z = u[:n].reshape(-1, UNKNOWNS) * self.apparent * true
        left = np.diag(covariance)[:n].reshape(-1, UNKNOWNS)
        return z.astype(np.float32), (1 - true * (1 - left)).astype(np.float32)

    def evaluate(self, u: Array) -> tuple[Array, Array, Array]:
        """Of every part of every material: residual (P, 3), its derivative (P, 3, unknowns) and the
        precision of its expected spread (P, 3, 3)."""
        n = self.materials * UNKNOWNS
        theta = self.theta.copy()
        z = u[:n].reshape(-1, UNKNOWNS) * self.apparent
        theta[..., :UNKNOWNS] += self.shared * (self.weight @ z.astype(np.float32))
        theta = project(theta)
        found = [self._photo(i, theta, f, u) for i, f in enumerate(self.factors(u))]
        residual, derivative, precision = (np.concatenate(x) for x in zip(*found, strict=True))
        return residual, derivative, precision

    def _photo(self, i: int, theta: Array, factors: Factors, u: Array) -> tuple[Array, ...]:
        s, photo = self.s, self.photos[i]
        image, jacobian = linearise(self.observations[i].renderer, theta, self.samples)
        fewer = self.fewer[i]
        lights = np.zeros((*image.shape, 3 * (1 + len(fewer))), np.float32)
        if fewer:
            left = [(image, jacobian), *(linearise(r, theta, self.samples) for r in fewer)]
            left.append((np.zeros_like(image), np.zeros_like(jacobian)))
            apart = [[a - b for a, b in zip(*two, strict=True)] for two in pairwise(left)]
            image, jacobian = np.zeros_like(image), np.zeros_like(jacobian)
            for k, (light, derivative) in enumerate(apart):
                light *= factors[k]
                image += light
                jacobian += derivative * factors[k][:, None]
                lights[..., range(3), range(3 * k, 3 * k + 3)] = light
        away = self.away[i]
        if away is not None:
            exponent, loss = u[self.camera[i]]
            plain = np.maximum(image, TINY)
            image, camera = _with_camera(plain, away, exponent, loss)
            by = image / plain * (1 + exponent)
            jacobian, lights = jacobian * by[..., None], lights * by[..., None]
        own = jacobian * self.own[..., None, :]
        noise = (s.noise[0] * photo) ** 2 + (s.noise[1] * photo.mean()) ** 2 + self.mixing[i]
        shared = jacobian[..., :UNKNOWNS] * self.shared[..., None, :]
        parts = []
        for k in range(self.materials):
            weight = (self.weight[..., k] * self.seen[i]).ravel()
            fill = np.bincount(self.part, weight, self.parts)
            full = np.bincount(self.part, minlength=self.parts)
            kept = fill > s.least_fill * full
            means = partial(_means, part=self.part, weight=weight, fill=fill, kept=kept)
            derivative = np.zeros((int(kept.sum()), 3, self.size))
            at = slice(k * UNKNOWNS, (k + 1) * UNKNOWNS)
            derivative[..., at] = means(shared) * self.apparent[k]
            if fewer:
                derivative[..., self.light[i]] = means(lights)
            if away is not None:
                derivative[..., self.camera[i]] = means(camera)
            a = means(own)
            spread = a @ self.correlation @ np.swapaxes(a, 1, 2)
            spread[:, range(3), range(3)] += means(noise)
            independent = s.independent * (fill / full)[kept]
            precision = np.linalg.inv(spread) * independent[:, None, None]
            parts.append((means(photo - image), derivative, precision))
        return tuple(np.concatenate(x) for x in zip(*parts, strict=True))


def _fewer(o: Observation) -> list[Renderer]:
    """Under an observation's room alone, then its lamps alone; none where its lights are known."""
    if o.doubt == KNOWN:
        return []
    rooms = [(1.0, 1.0)] if o.lamps is None else [(1.0, 1.0), (0.0, 1.0)]
    return [_scaled(o, 0.0, *factors) for factors in rooms]


def _means(image: Array, part: Any, weight: Array, fill: Any, kept: Any) -> Array:
    """Weighted means (P, ...) of an image (H, W, ...) over the parts that are kept."""
    columns = image.reshape(len(weight), -1).T
    sums = [np.bincount(part, weight * c, len(fill))[kept] for c in columns]
    return (np.array(sums) / fill[kept]).T.reshape(-1, *image.shape[2:])


@dataclass
class _Solution:
    """The unknowns of least cost and their covariance; the rest as in `Shared`."""

    u: Array
    covariance: Array
    converged: bool = False
    misfit: float = 0.0
    interrupted: bool = False


def _solve(problem: _Problem, s: Settings) -> _Solution:
    n = problem.materials * UNKNOWNS
    found = _Solution(np.zeros(problem.size), np.linalg.inv(problem.precision))

    def cost_of(u: Array, seen: tuple[Array, Array, Array]) -> tuple[float, Array]:
        surprise = np.einsum("pc,pcd,pd->p", seen[0], seen[2], seen[0])
        cost = (s.freedom + 3) * np.log1p(surprise / s.freedom).sum() + u @ problem.precision @ u
        return float(cost), surprise

    try:
        u = found.u
        seen = problem.evaluate(u)
        if len(seen[0]) == 0:  # all is saturated
            return replace(found, converged=True)
        cost, surprise = cost_of(u, seen)
        for _ in range(s.steps):
            hessian, gradient = _normal(problem, u, seen, surprise, s)
            step = np.linalg.solve(hessian, gradient)
            rho = step[:n].reshape(-1, UNKNOWNS)[:, R] * problem.apparent[:, R] * problem.rough
            step *= min(1.0, s.longest / max(float(np.abs(rho).max()), 1e-9))
            for shorter in s.shorter:
                trial = problem.evaluate(u + shorter * step)
                new, unlikely = cost_of(u + shorter * step, trial)
                if new < cost:
                    break
            else:
                found.converged = True
                break
            found.converged = cost - new < s.settled
            u, seen, surprise, cost = u + shorter * step, trial, unlikely, new
            found.u = u
            if found.converged:
                break
        found.covariance = np.linalg.inv(_normal(problem, u, seen, surprise, s)[0])
        found.misfit = float(surprise.mean() / 3 / s.independent)
    except KeyboardInterrupt:
        found.interrupted = True
    return found


def _normal(
    problem: _Problem, u: Array, found: tuple[Array, Array, Array], surprise: Array, s: Settings
) -> tuple[Array, Array]:
    """The normal equations at u, parts weighted by how likely their residuals are."""
    residual, derivative, precision = found
    trust = (s.freedom + 3) / (s.freedom + surprise)
    weighted = np.einsum("pcu,pcd->pud", derivative, precision * trust[:, None, None])
    hessian = np.einsum("pud,pdv->uv", weighted, derivative) + problem.precision
    gradient = np.einsum("pud,pd->u", weighted, residual) - problem.precision @ u
    return hessian, gradient
