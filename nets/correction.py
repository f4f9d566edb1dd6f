"""The learned correction: one step from the network's maps towards the maps that explain the photo.

Learned gradient descent (Adler and Öktem 2017, "Solving ill-posed inverse problems using iterative
deep neural networks"): a small network sees, pixel by pixel and in their neighbourhood, the photo,
the maps so far with their expected errors, what the forward model makes of them, and the
Gauss–Newton step that the forward model's exact Jacobian proposes, and beside them a second
opinion: what all pixels of a material, fitted together, say of its lobe. It answers how far to go,
and the errors that remain. It is trained on what the first network leaves, on captures that it can
learn from: so where the photo says nothing of a quantity, it learns to leave it alone.

θ = (k_d, k_s, ρ, slopes p, q), as in `invrender.refine`. A batch is a dict of tensors:

    photo, image (B, 3, H, W): the photo and the rendering of θ; theta (B, 9, H, W); sigma0
    (B, 4, H, W): expected errors of `MAPS`; jacobian (B, 15, H, W): E/π and B (the derivatives by
    an albedo of the same colour), then ∂I/∂ρ, ∂I/∂p, ∂I/∂q; clipped (B, 1, H, W): one where the
    photo is saturated; lobes (B, 7, H, W): k_d, k_s and ρ as `invrender.refine.lobes` finds them
    without a network; position (B, 2, H, W). Radiance in units of that of a white plane.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nets.batch import Batch, split_channels
from nets.blocks import Decoder, Encoder, blocks, channels_last_cat, pad_to
from nets.model import (
    ENCODE_FLOOR,
    LEAST_MAP_ROUGHNESS,
    MAX_SIGMA,
    MIN_SIGMA,
    Config,
    encode,
    slope_normal,
)
from nets.slopes import asinh

INPUT_NOISE = (0.04, 0.01)  # of the photo: relative to the pixel, and to a white plane
ALBEDO_CORRELATION = (0.9, 0.95)  # between the colours of k_d's error, and of k_s's
REACH = (0.1, 0.1, 0.1, 0.2)  # of a step, in the outputs' unit: k_d, k_s, ρ, slopes
SIGMA_OFFSET = 1.5  # brings half the logarithm of an expected error to about [-1.5, 1.5]
MAX_SURPRISE = 1e4  # mean squared residual in its expected spread
DOUBT = 3.0  # logit by which a fresh correction keeps to the network's maps and not to the lobes
# What the decoder puts out, and how many channels each.
CORRECTION_OUTPUTS = {"step": 9, "log_sigma": 4, "towards_lobes": 7}
LOG_SIGMA_CHANGE = (-3.0, 2.0)  # bounds of the change of an expected error, as a logarithm
INPUTS = 3 * 4 + 9 + 4 + 9 + 6 + 9 + 1 + 2 + 7


def gauss_newton(batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """Residual (B, 3, H, W), nought where the photo is saturated; the maximum a posteriori step
    ΣJᵀ(JΣJᵀ + R)⁻¹·residual (B, 9, H, W) in deviations; and its surprise (B, 1, H, W), the
    mean squared residual in its expected spread."""
    photo, image = batch["photo"], batch["image"]
    residual = (photo - image) * (1 - batch["clipped"])
    e, b, r, p, q = batch["jacobian"].split(3, 1)
    normal, diffuse, rough, specular = batch["sigma0"].split(1, 1)
    slope = 2 * normal
    shared = [(diffuse * e, ALBEDO_CORRELATION[0]), (specular * b, ALBEDO_CORRELATION[1])]
    shared += [(rough * r, 1.0), (slope * p, 1.0), (slope * q, 1.0)]
    noise = (INPUT_NOISE[0] * photo) ** 2 + INPUT_NOISE[1] ** 2
    # JΣJᵀ + R, symmetric: each term is ρ·vvᵀ + (1 - ρ)·diag(v²).
    entries = {}
    for i in range(3):
        for j in range(i, 3):
            total = torch.stack(
                [(1.0 if i == j else rho) * v[:, i] * v[:, j] for v, rho in shared]
            ).sum(0)
            entries[i, j] = entries[j, i] = total + noise[:, i] if i == j else total
    white = torch.stack(_solve(entries, residual), 1)
    step = []
    for v, rho in shared:
        total = (v * white).sum(1, keepdim=True)
        step.append(total if rho == 1 else rho * total + (1 - rho) * v * white)
    return residual, torch.cat(step, 1), (residual * white).mean(1, keepdim=True)


def _solve(a: dict[tuple[int, int], Tensor], x: Tensor) -> list[Tensor]:
    """Solutions of symmetric 3 × 3 systems by cofactors; a's entries and x's channels (B, H, W)."""
    cofactor = {}
    for i in range(3):
        for j in range(3):
            rows = [k for k in range(3) if k != i]
            columns = [k for k in range(3) if k != j]
            minor = (
                a[rows[0], columns[0]] * a[rows[1], columns[1]]
                - a[rows[0], columns[1]] * a[rows[1], columns[0]]
            )
            cofactor[i, j] = minor * (-1) ** (i + j)
    det = sum(a[0, j] * cofactor[0, j] for j in range(3))
    return [sum(cofactor[j, i] * x[:, j] for j in range(3)) / det for i in range(3)]


def features(batch: Batch) -> Tensor:
    """What the correction sees, (B, INPUTS, H, W)."""
    photo, image, theta = batch["photo"], batch["image"], batch["theta"]
    _, step, surprise = gauss_newton(batch)
    e, b = batch["jacobian"][:, :3], batch["jacobian"][:, 3:6]
    level = image.clamp(min=ENCODE_FLOOR)
    parts = [
        encode(photo), encode(image), encode(e), encode(b),
        2 * theta[:, :7] - 0.5, theta[:, 7:],
        torch.log(batch["sigma0"].clamp(min=MIN_SIGMA)) / 2 + SIGMA_OFFSET,
        asinh(batch["jacobian"][:, 6:] / level.repeat(1, 3, 1, 1)),
        theta[:, :3] * e / level, theta[:, 3:6] * b / level,
        step.clamp(-3, 3),
        torch.log1p(surprise.clamp(0, MAX_SURPRISE)) / 2,
        batch["position"],
        2 * batch["lobes"] - 0.5,
    ]  # fmt: skip
    return channels_last_cat(parts)


class Correction(nn.Module):
    """See the module's docstring. Returns what `nets.model.Network` returns, but no normal0."""

    reach: Tensor
    calibration: Tensor

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        levels, width = len(config.encoder), config.width
        self.multiple = 1 << levels
        self.encoder = Encoder(INPUTS, width, config.encoder)
        self.middle = blocks(width << levels, config.middle)
        self.decoder = Decoder(sum(CORRECTION_OUTPUTS.values()), width, config.decoder)
        nn.init.zeros_(self.decoder.ending.weight)  # a fresh one changes next to nothing
        nn.init.zeros_(self.decoder.ending.bias)  # type: ignore[arg-type]
        reach = torch.tensor(REACH).repeat_interleave(torch.tensor([3, 3, 1, 2]))
        self.register_buffer("reach", reach[:, None, None], persistent=False)
        self.register_buffer("calibration", torch.ones(4))

    def forward(self, batch: Batch) -> Batch:
        height, width = batch["photo"].shape[-2:]
        x = torch.nan_to_num(features(batch), 0.0, 0.0, 0.0)
        # Convolutions pad with noughts, which the sample's border would show as a frame.
        top, left = (min(self.multiple, n - 1) for n in (height, width))
        x = F.pad(x, (left, left, top, top), mode="reflect")
        y, skips = self.encoder(pad_to(x, self.multiple))
        y = self.decoder(self.middle(y), skips)[..., top : top + height, left : left + width]
        out = split_channels(y, CORRECTION_OUTPUTS)
        # Some of the way to the lobes, by the network's judgement, and a step of its own.
        share = torch.sigmoid(out["towards_lobes"] - DOUBT)
        towards = share * (batch["lobes"] - batch["theta"][:, :7])
        theta = batch["theta"] + self.reach * out["step"]
        theta = torch.cat([theta[:, :7] + towards, theta[:, 7:]], 1)
        diffuse, specular, roughness = theta[:, :3], theta[:, 3:6], theta[:, 6:7]
        if not self.training:
            diffuse, specular = diffuse.clamp(0, 1), specular.clamp(0, 1)
            roughness = roughness.clamp(LEAST_MAP_ROUGHNESS, 1)
        sigma = batch["sigma0"].clamp(MIN_SIGMA, MAX_SIGMA)
        sigma = sigma * torch.exp(out["log_sigma"].clamp(*LOG_SIGMA_CHANGE))
        sigma = (sigma * self.calibration[:, None, None]).clamp(MIN_SIGMA, MAX_SIGMA)
        return {
            "normal": slope_normal(theta[:, 7:]), "diffuse": diffuse,
            "roughness": roughness, "specular": specular, "sigma": sigma,
        }  # fmt: skip
