"""Near-mirrors, which the lobes' fit explains and the networks do not.

A narrow lobe shows the pattern itself, and networks blur it: from their maps a polished metal
leaves 20% of the photo's large shades, from the lobes 1%. Both readings are rendered, the lobes'
with one albedo for all of a material, so that no texture makes up for a wrong lobe; material by
material the lobes' is taken where it explains the photo far better.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from invrender.maps import Maps
from invrender.refine.gauss_newton import Observation, linearise
from invrender.refine.priors import Prior, lobe_prior
from invrender.refine.shared import grid, parts_of
from invrender.refine.theta import D, R, S, to_maps, to_theta
from invrender.types import TINY, Array


@dataclass(frozen=True)
class Settings:
    """Chosen by hand: of 9 extreme and 14 simulated samples the rule takes near-mirrors, polished
    metals and a polished marble (docs/research-log/2026-11-29-near-mirrors-from-lobes.md)."""

    widest: float = 0.2  # roughness of a lobe that counts as narrow
    explained: float = 0.05  # of a material's mean radiance, RMS of parts
    better: float = 0.25  # of what the networks' maps leave
    least_pixels: int = 40  # of a material, of those that are compared


MIRROR_SETTINGS = Settings()


def take_mirrors(
    observation: Observation, prior: Prior, lobes: Maps, *, samples: int = 64,
    s: Settings = MIRROR_SETTINGS,
) -> Prior:  # fmt: skip
    """The networks' prior with the maps of `invrender.refine.lobes` where they explain far more.

    lobes: of any size; the diffuse albedo of a dielectric is the networks' where it differs.
    """
    height, width = prior.mean.shape[:2]
    rows, columns = (
        np.arange(n) * of // n for n, of in zip((height, width), lobes.shape, strict=True)
    )
    theta = to_theta(lobes)[np.ix_(rows, columns)]
    if lobes.shape != (height, width):
        metal = (theta[..., D] == 0).all(-1, keepdims=True)
        theta[..., D] = np.where(metal, 0, prior.mean[..., D])
    label, count = _materials(theta)
    narrow = [k for k in range(count) if theta[label == k][0, R] <= s.widest]
    if not narrow:
        return prior
    plain = theta.copy()
    for k in narrow:
        plain[label == k, D] = np.median(theta[label == k, D], 0)
    misfits = [_misfits(observation, t, label, narrow, samples, s) for t in (prior.mean, plain)]
    taken = [
        k for k, network, own in zip(narrow, *misfits, strict=True)
        if own < min(s.explained, s.better * network)
    ]  # fmt: skip
    if not taken:
        return prior
    where = np.isin(label, taken)[..., None]
    sigma = lobe_prior(to_maps(theta)).sigma
    return replace(
        prior,
        mean=np.where(where, theta, prior.mean),
        sigma=np.where(where, sigma, prior.sigma),
        total=np.where(where, sigma, prior.expected),
    )


def _materials(theta: Array) -> tuple[NDArray[np.intp], int]:
    """Which lobe each pixel has (H, W), and how many there are."""
    lobe = np.concatenate([theta[..., S], theta[..., R : R + 1]], -1).reshape(-1, 4)
    kinds, label = np.unique(lobe, axis=0, return_inverse=True)
    return label.reshape(theta.shape[:2]), len(kinds)


def _misfits(
    observation: Observation, theta: Array, label: NDArray[np.intp], of: list[int], samples: int,
    s: Settings,
) -> list[float]:  # fmt: skip
    """What maps leave of each material, RMS of the means of parts over its mean radiance."""
    at = grid(theta)
    photo = observation.photo[at]
    image = linearise(observation.renderer, np.ascontiguousarray(theta[at]), samples)[0]
    part = parts_of(*photo.shape[:2])
    seen = True if observation.clipped is None else ~observation.clipped[at]
    found = []
    for k in of:
        weight = ((label[at] == k) & seen).ravel().astype(float)
        if weight.sum() < s.least_pixels:
            found.append(np.inf)
            continue
        fill = np.bincount(part, weight)
        rest, light = (
            np.array([np.bincount(part, weight * c) for c in x.reshape(-1, 3).T])
            for x in (photo - image, photo)
        )
        square = (rest**2 / np.maximum(fill, 1e-9)).sum() / weight.sum() / 3
        found.append(float(np.sqrt(square) / max(light.sum() / weight.sum() / 3, TINY)))
    return found
