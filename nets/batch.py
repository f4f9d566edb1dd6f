"""A photo and its lights as the networks' input tensors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from invrender.maps import Maps
from invrender.refine.evidence import MaterialEvidence
from invrender.refine.lobes import ROUGHNESS, Lobes
from invrender.refine.theta import to_theta
from invrender.types import Array

Batch = dict[str, Tensor]

# Keys of a batch with a value for each pixel; the last two are for other methods (benchmarks).
PIXELS = (
    "photo", "ideal", "maps", "clipped", "theta", "sigma0", "image", "jacobian", "lobes",
    "evidence", "flash", "room",
)  # fmt: skip

# Fields of `MaterialEvidence`: the channels of those that are images, as packed; the others.
EVIDENCE = {
    "dielectric_diffuse": 3,
    "dielectric_roughness": 1,
    "metal_specular": 3,
    "metal_roughness": 1,
    "material_odds": 1,
    "sample_odds": 1,
    "texture_odds": 1,
    "dielectric_texture_roughness": 1,
    "metal_texture_roughness": 1,
    "metal_material_specular": 3,
}
COSTS = ("residual_costs", "texture_costs")
EVIDENCE_CHANNELS = sum(EVIDENCE.values())
COST_COUNT = len(COSTS) * 2 * len(ROUGHNESS)


def positions(height: int, width: int) -> Tensor:
    """Pixel centres over the sample, (2, H, W) in [-1, 1], x right and y up."""
    x = (torch.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (torch.arange(height) + 0.5) / height * 2
    return torch.stack(torch.meshgrid(x, y, indexing="xy"))


def batch_of(photo: Array, lights: dict[str, Array], lobes: Lobes) -> Batch:
    """The first network's batch (`nets.model`) of one photo (H, W, 3) and `light_inputs`."""
    images = {**lights, "photo": np.ascontiguousarray(photo.transpose(2, 0, 1))}
    images |= lobe_inputs(lobes)
    batch = {k: torch.from_numpy(v)[None] for k, v in images.items()}
    batch["position"] = positions(*photo.shape[:2])[None]
    return batch


def lobe_inputs(lobes: Lobes) -> dict[str, Array]:
    """What the first network sees of a fit: lobes (7, H, W) and `pack_evidence`."""
    return {"lobes": lobe_input(lobes.maps), **pack_evidence(lobes.evidence)}


def lobe_input(lobes: Maps) -> Array:
    """Albedos and roughness of a fit (`invrender.refine.lobes`) as the networks see them, (7, H,
    W)."""
    return np.ascontiguousarray(np.moveaxis(to_theta(lobes)[..., :7], -1, 0))


def pack_evidence(evidence: MaterialEvidence) -> dict[str, Array]:
    """Evidence as network inputs, float32: evidence (16, H, W) and costs (40,)."""
    images = [
        np.moveaxis(np.atleast_3d(getattr(evidence, name)), -1, 0).astype(np.float32, copy=False)
        for name in EVIDENCE
    ]
    costs = [np.ravel(getattr(evidence, name)) for name in COSTS]
    return {"evidence": np.concatenate(images), "costs": np.concatenate(costs).astype(np.float32)}


def unpack_evidence(batch: Batch) -> MaterialEvidence:
    """The inverse of `pack_evidence` for a batch: images (B, 1 or 3, H, W), costs (B, 2, ρ)."""
    costs = batch["costs"].reshape(-1, len(COSTS), 2, len(ROUGHNESS)).unbind(1)
    return MaterialEvidence(
        **split_channels(batch["evidence"], EVIDENCE), **dict(zip(COSTS, costs, strict=True))
    )


def split_channels(x: Tensor, channels: Mapping[str, int]) -> Batch:
    """Parts of a tensor (B, C, H, W) by name, views of so many channels each."""
    return dict(zip(channels, x.split(list(channels.values()), 1), strict=True))
