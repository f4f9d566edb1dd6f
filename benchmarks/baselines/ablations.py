"""The shipped network without some of its parts, and the paper's: what each part brings.

Every class leaves out one thing more than the one it derives from:

    Network → WithoutLobes → WithoutSlopes → PaperClues → ColouredClues, PlaneClues, MirrorBall,
    NoClues

`Denoised` is the shipped network with the paper's denoiser before it, `Paper` the paper's own
sizes and clues with it. They train by ``nets.training.train.train(args, network, loss)``.
"""

from __future__ import annotations

from torch import Tensor, nn

from nets.batch import Batch
from nets.blocks import Decoder, Encoder, blocks, channels_last_cat
from nets.clues import BASIS
from nets.model import Config, Network, View, encode, grey, normalise
from nets.splitsum import sample
from nets.training.loss import total_loss

PAPER = Config(32, (2, 2, 4, 8), 12, (2, 2, 2, 2))
DENOISED_WEIGHT = 5.0  # of the denoised photo's mean error in the loss, chosen by hand


def _without(channels: dict[str, int], *names: str) -> dict[str, int]:
    return {k: n for k, n in channels.items() if k not in names}


class WithoutLobes(Network):
    """Nothing of what all pixels of a material, fitted together, say of it."""

    IMAGE = _without(Network.IMAGE, "lobes", "evidence")
    OUTPUTS = {k: v for k, v in Network.OUTPUTS.items() if "weights" not in k}  # noqa: RUF012

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        del self.costs

    def lobe_inputs(self, view: View) -> list[Tensor]:
        return []

    def fuse(self, bottlenecks: list[Tensor], view: View) -> Tensor:
        fused: Tensor = self.fusion(channels_last_cat(bottlenecks))
        return fused

    def material(self, out: Batch, batch: Batch) -> Batch:
        return {k: out[k] for k in ("diffuse", "roughness", "specular")}


class WithoutSlopes(WithoutLobes):
    """Nor of how radiance depends on the slopes."""

    IMAGE = _without(WithoutLobes.IMAGE, "slopes")

    def slope_inputs(self, view: View) -> list[Tensor]:
        return []


class PaperClues(WithoutSlopes):
    """Nor clues of the screen's light, nor the ratio of the photo to a white plane."""

    IMAGE = _without(WithoutSlopes.IMAGE, "ratio", "active")
    CLUES = _without(WithoutSlopes.CLUES, "screen")

    def screen_inputs(self, view: View) -> list[Tensor]:
        return []

    def clue_inputs(self, normal: Tensor, view: View) -> list[Tensor]:
        return [encode(view.plane), encode(grey(self.normal_clues(normal, view, None)[0]))]


class ColouredClues(PaperClues):
    """Normal clues in colour."""

    CLUES = {"plane": 12, "coloured": 3 * len(BASIS)}  # noqa: RUF012

    def clue_inputs(self, normal: Tensor, view: View) -> list[Tensor]:
        return [encode(view.plane), encode(self.normal_clues(normal, view, None)[0])]


class PlaneClues(PaperClues):
    """No normal clues."""

    CLUES = _without(PaperClues.CLUES, "grey")

    def clue_inputs(self, normal: Tensor, view: View) -> list[Tensor]:
        return [encode(view.plane)]


class MirrorBall(PaperClues):
    """The ball's image instead of clues."""

    CLUES = {"ball": 3}  # noqa: RUF012

    def normalise(self, batch: Batch) -> Batch:
        return normalise(batch, ("active_clues",))

    def clue_inputs(self, normal: Tensor, view: View) -> list[Tensor]:
        return [encode(sample(view.batch["ball"], view.position))]


class NoClues(PaperClues):
    """The photo and the pattern alone, as the paper's LPL+."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        del self.clue_encoder, self.skips
        deep = config.width << len(config.encoder)
        self.fusion[0] = nn.Conv2d(deep, deep, 3, padding=1)

    def normalise(self, batch: Batch) -> Batch:
        return normalise(batch, ("active_clues",))

    def with_clues(
        self, x: Tensor, skips: list[Tensor], normal0: Tensor, view: View
    ) -> tuple[Tensor, list[Tensor]]:
        return self.fuse([x], view), skips


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
        x, skips = self.encoder(channels_last_cat([photo, captured, ideal]))
        denoised: Tensor = photo + self.decoder(self.middle(x), skips)
        return denoised


class Denoised(Network):
    """The network behind a denoiser. Its output has denoised (B, 3, H, W) too, encoded."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self.denoiser = Denoiser(config)

    def photo_inputs(self, view: View) -> list[Tensor]:
        photo, mirrored, position = super().photo_inputs(view)
        at = (view.on_screen * 2 - 1) / 2  # screen images have a margin
        ideal = sample(view.batch["screen"][:, :3], at)
        self.denoised = self.denoiser(photo, mirrored, encode(ideal))
        return [self.denoised, mirrored, position]

    def forward(self, batch: Batch) -> Batch:
        height, width = batch["photo"].shape[-2:]
        return {**super().forward(batch), "denoised": self.denoised[..., :height, :width]}


class Paper(Denoised, PaperClues):
    """The paper's network: clues as wide as the image until after the fusion, no clue skips."""

    def __init__(self, config: Config = PAPER) -> None:
        super().__init__(config)
        del self.skips
        deep = config.width << len(config.encoder)
        self.fusion = nn.Sequential(
            blocks(2 * deep, config.middle), nn.Conv2d(2 * deep, deep, 3, padding=1)
        )

    def with_clues(
        self, x: Tensor, skips: list[Tensor], normal0: Tensor, view: View
    ) -> tuple[Tensor, list[Tensor]]:
        clues, _ = self.clue_encoder(channels_last_cat(self.clue_inputs(normal0, view)))
        return self.fuse([x, clues], view), skips


def denoising_loss(out: Batch, batch: Batch) -> tuple[Tensor, Batch]:
    """`total_loss`, and the error of the denoised photo."""
    total, parts = total_loss(out, batch)
    ideal = encode(normalise({**batch, "target": batch["ideal"].float()})["target"])
    error = DENOISED_WEIGHT * (out["denoised"] - ideal).abs().mean()
    total = total + error
    return total, {**parts, "denoised": error.detach(), "loss": total.detach()}


# By the names of the benchmark's rows: class and loss.
VARIANTS = {
    "no clues (LPL+)": (NoClues, total_loss),
    "mirror ball": (MirrorBall, total_loss),
    "plane clues": (PlaneClues, total_loss),
    "coloured normal clues": (ColouredClues, total_loss),
    "the paper's clues": (PaperClues, total_loss),
    "+ clues of the screen": (WithoutSlopes, total_loss),
    "+ slopes": (WithoutLobes, total_loss),
    "+ lobes (ours)": (Network, total_loss),
    "ours with denoiser": (Denoised, denoising_loss),
}
