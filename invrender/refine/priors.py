"""What is known of the maps before the photo is fitted, as a Gaussian a pixel.

A pixel's nine parameters are θ = (k_d, k_s, ρ, slopes p and q of n ∝ (p, q, 1)), an image of them
(H, W, 9).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from invrender.maps import Maps
from invrender.refine.theta import D, N, R, S, to_theta
from invrender.types import Array

# By how much errors exceed what the networks expect, in the order of θ, where lights are estimated:
# benchmarks/refine_calibrate.py, with the weights in the package.
ERROR_INFLATION = np.array([2.05] * 3 + [1.1] * 3 + [1.1] + [1.35] * 2, np.float32)


@dataclass(frozen=True)
class Spreads:
    """How far a pixel's parameters lie from its material's, as standard deviations; all chosen by
    hand. Pairs: a constant part, and a share of the albedo."""

    lobe_diffuse: tuple[float, float] = (0.01, 0.05)  # of maps found without a network
    lobe_specular: tuple[float, float] = (0.002, 0.05)  # of these, times the share of metal
    metal_f0: tuple[float, float] = (0.06, 0.36)  # k_s of no metal, and of nothing but metal
    lobe_roughness: float = 0.02
    lobe_slope: float = 0.05
    lobe_correlation: tuple[float, float] = (0.98, 0.95)  # of the channels of k_d, and of k_s
    network_diffuse: tuple[float, float] = (0.01, 0.15)  # of a network's maps, at most
    network_specular: tuple[float, float] = (0.01, 0.3)
    network_correlation: tuple[float, float] = (0.9, 0.95)
    least: float = 1e-4  # of what a network expects of its errors


WITHIN_MATERIAL = Spreads()


@dataclass
class Prior:
    """mean, sigma: (H, W, 9) in the order of θ; correlation: (9, 9), of the deviations.

    total: (H, W, 9), the expected error where ``sigma`` is only what a pixel may move by, without
    what its whole material shares; None where they are the same.
    """

    mean: Array
    sigma: Array
    correlation: Array
    total: Array | None = None

    @property
    def expected(self) -> Array:
        """The expected errors (H, W, 9)."""
        return self.sigma if self.total is None else self.total


def lobe_prior(maps: Maps, spreads: Spreads = WITHIN_MATERIAL) -> Prior:
    """The uncertainty within a material of maps from `invrender.refine.lobes`: mostly shade and
    relief."""
    mean = to_theta(maps)
    sigma = np.zeros_like(mean)
    none, all_ = spreads.metal_f0
    metal = np.clip((maps.specular - none) / (all_ - none), 0, 1)
    sigma[..., D] = spreads.lobe_diffuse[0] + spreads.lobe_diffuse[1] * maps.diffuse
    sigma[..., S] = spreads.lobe_specular[0] + spreads.lobe_specular[1] * metal
    sigma[..., R], sigma[..., N] = spreads.lobe_roughness, spreads.lobe_slope
    return Prior(mean, sigma, channel_correlation(*spreads.lobe_correlation))


def network_prior(maps: Maps, sigma: dict[str, Array], spreads: Spreads = WITHIN_MATERIAL) -> Prior:
    """The uncertainty of a network's maps, from what it expects of its errors, (H, W) a map.

    ``sigma`` of normals is that of n/2 + 1/2. An albedo's error within a material is at most a
    share of it. The total error is `ERROR_INFLATION` times what the network expects; a step is made
    with the same part of each, so that none grows by it.
    """
    mean = to_theta(maps)
    nominal = np.empty_like(mean)
    nominal[..., D], nominal[..., S] = (sigma[k][..., None] for k in ("diffuse", "specular"))
    nominal[..., R] = sigma["roughness"]
    nominal[..., N] = 2 * sigma["normal"][..., None]
    nominal = np.maximum(nominal, spreads.least)
    total = ERROR_INFLATION * nominal
    spread = total / ERROR_INFLATION.max()
    for k, albedo, (constant, share) in (
        (D, maps.diffuse, spreads.network_diffuse),
        (S, maps.specular, spreads.network_specular),
    ):
        spread[..., k] = np.minimum(spread[..., k], constant + share * albedo)
    return Prior(mean, spread, channel_correlation(*spreads.network_correlation), total)


def channel_correlation(diffuse: float, specular: float) -> Array:
    """(9, 9): an albedo's channels vary together."""
    correlation = np.eye(9)
    for k, r in ((D, diffuse), (S, specular)):
        correlation[k, k] = r + (1 - r) * np.eye(3)
    return correlation.astype(np.float32)


def pooled(priors: Sequence[Prior]) -> Prior:
    """What several photos' priors of the same sample tell together: means weighted by precision.

    A network errs on a material in much the same way from every photo, so the expected error does
    not fall with their number: it is that of the mean precision.
    """
    if len(priors) == 1:
        return priors[0]
    precision = [1 / p.sigma**2 for p in priors]
    sum_ = np.sum(precision, 0)
    mean = np.sum([w * p.mean for w, p in zip(precision, priors, strict=True)], 0) / sum_
    totals = [p.expected for p in priors]
    total = np.sqrt(len(priors) / np.sum([1 / t**2 for t in totals], 0))
    return Prior(mean, np.sqrt(len(priors) / sum_), priors[0].correlation, total)
