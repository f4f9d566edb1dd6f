"""A photo and its lights as the networks' input tensors."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from invrender.maps import Maps
from invrender.refine.lobes import Lobes
from invrender.refine.theta import to_theta
from invrender.types import Array
from nets.model import Batch

PIXELS = (
    "photo",
    "ideal",
    "maps",
    "clipped",
    "theta",
    "sigma0",
    "image",
    "jacobian",
    "lobes",
    "readings",
)


def positions(height: int, width: int) -> Tensor:
    """Pixel centres over the sample, (2, H, W) in [-1, 1], x right and y up."""
    x = (torch.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (torch.arange(height) + 0.5) / height * 2
    return torch.stack(torch.meshgrid(x, y, indexing="xy"))


def batch_of(photo: Array, lights: dict[str, Array], lobes: Lobes | None) -> Batch:
    """The first network's batch (`nets.model`) of one photo (H, W, 3) and `light_inputs`."""
    batch = {k: torch.from_numpy(v)[None] for k, v in lights.items()}
    batch["photo"] = torch.from_numpy(np.ascontiguousarray(photo.transpose(2, 0, 1)))[None]
    batch["position"] = positions(*photo.shape[:2])[None]
    if lobes is not None:
        batch |= {k: torch.from_numpy(v)[None] for k, v in lobe_inputs(lobes).items()}
    return batch


def lobe_inputs(lobes: Lobes) -> dict[str, Array]:
    """What the first network is told of a fit: lobes (7, H, W), readings (16, H, W), costs."""
    readings = np.ascontiguousarray(np.moveaxis(lobes.readings, -1, 0))
    return {"lobes": lobe_input(lobes.maps), "readings": readings, "costs": lobes.costs}


def lobe_input(lobes: Maps) -> Array:
    """Albedos and roughness of a fit (`invrender.refine.lobes`) as the networks see them, (7, H,
    W)."""
    return np.ascontiguousarray(np.moveaxis(to_theta(lobes)[..., :7], -1, 0))
