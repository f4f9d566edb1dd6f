"""The maps that explain photos best, given what networks expect of their own errors.

Each pixel is at the mode of one posterior. With θ = (k_d, k_s, ρ, slopes), the forward model I(θ)
and the readings θ_d and θ_m of a pixel as dielectric and as metal, its unknowns are a share of
metal g and a deviation e:

    θ = (1 - g)·θ_d + g·θ_m + e,      photo ~ (1 - g)·I(θ_d) + g·I(θ_m) + J·e + noise.

- **Photo.** The noise is N(0, R), mostly of what gains and room may be off by. A residual that is
  unlikely even so, q times its expected square, comes of something that the model lacks: wrong
  lights, or relief. It counts by 1/q², like the tails of Geman and McClure's loss (Statistical
  methods for tomographic image reconstruction, 1987); else albedos would make up for it.
- **Two materials.** A surface mirrors with an f0 near 0.04, or it is a bare metal and scatters
  nothing. Between the two there is only a pixel that shows both, whose radiance is the mean by
  area; but networks blur the border. How far the network's f0 is on the way from dielectric to
  metal, γ, is the mean of g ~ N(γ, s²); s is large where γ is in the middle. The readings are the
  network's maps where these are one of the two, and local means of such maps elsewhere. Where a
  sample has only one, e is all.
- **Networks.** e ~ N(0, Σ), with the expected errors within a material. A network errs alike over a
  whole material, so what a pixel's own numbers say of roughness or slopes is mostly an error of
  something else: their errors count in the expected spread of the residual, but roughness takes
  none of its step and slopes a fifth, as in the Schmidt–Kalman filter.

Radiance is linear in g and nearly so in the albedos: one Gauss–Newton step K·residual from g = γ
and e = 0 is taken for the mode. The errors that remain are those of this suboptimal gain K,
(1 - KJ)Σ(1 - KJ)ᵀ + KRKᵀ, with the whole expected error in Σ, also what a material's pixels share.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from invrender.refine.gauss_newton import Observation, Refined, bands, expected_spread
from invrender.refine.priors import Prior
from invrender.refine.theta import D, N, S, dielectric_share, project, to_maps
from invrender.sampling import resize
from invrender.types import TINY, Array


@dataclass(frozen=True)
class Settings:
    """Numbers of the posterior. f0 is the mean of k_s over the colours. By hand: chosen by hand on
    17 simulated captures (docs/research-log/2026-11-29-posterior.md), where half or twice the
    number changes the mean map error by less than 1%."""

    photo_noise: tuple[float, float] = (0.1, 0.05)  # of the pixel and of the photo's mean: lights
    unlikely: float = 1.0  # mean squared residual in its spread from which it counts less; by hand
    slope_share: float = 0.2  # of its step that a slope takes, roughness none; by hand
    metal_f0: float = 0.2  # below it there is no metal; iron oxides have 0.2, metals 0.5 and more
    metal_range: tuple[float, float] = (
        0.6,
        0.8,
    )  # of the sample's greatest f0: no metal; surely one
    greatest: float = 0.98  # quantile of f0 that counts as the greatest
    least_part: float = 0.01  # of the sample that each of two materials must have
    own: float = 0.1  # doubt of a pixel's material up to which it is read as the network says
    share_sigma: tuple[float, float] = (0.1, 0.3)  # of g: where γ is 0 or 1; where it is a half
    f0_sigma: tuple[float, float] = (0.005, 0.3)  # at most, of a dielectric and of a metal
    least_sigma: float = 0.002  # of k_d in a metal
    widths: tuple[float, ...] = (0.5, 0.1, 0.03)  # of the sample's side: the local means' Gaussians
    enough: float = 0.02  # weight from which a narrower mean replaces a wider one
    grid: int = 128  # pixels a side of the local means

    @property
    def take(self) -> Array:
        """Share of its step that each of θ (9,) takes."""
        return np.array([1] * 6 + [0] + [self.slope_share] * 2, np.float32)


SETTINGS = Settings()


@dataclass(frozen=True)
class Readings:
    """θ (H, W, 9) of each pixel as dielectric and as metal, and the network's share of metal
    (H, W)."""

    dielectric: Array
    metal: Array
    share: Array


def read_materials(theta: Array, s: Settings = SETTINGS) -> Readings | None:
    """Both readings of maps θ (H, W, 9); None where the sample is of one kind."""
    f0 = theta[..., S].mean(-1)
    top = float(np.quantile(f0, s.greatest))
    is_dielectric = dielectric_share(theta)
    low, high = (x * top for x in s.metal_range)
    is_metal = np.clip((f0 - low) / max(high - low, 1e-6), 0, 1) * (f0 > s.metal_f0)
    if min(is_dielectric.mean(), is_metal.mean()) < s.least_part:
        return None
    dielectric, metal = (_local_mean(theta, weight, s) for weight in (is_dielectric, is_metal))
    f0_dielectric, f0_metal = (x[..., S].mean(-1) for x in (dielectric, metal))
    share = np.clip((f0 - f0_dielectric) / (f0_metal - f0_dielectric), 0, 1)
    dielectric = np.where((share < s.own)[..., None], theta, dielectric)
    metal = np.where((share > 1 - s.own)[..., None], theta, metal)
    metal[..., D] = 0
    dielectric[..., N] = metal[..., N] = theta[..., N]
    return Readings(project(dielectric), project(metal), share.astype(np.float32))


def _local_mean(theta: Array, weight: Array, s: Settings) -> Array:
    """Weighted means (H, W, 9) near each pixel; of wider surroundings where there is no weight."""
    height, width = theta.shape[:2]
    low = min(height, s.grid), min(width, s.grid)
    weight = weight[..., None].astype(np.float32)
    sums, weight = resize(theta * weight, *low), resize(weight, *low)
    mean = sums.mean((0, 1)) / weight.mean()
    for reach in s.widths:
        blur = (reach * max(low), reach * max(low), 0)
        mean = gaussian_filter(sums, blur) + s.enough * mean
        mean = mean / (gaussian_filter(weight, blur) + s.enough)
    return resize(mean.astype(np.float32), height, width)


def explain(
    observations: Sequence[Observation], prior: Prior, *, samples: int = 64, s: Settings = SETTINGS
) -> Refined:
    """The mode of the posterior, from a network's maps and what it expects of its errors.

    Saturated pixels keep the prior's mean. Ctrl-C ends it with what was found so far.
    """
    began = time.perf_counter()
    theta = project(prior.mean.copy())
    left = prior.expected.copy()
    readings = read_materials(theta, s)
    squares, seen, interrupted = 0.0, 0, False
    try:
        for band in bands(observations, s.photo_noise, samples):
            rows = band.rows
            sigma = prior.sigma[rows]
            if readings is None:
                residual, jacobian = band.residual(theta[rows])
            else:
                share = readings.share[rows][..., None]
                ends = readings.dielectric[rows], readings.metal[rows]
                (r0, j0), (r1, j1) = (band.residual(end) for end in ends)
                residual = (1 - share) * r0 + share * r1
                jacobian = (1 - share[..., None]) * j0 + share[..., None] * j1
                sigma = _sigma_of_both(sigma, share, s)
            squares, seen = squares + band.squares(residual), seen + int(band.seen.sum())
            _, ac, spread = expected_spread(jacobian, sigma, prior.correlation, band.noise)
            if readings is not None:
                between = _share_sigma(share, s) * (r0 - r1)  # radiance of one deviation of g
                spread += between[..., :, None] * between[..., None, :]
            inverse = np.linalg.inv(spread)
            surprise = np.einsum("hwc,hwcd,hwd->hw", residual, inverse, residual)
            surprise /= residual.shape[-1]
            trust = np.minimum(1, s.unlikely / np.maximum(surprise, TINY))[..., None, None] ** 2
            gain = s.take[:, None] * trust * (np.swapaxes(ac, -1, -2) @ inverse) * sigma[..., None]
            if readings is not None:
                # What two materials differ by is no outlier: g takes its whole step, as far as
                # there is metal or dielectric left.
                gain_g = _share_sigma(share, s) * np.einsum("hwc,hwcd->hwd", between, inverse)
                step = np.einsum("hwc,hwc->hw", gain_g, residual)[..., None]
                taken = np.clip(share + step, 0, 1) - share
                change = (ends[1] - ends[0]) * (np.arange(9) < N.start)
                theta[rows] += taken * change
                cut = taken / np.where(np.abs(step) > TINY, step, 1)
                gain_all = gain + (change * cut)[..., None] * gain_g[..., None, :]
            else:
                gain_all = gain
            theta[rows] = project(
                (theta[rows] + np.einsum("hwpc,hwc->hwp", gain, residual)).astype(np.float32)
            )
            rest = (np.eye(9, dtype=np.float32) - gain_all @ jacobian) * left[rows][..., None, :]
            variance = np.einsum("hwpq,qr,hwpr->hwp", rest, prior.correlation, rest)
            measured = np.where(band.seen, band.noise, 0)  # where clipped, the gain is nought
            variance += np.einsum("hwpc,hwc,hwpc->hwp", gain_all, measured, gain_all)
            left[rows] = np.sqrt(np.clip(variance, 0, None))
    except KeyboardInterrupt:
        interrupted = True
    error = float(np.sqrt(squares / max(seen, 1)))
    history = [{"seconds": time.perf_counter() - began, "photo_error": error}]
    return Refined(to_maps(theta), left, history, not interrupted, interrupted)


def _sigma_of_both(sigma: Array, share: Array, s: Settings) -> Array:
    """Deviations of e where a sample has both kinds: a dielectric's f0 is known, a metal scatters
    nothing."""
    sigma = sigma.copy()
    dielectric, metal = s.f0_sigma
    sigma[..., S] = np.minimum(sigma[..., S], (1 - share) * dielectric + share * metal)
    sigma[..., D] = (1 - share) * sigma[..., D] + s.least_sigma
    return sigma


def _share_sigma(share: Array, s: Settings) -> Array:
    """The deviation of g, by the network's share of metal."""
    sure, half = (x**2 for x in s.share_sigma)
    return np.sqrt(sure + (half - sure) * 4 * share * (1 - share))
