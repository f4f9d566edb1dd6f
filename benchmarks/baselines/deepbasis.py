"""DeepBasis+: maps as a mixture of a few basis materials, from a flash photo in a lit room.

Wang et al. 2023, "DeepBasis: Hand-Held Single-Image SVBRDF Capture via Two-Level Basis Material
Model", small and on the blocks of `nets`: a global network gives each photo `BASES` materials and
each pixel their weights, a local one moves the bases from pixel to pixel. Afterwards the global
bases alone are fitted to the photo by AdamW through the renderer. Adapted to a lit room: the fit
has the room's light, taken as the same from everywhere, as another unknown.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from benchmarks.baselines.flash import flash_render
from nets.batch import Batch
from nets.blocks import Decoder, Encoder, blocks, channels_last_cat, pad_to
from nets.model import Config, encode, slope_normal
from nets.training.loss import SPREADS

BASES = 10
PARAMETERS = 9  # diffuse, specular, roughness, slopes
REFERENCE = (0.1, 0.5, 0.15)  # diffuse, specular, roughness of the material whose photo is an input
STEPS, RATE = 500, 1e-3
ROOM, ROOM_RATE = 0.02, 0.02  # of the fit's constant room: radiance to begin with, step of its log
MIDDLE = (-1.0,) * 3 + (-3.0,) * 3 + (0.0,) * 3  # logits of a fresh network's materials


class DeepBasis(nn.Module):
    """Returns what `nets.model.Network` returns, with constant expected errors and no normal0."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        levels, width = len(config.encoder), config.width
        deep = width << levels
        self.multiple = 1 << levels
        self.encoder = Encoder(8, width, config.encoder)
        self.middle = blocks(deep, config.middle)
        self.bases = nn.Sequential(
            nn.Linear(deep, deep), nn.GELU(), nn.Linear(deep, BASES * PARAMETERS)
        )
        self.weights = Decoder(BASES, width, config.decoder)
        self.local_encoder = Encoder(8 + BASES + PARAMETERS + 3, width, config.encoder)
        self.local = Decoder(BASES * PARAMETERS, width, config.decoder)
        nn.init.zeros_(self.local.ending.weight)
        nn.init.zeros_(self.local.ending.bias)  # type: ignore[arg-type]
        self.register_buffer("start", torch.tensor(MIDDLE), persistent=False)

    def decompose(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of the bases (B, K, 9), and for each pixel their weights (B, K, H, W) and moves
        (B, K, 9, H, W)."""
        height, width = batch["flash"].shape[-2:]
        photo = pad_to(batch["flash"], self.multiple)
        position = pad_to(batch["position"], self.multiple)
        inputs = [encode(photo), encode(reference(position)), position]
        x, skips = self.encoder(channels_last_cat(inputs))
        x = self.middle(x)
        bases = self.bases(x.mean((2, 3))).unflatten(1, (BASES, PARAMETERS)) + self.start
        weights = self.weights(x, skips).softmax(1)
        theta = mixed(bases, weights, torch.zeros_like(weights[:, :, None]))
        left = encode(photo) - encode(flash_render(theta, position))
        x, skips = self.local_encoder(channels_last_cat([*inputs, weights, theta, left]))
        moves = self.local(x, skips).unflatten(1, (BASES, PARAMETERS))
        return bases, weights[..., :height, :width], moves[..., :height, :width]

    def forward(self, batch: Batch) -> Batch:
        return as_maps(mixed(*self.decompose(batch)))


def reference(position: Tensor) -> Tensor:
    """The reference material's photo, (B, 3, H, W)."""
    diffuse, specular, roughness = REFERENCE
    theta = torch.zeros_like(position[:, :1]).repeat(1, PARAMETERS, 1, 1)
    theta[:, :3], theta[:, 3:6], theta[:, 6] = diffuse, specular, roughness
    return flash_render(theta, position)


def mixed(bases: Tensor, weights: Tensor, moves: Tensor) -> Tensor:
    """θ (B, 9, H, W) as `flash_render` takes it: Σ w·b, of bases that lie within their ranges."""
    logits = bases[..., None, None] + moves
    theta = torch.cat([logits[:, :, :7].sigmoid(), logits[:, :, 7:].tanh()], 2)
    return (weights[:, :, None] * theta).sum(1)


def as_maps(theta: Tensor) -> Batch:
    """The networks' output, of θ and constant expected errors."""
    errors = torch.tensor(list(SPREADS.values()))[:, None, None]
    return {
        "normal": slope_normal(theta[:, 7:]),
        "diffuse": theta[:, :3],
        "roughness": theta[:, 6:7],
        "specular": theta[:, 3:6],
        "sigma": errors.expand(len(theta), 4, *theta.shape[-2:]),
    }


def refine(network: DeepBasis, batch: Batch, steps: int = STEPS) -> Batch:
    """The network's answer with its global bases fitted to the photo: L1, AdamW."""
    with torch.no_grad():
        start, weights, moves = network.decompose(batch)
    bases = start.clone().requires_grad_()
    room = torch.full((len(start), 3, 1, 1), math.log(ROOM), requires_grad=True)
    optimiser = torch.optim.AdamW([bases], RATE)
    optimiser.add_param_group({"params": [room], "lr": ROOM_RATE, "weight_decay": 0.0})
    photo, position = batch["flash"], batch["position"]
    for _ in range(steps):
        theta = mixed(bases, weights, moves)
        lit = flash_render(theta, position) + room.exp() * (theta[:, :3] + theta[:, 3:6])
        loss = (lit - photo).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        return as_maps(mixed(bases, weights, moves))
