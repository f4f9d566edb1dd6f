"""The two-branch network with lighting clues.

Image encoder → normal decoder → initial normals → normal clues (split-sum, inside the forward
pass) → clue encoder; both bottlenecks → fusion → material decoder, whose material maps are means
of its own and of what the photo says of a dielectric and of bare metal. A batch is a dict of
tensors:

    photo (B, 3, H, W) radiance; position (B, 2, H, W) in [-1, 1]², x right, y up; the light as
    `nets.clues.light_inputs` gives it, each with a batch axis: env_clues, active_clues,
    slope_clues, sky, screen, ball, pattern, rig; lobes (B, 7, H, W), albedos and roughness as
    `invrender.refine.lobes` finds them, and what the photo says of dielectric and of metal,
    evidence (B, 16, H, W) and costs (B, 40), see `nets.batch.pack_evidence`.

All of it may be in any unit of radiance: it is divided by that of a white plane first. The steps
of the forward pass are methods, which ablations replace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nets.batch import (
    COST_COUNT,
    EVIDENCE,
    EVIDENCE_CHANNELS,
    Batch,
    split_channels,
    unpack_evidence,
)
from nets.blocks import Decoder, Encoder, Pointwise, blocks, channels_last_cat, pad_to
from nets.clues import ALBEDO, BASIS, WHITE
from nets.slopes import SLOPE_FEATURES, slope_features
from nets.splitsum import brdf_table, hit_screen, normal_clues, reflect, sample, view_directions

MAPS = ("normal", "diffuse", "roughness", "specular")
LIGHTS = ("env_clues", "active_clues", "slope_clues", "sky", "screen", "ball", "pattern")
WHITE_CLUE = slice(3 * WHITE, 3 * WHITE + 3)  # the white plane's channels of plane clues

DIELECTRIC_F0 = 0.04  # of common plastics, stone and paint: an index of refraction of 1.5
LEAST_MAP_ROUGHNESS = 0.02  # of the maps that leave the network; smoother looks the same in a photo
# Bounds of the expected errors, in the maps' unit: half of an 8-bit step, and all of a map's range.
MIN_SIGMA, MAX_SIGMA = 0.002, 1.0
LEAST_LOG_SIGMA = -6.2  # log of `MIN_SIGMA`
MAX_RADIANCE = 1e4  # of lights, in units of a white plane: what float16 shards can hold
MAX_PHOTO = 1e3  # likewise of what `encode` resolves
ENCODE_FLOOR = 0.02  # radiance in units of a white plane from which on `encode` is logarithmic
ENCODE_SCALE, ENCODE_OFFSET = 0.25, 0.4  # of its logarithm, which bring it to about [-1, 1]
LEAST_LEVEL = 1e-20  # of white, in any unit: below it nothing is seen
MAX_RATIO = 4.0  # of photo to white plane; a highlight beyond it is as bright as any
HIDDEN_COSTS = 64  # units between the fits' costs and the bottleneck

# What the decoders put out: how many channels, and the bias of a fresh network, which predicts a
# plane of middling materials, in doubt. The weights are logits of the dielectric's and the metal's
# shares of a map; that of the network's own is 0.
NORMAL_OUTPUTS = {"slope": [0.0, 0.0]}
OUTPUTS = {
    "slope": [0.0, 0.0],
    "diffuse": [0.3, 0.3, 0.3],
    "roughness": [0.5],
    "specular": [0.1, 0.1, 0.1],
    "log_sigma": [-3.0, -1.5, -1.5, -2.0],
    "diffuse_weights": [-1.0, -1.0],
    "roughness_weights": [-1.0, -1.0],
    "specular_weights": [-1.0, -1.0],
}
FRESH_SCALE = 0.1  # of a fresh decoder's last weights, as torch draws them


@dataclass(frozen=True)
class Config:
    """Sizes: channels at full resolution; blocks of each level of the encoders, of the fusion, and
    of each level of the decoders."""

    width: int = 16
    encoder: tuple[int, ...] = (1, 1, 2, 4)
    middle: int = 4
    decoder: tuple[int, ...] = (1, 1, 1, 1)


@dataclass(frozen=True)
class View:
    """A normalised batch at its pixels, padded to a multiple of the network's coarsest cell: photo
    and position, directions to the camera, plane clues of the room, those of the screen and the
    slope clues, and the pattern as each pixel would mirror it were it flat."""

    batch: Batch
    photo: Tensor
    position: Tensor
    to_camera: Tensor
    plane: Tensor
    active: Tensor
    slopes: Tensor
    on_screen: Tensor

    @property
    def mirrored(self) -> Tensor:
        return sample(self.batch["pattern"], self.on_screen * 2 - 1, "zeros")


def encode(x: Tensor) -> Tensor:
    """Radiance in units of a white plane to about [-1, 1], log-like from `ENCODE_FLOOR` upwards."""
    return torch.log2(x.clamp(0, MAX_PHOTO) + ENCODE_FLOOR) * ENCODE_SCALE + ENCODE_OFFSET


class Network(nn.Module):
    """See the module's docstring. Returns normal0 and normal (B, 3, H, W) unit; diffuse, specular
    (B, 3, H, W), roughness (B, 1, H, W), unclamped while training; sigma (B, 4, H, W), the expected
    error of `MAPS`, normals encoded to [0, 1].
    """

    # Inputs of the encoders and how many channels each.
    IMAGE: ClassVar = {
        "photo": 3, "mirrored": 3, "position": 2, "ratio": 3, "active": 9,
        "slopes": SLOPE_FEATURES, "lobes": 7, "evidence": EVIDENCE_CHANNELS,
    }  # fmt: skip
    CLUES: ClassVar = {"plane": 12, "grey": len(BASIS), "screen": 6}
    OUTPUTS: ClassVar = OUTPUTS

    table: Tensor
    calibration: Tensor

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        levels, width = len(config.encoder), config.width
        self.multiple = 1 << levels
        deep = width << levels
        self.encoder = Encoder(sum(self.IMAGE.values()), width, config.encoder)
        self.normal_decoder = Decoder(_count(NORMAL_OUTPUTS), width, config.decoder)
        self.clue_encoder = Encoder(sum(self.CLUES.values()), width, config.encoder)
        self.fusion = nn.Sequential(
            nn.Conv2d(2 * deep, deep, 3, padding=1), blocks(deep, config.middle)
        )
        self.skips = nn.ModuleList(Pointwise(width << k, width << k) for k in range(levels))
        self.costs = nn.Sequential(
            nn.Linear(COST_COUNT, HIDDEN_COSTS), nn.GELU(), nn.Linear(HIDDEN_COSTS, deep)
        )
        self.material_decoder = Decoder(_count(self.OUTPUTS), width, config.decoder)
        _begin(self.normal_decoder, NORMAL_OUTPUTS)
        _begin(self.material_decoder, self.OUTPUTS)
        self.register_buffer("table", brdf_table(), persistent=False)
        self.register_buffer("calibration", torch.ones(len(MAPS)))

    def forward(self, batch: Batch) -> Batch:
        height, width = batch["photo"].shape[-2:]
        view = self.view(batch)
        x, skips = self.encoder(channels_last_cat(self.image_inputs(view)))
        slope0 = self.normal_decoder(x, skips)
        normal0 = slope_normal(slope0)
        x, skips = self.with_clues(x, skips, normal0, view)
        y = self.material_decoder(x, skips)[..., :height, :width]
        outputs = {k: len(v) for k, v in self.OUTPUTS.items()}
        out = split_channels(y, outputs)
        maps = self.material(out, batch)
        if not self.training:
            maps = {k: v.clamp(_least(k), 1) for k, v in maps.items()}
        sigma = torch.exp(out["log_sigma"].clamp(LEAST_LOG_SIGMA, 0))
        sigma = sigma * self.calibration[:, None, None]
        return {
            "normal0": normal0[..., :height, :width],
            "normal": slope_normal(slope0[..., :height, :width] + out["slope"]),
            **maps,
            "sigma": sigma.clamp(MIN_SIGMA, MAX_SIGMA),
        }

    def view(self, batch: Batch) -> View:
        """What a batch shows at its pixels."""
        batch = self.normalise(batch)
        position, rig = pad_to(batch["position"], self.multiple), batch["rig"]
        photo = pad_to(batch["photo"], self.multiple)
        to_camera = view_directions(position, rig)
        up = torch.zeros_like(to_camera)
        up[:, 2] = 1
        on_screen = hit_screen(position, reflect(to_camera, up), rig)
        clues = ("env_clues", "active_clues", "slope_clues")
        parts = sample(torch.cat([batch[k] for k in clues], 1), position)
        plane, active, slopes = parts.split([batch[k].shape[1] for k in clues], 1)
        return View(batch, photo, position, to_camera, plane, active, slopes, on_screen)

    def normalise(self, batch: Batch) -> Batch:
        """The batch in units of a white plane's mean radiance."""
        return normalise(batch)

    def image_inputs(self, view: View) -> list[Tensor]:
        """Inputs of the image encoder, in the order of `IMAGE`."""
        return [
            *self.photo_inputs(view),
            *self.screen_inputs(view),
            *self.slope_inputs(view),
            *self.lobe_inputs(view),
        ]

    def photo_inputs(self, view: View) -> list[Tensor]:
        return [encode(view.photo), encode(view.mirrored), view.position]

    def screen_inputs(self, view: View) -> list[Tensor]:
        """The photo over what a white plane shows, and what others show under the screen alone."""
        white = view.active[:, WHITE_CLUE] + view.plane[:, WHITE_CLUE]
        ratio = view.photo / (white / ALBEDO + ENCODE_FLOOR)
        return [
            ratio.clamp(max=MAX_RATIO),
            encode(torch.cat([view.active[:, :3], view.active[:, 6:]], 1)),
        ]

    def slope_inputs(self, view: View) -> list[Tensor]:
        return slope_features(view.photo, view.active + view.plane, view.slopes)

    def lobe_inputs(self, view: View) -> list[Tensor]:
        """Lobes and evidence: albedos and roughness to [-0.5, 1.5], odds halved."""
        lobes = pad_to(view.batch["lobes"], self.multiple)
        parts = split_channels(pad_to(view.batch["evidence"], self.multiple), EVIDENCE)
        scaled = [x / 2 if k.endswith("odds") else 2 * x - 0.5 for k, x in parts.items()]
        return [2 * lobes - 0.5, *scaled]

    def with_clues(
        self, x: Tensor, skips: list[Tensor], normal0: Tensor, view: View
    ) -> tuple[Tensor, list[Tensor]]:
        """The image encoder's output and skips, joined with those of the clues."""
        clues, clue_skips = self.clue_encoder(channels_last_cat(self.clue_inputs(normal0, view)))
        pairs = zip(skips, clue_skips, self.skips, strict=True)
        skips = [s + conv(k) for s, k, conv in pairs]
        return self.fuse([x, clues], view), skips

    def fuse(self, bottlenecks: list[Tensor], view: View) -> Tensor:
        costs: Tensor = self.costs(view.batch["costs"])
        x: Tensor = self.fusion(channels_last_cat(bottlenecks))
        return x + costs[..., None, None]

    def clue_inputs(self, normal: Tensor, view: View) -> list[Tensor]:
        """Inputs of the clue encoder: plane clues, and normal clues, those of the room in grey."""
        room, screen = self.normal_clues(normal, view, view.batch["screen"])
        assert screen is not None
        return [encode(view.plane), encode(grey(room)), encode(screen)]

    def normal_clues(
        self, normal: Tensor, view: View, screen: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """`nets.splitsum.normal_clues` for the view."""
        batch = view.batch
        return normal_clues(
            normal, view.position, view.to_camera, batch["rig"], batch["sky"], screen, self.table,
            BASIS, ALBEDO,
        )  # fmt: skip

    def material(self, out: Batch, batch: Batch) -> Batch:
        """The material maps: means of the network's own and of the photo's two readings."""
        evidence = unpack_evidence(batch)
        black = torch.zeros_like(out["diffuse"])
        cases = {
            "diffuse": (evidence.dielectric_diffuse, black),
            "roughness": (evidence.dielectric_roughness, evidence.metal_roughness),
            "specular": (black + DIELECTRIC_F0, evidence.metal_material_specular),
        }
        return {k: _mean(out[k], *pair, out[f"{k}_weights"]) for k, pair in cases.items()}


def grey(images: Tensor) -> Tensor:
    """Means over the colours of RGB images side by side, (B, 3·n, H, W) to (B, n, H, W)."""
    return images.unflatten(1, (-1, 3)).mean(2)


def _least(name: str) -> float:
    return LEAST_MAP_ROUGHNESS if name == "roughness" else 0.0


def _mean(own: Tensor, dielectric: Tensor, metal: Tensor, logits: Tensor) -> Tensor:
    """The mean of three by the softmax of (0, logits (B, 2, H, W))."""
    a, b, c = F.pad(logits, (0, 0, 0, 0, 1, 0)).softmax(1).split(1, 1)
    return a * own + b * dielectric + c * metal


def _count(outputs: dict[str, list[float]]) -> int:
    return sum(len(v) for v in outputs.values())


def _begin(decoder: Decoder, outputs: dict[str, list[float]]) -> None:
    """Let a fresh decoder put out its bias and little else."""
    bias = torch.tensor([x for values in outputs.values() for x in values])
    with torch.no_grad():
        decoder.ending.weight *= FRESH_SCALE
        assert decoder.ending.bias is not None
        decoder.ending.bias.copy_(bias)


def slope_normal(slope: Tensor) -> Tensor:
    """Unit normals (B, 3, H, W) along (p, q, 1) of slopes (B, 2, H, W)."""
    z = torch.rsqrt((slope * slope).sum(1, keepdim=True) + 1)
    return torch.cat([slope * z, z], 1)


def normalise(batch: Batch, lights: Sequence[str] = ("active_clues", "env_clues")) -> Batch:
    """The batch in units of the mean radiance of a white plane under ``lights``; what is not finite
    becomes black."""
    white = [batch[k][:, WHITE_CLUE].mean((1, 2, 3)) for k in lights]
    level = torch.stack(white).sum(0) / ALBEDO
    scale = 1 / torch.nan_to_num(level, 1.0).clamp(min=LEAST_LEVEL)
    out = dict(batch)
    for key in ("photo", "target", *LIGHTS):
        if key in batch:
            x = torch.nan_to_num(batch[key] * scale[:, None, None, None], 0.0, MAX_PHOTO, 0.0)
            out[key] = x.clamp(-MAX_RADIANCE if key == "slope_clues" else 0, MAX_RADIANCE)
    return out
