"""What several photos of a sample say of its materials' roughness, all pixels of each together.

A pixel's own numbers often fit two lobes as well as each other, a narrow one and a wide one with
another albedo and another slope; a material's pixels together seldom do. So each pixel's unknowns
are solved for with every roughness of a list, and a material's distribution over the list is the
one that makes its pixels' photos likeliest (the nonparametric maximum likelihood of Kiefer and
Wolfowitz 1956, by Laird's EM 1978). Materials are groups of pixels of like maps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from invrender.refine.flat import PLAIN_ROUGHNESS
from invrender.refine.groups import group
from invrender.refine.theta import D, R, S
from invrender.types import Array

TRIED_ROUGHNESS = np.array((0.06, *PLAIN_ROUGHNESS), np.float32)  # polished stone to chalk


@dataclass(frozen=True)
class Settings:
    """Numbers of the pooling, chosen by hand (docs/research-log/2026-11-29-several-photos.md)."""

    materials: int = 6  # groups, at most
    least: int = 40  # pixels of a group
    steps: int = 60  # of EM, which settles within 30
    known: float = 0.2  # what the prior counts for, as a share of the group's pixels
    temper: float = 0.1  # of a pixel's log-likelihoods: photos and neighbours share their errors
    least_spread: float = 0.03  # of ρ within a material
    roughness_weight: float = 0.5  # of ρ against the roots of the albedos, as pixels are grouped


POOLING = Settings()


@dataclass(frozen=True)
class Pooled:
    """centres (K, 7): the materials' places among the features of maps; mean, spread (K,): of
    their roughness."""

    centres: Array
    mean: Array
    spread: Array

    def roughness(self, theta: Array) -> tuple[Array, Array]:
        """Mean and deviation (H, W) of ρ expected of pixels with maps θ (H, W, 9)."""
        features = _features(theta)
        distance = cdist(features, self.centres, "sqeuclidean").astype(np.float32)
        width = np.maximum(np.median(distance.min(1)), 1e-6)
        weight = np.exp(-(distance - distance.min(1, keepdims=True)) / (2 * width))
        weight /= weight.sum(1, keepdims=True)
        mean = weight @ self.mean
        variance = weight @ (self.spread**2 + self.mean**2) - mean**2
        shape = theta.shape[:2]
        return mean.reshape(shape), np.sqrt(np.maximum(variance, 0)).reshape(shape)


def pool_roughness(
    theta: Array,
    sigma: Array,
    solve: Callable[[float, Array], tuple[Array, Array]],
    s: Settings = POOLING,
) -> Pooled:
    """The materials of pixels with maps θ (H, W, 9), their roughness still the initial one; and the
    materials' own.

    sigma: the expected error (H, W) of the initial roughness, which counts where photos say
    nothing. solve: from a roughness and θ to start from to the pixels' best θ with it and -2
    log-likelihoods (H, W).
    """
    costs: list[Array] = [np.empty(0)] * len(TRIED_ROUGHNESS)
    middle = len(TRIED_ROUGHNESS) // 2
    for order in (range(middle, len(TRIED_ROUGHNESS)), range(middle - 1, -1, -1)):
        start = theta
        for j in order:
            start, costs[j] = solve(float(TRIED_ROUGHNESS[j]), start)
    cost = np.stack(costs).reshape(len(TRIED_ROUGHNESS), -1).astype(np.float64)
    likelihood = np.exp(-s.temper / 2 * (cost - cost.min(0)))
    features = _features(theta)
    label = _groups(features, s)
    centres, means, spreads = [], [], []
    for k in np.unique(label):
        of = label == k
        off = (TRIED_ROUGHNESS - theta[..., R].ravel()[of].mean()) / sigma.ravel()[of].mean()
        share = _mixture(likelihood[:, of], np.exp(-0.5 * off**2) + 1e-6, s)
        mean = float(share @ TRIED_ROUGHNESS)
        centres.append(features[of].mean(0))
        means.append(mean)
        spreads.append(max(float(np.sqrt(share @ (TRIED_ROUGHNESS - mean) ** 2)), s.least_spread))
    return Pooled(*(np.array(x, np.float32) for x in (centres, means, spreads)))


def _mixture(likelihood: Array, prior: Array, s: Settings) -> Array:
    """The distribution over a list (n,) of hypotheses that makes the pixels likeliest, of their
    likelihoods (n, pixels); it is the prior where these are all the same."""
    prior = prior / prior.sum()
    share = prior
    for _ in range(s.steps):
        joint = share[:, None] * likelihood
        share = (joint / np.maximum(joint.sum(0), 1e-300)).mean(1)
        share = (share + s.known * prior) / (1 + s.known)
    return share


def _features(theta: Array) -> Array:
    """Of pixels (H·W, 7), what materials differ by: roots of albedos, and roughness."""
    parts = [np.sqrt(theta[..., D]), np.sqrt(theta[..., S]), theta[..., R : R + 1]]
    parts[2] = parts[2] * POOLING.roughness_weight
    return np.concatenate(parts, -1).reshape(-1, 7).astype(np.float32)


def _groups(features: Array, s: Settings) -> NDArray[np.intp]:
    """A label a pixel."""
    return group(features, max(1, min(s.materials, len(features) // s.least)))[1]
