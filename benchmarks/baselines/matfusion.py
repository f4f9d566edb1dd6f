"""MatFusion: maps drawn from a diffusion prior, conditioned on a photo with and one without flash.

Sartor and Peers 2023, "MatFusion: A Generative Diffusion Model for SVBRDF Capture", small and on
the blocks of `nets`: v-prediction under a cosine schedule with no signal at its end, the photos as
further input channels, Euler's steps from noise to maps (that is DDIM without added noise). Each
seed gives other maps; `several` draws some at once.
"""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from benchmarks.baselines.deepbasis import PARAMETERS, as_maps
from nets.batch import Batch
from nets.blocks import Decoder, Encoder, blocks, channels_last_cat, pad_to
from nets.model import Config, encode
from nets.training.loss import truth

STEPS = 20  # of a draw
SEEDS = 4  # draws of a capture
UNSEEN = 1 / 255  # errors below half of an 8-bit step of maps in [-1, 1] do not count
FREQUENCIES = 4  # of the time's sines and cosines
SLOPE_SCALE = 2.0  # slopes of encoded normals in [-1, 1] are small beside albedos


class MatFusion(nn.Module):
    """forward(batch) while training: what the loss needs, see `diffusion_loss`; in evaluation the
    maps of seed 0 with constant expected errors."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        levels, width = len(config.encoder), config.width
        deep = width << levels
        self.multiple = 1 << levels
        self.encoder = Encoder(PARAMETERS + 3 + 3 + 2 + 2 * FREQUENCIES, width, config.encoder)
        self.time = nn.Sequential(
            nn.Linear(2 * FREQUENCIES, deep), nn.GELU(), nn.Linear(deep, deep)
        )
        self.middle = blocks(deep, config.middle)
        self.decoder = Decoder(PARAMETERS, width, config.decoder)

    def velocity(self, x: Tensor, time: Tensor, batch: Batch) -> Tensor:
        """v = α·noise - σ·maps at times (B,) in [0, 1], of noisy maps x (B, 9, H, W)."""
        height, width = x.shape[-2:]
        phase = time[:, None] * torch.pi * 2.0 ** torch.arange(FREQUENCIES)
        waves = torch.cat([phase.sin(), phase.cos()], 1)
        images = [x, encode(batch["flash"]), encode(batch["room"]), batch["position"]]
        images.append(waves[..., None, None].expand(-1, -1, height, width))
        z, skips = self.encoder(pad_to(channels_last_cat(images), self.multiple))
        z = self.middle(z + self.time(waves)[..., None, None])
        v: Tensor = self.decoder(z, skips)[..., :height, :width]
        return v

    def forward(self, batch: Batch) -> Batch:
        if not self.training:
            return self.draw(batch, 0)
        maps = packed(batch)
        time = torch.rand(len(maps))
        signal, spread = schedule(time)
        noise = torch.randn_like(maps)
        v = self.velocity(signal * maps + spread * noise, time, batch)
        return {"v": v, "target": signal * noise - spread * maps}

    @torch.no_grad()
    def draw(self, batch: Batch, seed: int, steps: int = STEPS) -> Batch:
        """Maps of one seed."""
        photo = batch["flash"]
        source = torch.Generator().manual_seed(seed)
        x = torch.randn(len(photo), PARAMETERS, *photo.shape[-2:], generator=source)
        times = torch.linspace(1, 0, steps + 1)
        for now, after in pairwise(times):
            (a, s), (b, t) = schedule(now), schedule(after)
            v = self.velocity(x, now.expand(len(x)), batch)
            maps, noise = (a * x - s * v).clamp(-1, 1), s * x + a * v
            x = b * maps + t * noise
        x = torch.cat([x[:, :7] / 2 + 0.5, x[:, 7:] / SLOPE_SCALE], 1)
        z = (1 - (x[:, 7:] ** 2).sum(1, keepdim=True)).clamp(min=0.01).sqrt()
        return as_maps(torch.cat([x[:, :7].clamp(0, 1), x[:, 7:] / z], 1))


def schedule(time: Tensor) -> tuple[Tensor, Tensor]:
    """Shares of maps and of noise, (B, 1, 1, 1), at times in [0, 1]."""
    angle = time.reshape(-1, 1, 1, 1) * (torch.pi / 2)
    return angle.cos(), angle.sin()


def packed(batch: Batch) -> Tensor:
    """True maps (B, 9, H, W), about [-1, 1]: diffuse, specular, roughness, normal's x and y."""
    maps = truth(batch)
    parts = [2 * maps[k] - 1 for k in ("diffuse", "specular", "roughness")]
    return torch.cat([*parts, SLOPE_SCALE * (2 * maps["normal"][:, :2] - 1)], 1)


def diffusion_loss(out: Batch, batch: Batch) -> tuple[Tensor, Batch]:
    """Mean squared error of v."""
    error = out["v"] - out["target"]
    loss = F.mse_loss(torch.where(error.abs() < UNSEEN, 0.0, error), torch.zeros_like(error))
    return loss, {"loss": loss.detach()}
