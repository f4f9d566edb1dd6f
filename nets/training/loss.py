"""What is minimised, and what is measured."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nets.batch import Batch
from nets.model import MAPS

# Spread of each map over the training data: the error of a constant guess. Errors are measured in
# it, so that normals (small) and roughness (smooth) weigh as much as albedos from the start.
SPREADS = {"normal": 0.065, "diffuse": 0.19, "roughness": 0.26, "specular": 0.17}
NORMAL0_WEIGHT = 0.5
SIGMA_WEIGHT = 0.1


def truth(batch: Batch) -> dict[str, Tensor]:
    """Maps as errors are measured, normals encoded to [0, 1], from a batch's bytes."""
    maps = batch["maps"].float() / 255
    xy = maps[:, :2] * 2 - 1
    square = (xy * xy).sum(1, keepdim=True)
    z2 = (1 - square).clamp(min=1e-4)
    n = torch.cat([xy, z2.sqrt()], 1) * torch.rsqrt(square + z2)
    return {
        "normal": n / 2 + 0.5,
        "diffuse": maps[:, 2:5],
        "roughness": maps[:, 5:6],
        "specular": maps[:, 6:9],
    }


def predicted(out: Batch) -> dict[str, Tensor]:
    """The network's maps in the same encoding."""
    return {k: out[k] / 2 + 0.5 if k == "normal" else out[k] for k in MAPS}


def compare(out: Batch, batch: Batch) -> dict[str, tuple[Tensor, Tensor]]:
    """Squared error and |error| / sigma of each map, both of the map's shape."""
    a, b = predicted(out), truth(batch)
    result = {}
    for i, k in enumerate(MAPS):
        error = a[k] - b[k]
        result[k] = error**2, error.abs() / out["sigma"][:, i : i + 1]
    return result


def total_loss(out: Batch, batch: Batch) -> tuple[Tensor, Batch]:
    """The loss, and it and its parts as numbers without gradients.

    Per map: mean |error| and mean squared error in units of `SPREADS`; L1 on the initial normals;
    the Gaussian negative log-likelihood of sigma given the error, which does not move the maps.
    """
    a, b = predicted(out), truth(batch)
    parts: dict[str, Tensor] = {}
    sigma_loss = torch.zeros((), device=out["sigma"].device)
    for i, k in enumerate(MAPS):
        error = (a[k] - b[k]) / SPREADS[k]
        parts[k] = 0.5 * error.abs().mean() + 0.5 * (error**2).clamp(max=16).mean()
        sigma = out["sigma"][:, i : i + 1]
        square = ((a[k] - b[k]).detach() / sigma) ** 2
        # Beyond some sigmas it grows like the error, so that outliers do not rule.
        robust = torch.where(square < 9, square, 6 * torch.sqrt(square.clamp(min=9)) - 9)
        sigma_loss = sigma_loss + (0.5 * robust + torch.log(sigma)).mean() + math.log(50)
    if "normal0" in out:
        error = (out["normal0"] / 2 + 0.5 - b["normal"]) / SPREADS["normal"]
        parts["normal0"] = NORMAL0_WEIGHT * error.abs().mean()
    parts["sigma"] = SIGMA_WEIGHT * sigma_loss
    total = torch.stack(list(parts.values())).sum()
    return total, {k: v.detach() for k, v in (*parts.items(), ("loss", total))}
