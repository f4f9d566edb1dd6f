"""The two-branch network with lighting clues, and its denoiser.

Image encoder → normal decoder → initial normals → normal clues (split-sum, inside the forward
pass) → clue encoder; both bottlenecks → fusion → material decoder. A batch is a dict of tensors:

    photo (B, 3, H, W) radiance; position (B, 2, H, W) in [-1, 1]², x right, y up; and the light as
    `nets.clues.light_inputs` gives it, each with a batch axis: env_clues, active_clues,
    slope_clues, sky, screen, ball, pattern, rig; and with ``lobes`` lobes (B, 7, H, W), albedos and
    roughness as `invrender.refine.lobes` finds them, and what the photo says of dielectric and of
    metal, evidence (B, 16, H, W) and costs (B, 40), see `nets.batch.pack_evidence`.

All of it may be in any unit of radiance: it is divided by that of a white plane first.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from invrender.types import InputError
from nets.batch import (
    COST_COUNT,
    EVIDENCE,
    EVIDENCE_CHANNELS,
    Batch,
    split_channels,
    unpack_evidence,
)
from nets.blocks import Decoder, Encoder, Pointwise, blocks, pad_to
from nets.slopes import SLOPE_FEATURES, slope_features
from nets.splitsum import brdf_table, hit_screen, normal_clues, reflect, sample, view_directions

ALBEDO = 0.6
BASIS = ((0.2, 0.0), (0.2, 0.6), (0.6, 0.0), (0.6, 0.6))
CLUES = ("none", "mirrorball", "plane", "colored", "full")
MAPS = ("normal", "diffuse", "roughness", "specular")
LIGHTS = ("env_clues", "active_clues", "slope_clues", "sky", "screen", "ball", "pattern")
MIN_SIGMA, MAX_SIGMA = 0.002, 1.0
DIELECTRIC_F0 = 0.04  # of common plastics, stone and paint: an index of refraction of 1.5
# What the material decoder puts out, and how many channels each.
OUTPUTS = {"slope": 2, "diffuse": 3, "roughness": 1, "specular": 3, "log_sigma": 4}
# Logits of the dielectric's and the metal's weights beside the network's own map.
WEIGHTS = {"diffuse_weights": 2, "roughness_weights": 2, "specular_weights": 2}


@dataclass(frozen=True)
class Config:
    """What is built. ``clues``: none (LPL+), mirrorball (the ball's image instead of clues), plane,
    full (and normal clues in grey) or colored (those in colour).

    active: clues of the screen's light too, and the ratio of the photo to a white plane.
    slopes: how radiance depends on the slopes, and what that says of them (`nets.slopes`).
    lobes: what all pixels of a material, fitted together, say of it (`invrender.refine.lobes`): as
    inputs, and each of the network's material maps is a mean of its own and of what the photo says
    of a dielectric and of bare metal, by weights that the network finds. clue_skips: the material
    decoder also gets the clue encoder's skips. narrow_fusion: halve the channels before the fusion
    blocks, not after. correction: not this network but the correction of its maps
    (`nets.correction`), which heeds sizes alone.
    """

    width: int = 16
    encoder: tuple[int, ...] = (1, 1, 2, 4)
    middle: int = 4
    decoder: tuple[int, ...] = (1, 1, 1, 1)
    clues: str = "full"
    active: bool = True
    slopes: bool = True
    lobes: bool = True
    clue_skips: bool = True
    narrow_fusion: bool = True
    denoiser: bool = False
    correction: bool = False

    def __post_init__(self) -> None:
        if self.clues not in CLUES:
            raise InputError(f"clues must be one of {', '.join(CLUES)}, got {self.clues!r}")


def encode(x: Tensor) -> Tensor:
    """Radiance in units of a white plane to about [-1, 1], log-like from 0.02 upwards."""
    return torch.log2(x.clamp(0, 1e3) + 0.02) * 0.25 + 0.4


class Denoiser(nn.Module):
    """(photo, pattern as captured, pattern as it should be) → the photo under the latter.

    A plain NAFNet on encoded images that adds to its input.
    """

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.encoder = Encoder(9, config.width, config.encoder)
        self.middle = blocks(config.width << len(config.encoder), config.middle)
        self.decoder = Decoder(3, config.width, config.decoder)

    def forward(self, photo: Tensor, captured: Tensor, ideal: Tensor) -> Tensor:
        """Encoded images (B, 3, H, W), H and W multiples of 2^levels."""
        x, skips = self.encoder(torch.cat([photo, captured, ideal], 1))
        return photo + self.decoder(self.middle(x), skips)


class Network(nn.Module):
    """See the module's docstring. Returns normal0 and normal (B, 3, H, W) unit; diffuse, specular
    (B, 3, H, W), roughness (B, 1, H, W), unclamped while training; sigma (B, 4, H, W), the expected
    error of `MAPS`, normals encoded to [0, 1]; with a denoiser also denoised, encoded.
    """

    table: Tensor
    calibration: Tensor

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        levels, width = len(config.encoder), config.width
        self.multiple = 1 << levels
        deep = width << levels
        image, clue = _channels(config)
        self.denoiser = Denoiser(config) if config.denoiser else None
        self.encoder = Encoder(image, width, config.encoder)
        self.normal_decoder = Decoder(2, width, config.decoder)
        self.clue_encoder = Encoder(clue, width, config.encoder) if clue else None
        both = 2 * deep if clue else deep
        inside = deep if config.narrow_fusion else both
        narrow = nn.Conv2d(both, deep, 3, padding=1)
        steps = [blocks(inside, config.middle), narrow]
        self.fusion = nn.Sequential(*(reversed(steps) if config.narrow_fusion else steps))
        self.skips = (
            nn.ModuleList(Pointwise(width << k, width << k) for k in range(levels))
            if config.clue_skips and clue
            else None
        )
        self.costs = nn.Sequential(nn.Linear(COST_COUNT, 64), nn.GELU(), nn.Linear(64, deep)) if (
            config.lobes
        ) else None  # fmt: skip
        self.outputs = OUTPUTS | (WEIGHTS if config.lobes else {})
        self.material_decoder = Decoder(sum(self.outputs.values()), width, config.decoder)
        # A fresh network predicts a plane of middling materials, in doubt.
        with torch.no_grad():
            self.material_decoder.ending.weight *= 0.1
            self.normal_decoder.ending.weight *= 0.1
            start = [0, 0, *[0.3] * 3, 0.5, *[0.1] * 3, -3, -1.5, -1.5, -2]
            start += [-1] * (sum(WEIGHTS.values()) if config.lobes else 0)
            for decoder, values in ((self.normal_decoder, [0, 0]), (self.material_decoder, start)):
                assert decoder.ending.bias is not None
                decoder.ending.bias.copy_(torch.tensor(values))
        self.register_buffer("table", brdf_table(), persistent=False)
        self.register_buffer("calibration", torch.ones(4))

    def forward(self, batch: Batch) -> Batch:
        height, width = batch["photo"].shape[-2:]
        batch = normalise(batch, self.config)
        position = pad_to(batch["position"], self.multiple)
        photo = pad_to(batch["photo"], self.multiple)
        rig, pattern = batch["rig"], batch["pattern"]

        # What each pixel would show as a mirror: the pattern as captured.
        view = view_directions(position, rig)
        up = torch.zeros_like(view)
        up[:, 2] = 1
        st = hit_screen(position, reflect(view, up), rig)
        mirrored = sample(pattern, st * 2 - 1, "zeros")
        out: Batch = {}
        seen = encode(photo)
        if self.denoiser is not None:
            ideal = sample(batch["screen"][:, :3], (st * 2 - 1) / 2)
            seen = out["denoised"] = self.denoiser(seen, encode(mirrored), encode(ideal))
        active = sample(batch["active_clues"], position)
        plane = sample(batch["env_clues"], position)
        inputs = [seen, encode(mirrored), position]
        if self.config.active:
            white = active[:, 9:12]
            if _knows_environment(self.config):
                white = white + plane[:, 9:12]
            ratio = photo / (white / ALBEDO + 0.02)
            inputs += [ratio.clamp(max=4), encode(torch.cat([active[:, :3], active[:, 6:]], 1))]
        if self.config.slopes:
            inputs.append(
                slope_features(photo, active + plane, sample(batch["slope_clues"], position))
            )
        if self.config.lobes:
            inputs.append(2 * pad_to(batch["lobes"], self.multiple) - 0.5)
            inputs.append(_scaled(pad_to(batch["evidence"], self.multiple)))

        x, skips = self.encoder(_last(torch.cat(inputs, 1)))
        slope0 = self.normal_decoder(x, skips)
        normal0 = slope_normal(slope0)
        if self.clue_encoder is not None:
            clues = self._clues(batch, normal0, position, plane)
            c, clue_skips = self.clue_encoder(_last(clues))
            x = torch.cat([x, c], 1)
            if self.skips is not None:
                skips = [
                    s + conv(k) for s, k, conv in zip(skips, clue_skips, self.skips, strict=True)
                ]
        x = self.fusion(x)
        if self.costs is not None:
            x = x + self.costs(batch["costs"])[..., None, None]
        y = self.material_decoder(x, skips)
        normal0 = normal0[..., :height, :width]
        y = split_channels(y[..., :height, :width], self.outputs)
        slope = slope0[..., :height, :width] + y["slope"]
        diffuse, roughness, specular = y["diffuse"], y["roughness"], y["specular"]
        if self.config.lobes:
            evidence = unpack_evidence(batch)
            black = torch.zeros_like(diffuse)
            diffuse = _mean(diffuse, evidence.dielectric_diffuse, black, y["diffuse_weights"])
            roughness = _mean(
                roughness,
                evidence.dielectric_roughness,
                evidence.metal_roughness,
                y["roughness_weights"],
            )
            specular = _mean(
                specular, black + DIELECTRIC_F0, evidence.metal_material_specular,
                y["specular_weights"],
            )  # fmt: skip
        if not self.training:
            diffuse, specular = diffuse.clamp(0, 1), specular.clamp(0, 1)
            roughness = roughness.clamp(0.02, 1)
        sigma = torch.exp(y["log_sigma"].clamp(-6.2, 0)) * self.calibration[:, None, None]
        out |= {"normal0": normal0, "normal": slope_normal(slope), "diffuse": diffuse}
        out |= {"roughness": roughness, "specular": specular}
        out["sigma"] = sigma.clamp(MIN_SIGMA, MAX_SIGMA)
        if "denoised" in out:
            out["denoised"] = out["denoised"][..., :height, :width]
        return out

    def _clues(self, batch: Batch, normal: Tensor, position: Tensor, plane: Tensor) -> Tensor:
        """Input of the clue encoder."""
        if self.config.clues == "mirrorball":
            return encode(sample(batch["ball"], position))
        clues = [encode(plane)]
        if self.config.clues in ("full", "colored"):
            screen = batch["screen"] if self.config.active else None
            images, seen = normal_clues(
                normal, position, batch["rig"], batch["sky"], screen, self.table, BASIS, ALBEDO
            )
            if self.config.clues == "full":
                b, _, h, w = images.shape
                images = images.reshape(b, len(BASIS), 3, h, w).mean(2)
            clues += [encode(images)] + ([] if seen is None else [encode(seen)])
        return torch.cat(clues, 1)


def _scaled(evidence: Tensor) -> Tensor:
    """Evidence as inputs: albedos and roughness to [-0.5, 1.5], odds halved."""
    parts = split_channels(evidence, EVIDENCE)
    return torch.cat([x / 2 if "odds" in k else 2 * x - 0.5 for k, x in parts.items()], 1)


def _mean(own: Tensor, dielectric: Tensor, metal: Tensor, logits: Tensor) -> Tensor:
    """The mean of three by the softmax of (0, logits (B, 2, H, W))."""
    a, b, c = F.pad(logits, (0, 0, 0, 0, 1, 0)).softmax(1).split(1, 1)
    return a * own + b * dielectric + c * metal


def _knows_environment(config: Config) -> bool:
    return config.clues not in ("none", "mirrorball")


def _channels(config: Config) -> tuple[int, int]:
    """Input channels of the image encoder and of the clue encoder."""
    image = 8 + (12 if config.active else 0) + (SLOPE_FEATURES if config.slopes else 0)
    image += 7 + EVIDENCE_CHANNELS if config.lobes else 0
    lit = 6 if config.active else 0
    clue = {
        "none": 0, "mirrorball": 3, "plane": 12, "full": 16 + lit, "colored": 24 + lit,
    }[config.clues]  # fmt: skip
    return image, clue


def _last(x: Tensor) -> Tensor:
    return x.contiguous(memory_format=torch.channels_last)


def slope_normal(slope: Tensor) -> Tensor:
    """Unit normals (B, 3, H, W) along (p, q, 1)."""
    return F.normalize(torch.cat([slope, torch.ones_like(slope[:, :1])], 1), dim=1)


def normalise(batch: Batch, config: Config | None = None) -> Batch:
    """The batch in units of a white plane's mean radiance; what is not finite becomes black."""
    lights = ["active_clues"]
    if config is None or _knows_environment(config):
        lights.append("env_clues")
    level = torch.stack([batch[k][:, 9:12].mean((1, 2, 3)) for k in lights]).sum(0) / ALBEDO
    scale = 1 / torch.nan_to_num(level, 1.0).clamp(min=1e-20)
    out = dict(batch)
    for key in ("photo", "target", *LIGHTS):
        if key in batch:
            x = torch.nan_to_num(batch[key] * scale[:, None, None, None], 0.0, 1e3, 0.0)
            out[key] = x.clamp(-1e4 if key == "slope_clues" else 0, 1e4)
    return out
