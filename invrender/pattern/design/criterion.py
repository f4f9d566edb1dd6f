"""The expected error of the maps that a photo under a pattern leaves: a Bayesian Cramér–Rao bound.

Unknowns θ of a group of pixels that share a material have Gaussian priors of covariance P; the
photo is y = I(θ) + noise of variance N. With the Jacobian J at the truth,

    C = (P⁻¹ + Jᵀ N⁻¹ J)⁻¹,   criterion = Σ_m w_m · rms(posterior sd of map m) / rms(prior sd of m),

over the groups of a population: 1 for a photo that says nothing of the maps, 0 for one that
leaves no error.
[Van Trees 1968, "Detection, Estimation, and Modulation Theory I", 2.4.3]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from invrender.maps import NAMES
from invrender.pattern.design.population import GROUP_PIXELS, Responses
from invrender.types import Array

MAP_WEIGHTS = (1 / 3, 1 / 6, 1 / 3, 1 / 6)  # of the maps, in that order
SLOPE_SD, DIFFUSE_SD, ROUGHNESS_SD = 0.2, 0.2, 0.25  # priors
SPECULAR_SD, METAL_DIFFUSE_SD, METAL_SPECULAR_SD = 0.03, 0.05, 0.2
ALBEDO_SD = 0.07  # grey variation from pixel to pixel of one material, relative
GAIN_SD, ROOM_SD = 0.03, 0.1  # of the screen's white (RGB) and of the environment, relative
SENSOR_NOISE, MODEL_NOISE = 0.01, 0.003  # sensor and model: of the value, and of the photo's mean

# Unknowns of a group: k_d (3), k_s (3), ρ, gain (3), room; then for each pixel s, t, albedo.
SHARED, EACH = 11, 3


class Criterion:
    """The criterion and its gradient for patterns (cells, cells, 3) over a set of `Responses`."""

    def __init__(self, responses: Responses) -> None:
        r, p = responses, responses.population
        self.cells = r.cells
        self.k_d, self.k_s = p.diffuse.astype(np.float64), p.specular.astype(np.float64)
        m = len(p.x)
        self.groups = m // GROUP_PIXELS
        self.screen = r.screen.reshape(m * 12, -1)
        self.room = r.room.astype(np.float64)
        self.prior = _prior_precision(p.metal)
        # Which unknowns count for which map, with what weight: the map's mean square error.
        n = SHARED + EACH * GROUP_PIXELS
        self.maps = np.zeros((4, n))
        self.maps[0, SHARED::EACH] = self.maps[0, SHARED + 1 :: EACH] = 1 / (12 * GROUP_PIXELS)
        self.maps[1, 0:3] = self.maps[3, 3:6] = 1 / 3
        self.maps[2, 6] = 1
        prior = np.linalg.inv(self.prior)
        self.prior_mse = self._mse(prior)

    def _mse(self, covariance: Array) -> Array:
        return np.einsum("gii,mi->m", covariance, self.maps) / self.groups

    def _forward(self, pattern: Array) -> tuple[Array, ...]:
        """Radiance of screen and room (M, 3) and the Jacobian (groups, 3·pixels, unknowns)."""
        flat = pattern.reshape(-1, 3).astype(np.float32)
        lit = (self.screen @ flat).reshape(-1, 4, 3, 3).astype(np.float64)
        total = lit + self.room
        weights = np.stack([self.k_d / np.pi, self.k_s, np.ones_like(self.k_d)], 1)
        rows = np.einsum("mrtc,mtc->mrc", total, weights)  # value, ∂ρ, ∂s, ∂t
        screen = np.einsum("mtc,mtc->mc", lit[:, 0], weights)
        return total, weights, rows, screen

    def _jacobian(self, total: Array, rows: Array, screen: Array) -> Array:
        g = self.groups
        j = np.zeros((g, GROUP_PIXELS, 3, SHARED + EACH * GROUP_PIXELS))
        shape = (g, GROUP_PIXELS, 3)
        e, b = total[:, 0, 0].reshape(shape), total[:, 0, 1].reshape(shape)
        value = rows[:, 0].reshape(shape)
        lit = screen.reshape(shape)
        for c in range(3):
            j[:, :, c, c] = e[..., c] / np.pi
            j[:, :, c, 3 + c] = b[..., c]
            j[:, :, c, 7 + c] = lit[..., c]
        j[..., 6] = rows[:, 1].reshape(shape)
        j[..., 10] = value - lit
        for i in range(GROUP_PIXELS):
            k = SHARED + EACH * i
            j[:, i, :, k] = rows[:, 2].reshape(shape)[:, i]
            j[:, i, :, k + 1] = rows[:, 3].reshape(shape)[:, i]
            j[:, i, :, k + 2] = value[:, i]
        return j.reshape(g, GROUP_PIXELS * 3, -1)

    def errors(self, pattern: Array) -> dict[str, float]:
        """Root-mean-square posterior sd of each map, and the criterion."""
        return self.errors_of(self.prior + self.information(pattern))

    def information(self, pattern: Array) -> Array:
        """What a photo under a pattern tells, Jᵀ N⁻¹ J (groups, unknowns, unknowns)."""
        _, j, jn = self._solve(pattern)[:3]
        return np.asarray(np.swapaxes(j, 1, 2) @ jn)

    def errors_of(self, precision: Array) -> dict[str, float]:
        """The same as `errors`, of a posterior precision."""
        sd = np.sqrt(self._mse(np.linalg.inv(precision)))
        out = dict(zip(NAMES, sd.tolist(), strict=True))
        out["criterion"] = float(np.dot(MAP_WEIGHTS, sd / np.sqrt(self.prior_mse)))
        return out

    def _solve(self, pattern: Array) -> tuple[Array, ...]:
        total, weights, rows, screen = self._forward(pattern)
        j = self._jacobian(total, rows, screen)
        value = rows[:, 0].reshape(self.groups, -1)
        mean = value.mean()
        noise = (SENSOR_NOISE * value) ** 2 + (MODEL_NOISE * mean) ** 2
        jn = j / noise[..., None]
        precision = self.prior + np.swapaxes(j, 1, 2) @ jn
        return np.linalg.inv(precision), j, jn, noise, value, mean, total, weights

    def __call__(self, pattern: Array) -> tuple[float, Array]:
        """The criterion and its gradient with respect to the pattern."""
        covariance, j, _, noise, value, mean, total, weights = self._solve(pattern)
        mse = self._mse(covariance)
        sd = np.sqrt(mse)
        scale = np.asarray(MAP_WEIGHTS) / np.sqrt(self.prior_mse)
        loss = float(scale @ sd)
        # d mse_m = -tr(C diag(maps_m) C dH) / groups
        d = (scale / (2 * sd) / self.groups) @ self.maps
        g = -(covariance * d) @ covariance
        jg = j @ g
        d_j = 2 * jg / noise[..., None]
        d_noise = -np.einsum("gij,gij->gi", jg, j) / noise**2
        d_value = d_noise * 2 * SENSOR_NOISE**2 * value
        d_value += (d_noise.sum() * 2 * MODEL_NOISE**2 * mean) / value.size
        return loss, self._to_pattern(d_j, d_value, total, weights)

    def _to_pattern(self, d_j: Array, d_value: Array, total: Array, weights: Array) -> Array:
        """Back through `_jacobian` and `_forward`."""
        g = self.groups
        d_j = d_j.reshape(g, GROUP_PIXELS, 3, -1)
        shape = (g * GROUP_PIXELS, 3)
        own = lambda k: np.stack(  # noqa: E731
            [d_j[:, i, :, SHARED + EACH * i + k] for i in range(GROUP_PIXELS)], 1
        ).reshape(shape)
        d_rows = np.zeros((g * GROUP_PIXELS, 4, 3))
        d_rows[:, 0] = d_value.reshape(shape) + own(2) + d_j[..., 10].reshape(shape)
        d_rows[:, 1] = d_j[..., 6].reshape(shape)
        d_rows[:, 2], d_rows[:, 3] = own(0), own(1)
        diagonal = lambda k: np.stack(  # noqa: E731
            [d_j[:, :, c, k + c] for c in range(3)], -1
        ).reshape(shape)
        d_screen = diagonal(7) - d_j[..., 10].reshape(shape)
        d_total = np.einsum("mrc,mtc->mrtc", d_rows, weights)
        d_total[:, 0] += d_screen[:, None] * weights
        d_total[:, 0, 0] += diagonal(0) / np.pi
        d_total[:, 0, 1] += diagonal(3)
        flat = d_total.reshape(-1, 3).astype(np.float32)
        return (self.screen.T @ flat).reshape(self.cells, self.cells, 3).astype(np.float64)


def _prior_precision(metal: NDArray[np.bool_]) -> Array:
    """(groups, unknowns, unknowns)."""
    n = SHARED + EACH * GROUP_PIXELS
    out = np.zeros((len(metal), n, n))
    same = np.eye(3)

    def block(sd: float, correlation: float) -> Array:
        return np.linalg.inv(sd**2 * (correlation + (1 - correlation) * same))

    dielectric, bare = ~metal, metal
    out[dielectric, 0:3, 0:3] = block(DIFFUSE_SD, 0.8)
    out[bare, 0:3, 0:3] = block(METAL_DIFFUSE_SD, 0.8)
    out[dielectric, 3:6, 3:6] = block(SPECULAR_SD, 0.95)
    out[bare, 3:6, 3:6] = block(METAL_SPECULAR_SD, 0.8)
    sd = np.ones(n)
    sd[6] = ROUGHNESS_SD
    sd[7:10], sd[10] = GAIN_SD, ROOM_SD
    sd[SHARED::EACH] = sd[SHARED + 1 :: EACH] = SLOPE_SD
    sd[SHARED + 2 :: EACH] = ALBEDO_SD
    i = np.arange(6, n)
    out[:, i, i] = 1 / sd[6:] ** 2
    return out
