"""The methods that are compared, all of one size on the same blocks, by the names of their rows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors.torch import load_file
from torch import nn

from benchmarks.baselines.ablations import (
    ColouredClues,
    Denoised,
    MirrorBall,
    NoClues,
    PaperClues,
    PlaneClues,
    denoising_loss,
)
from benchmarks.baselines.deepbasis import DeepBasis
from benchmarks.baselines.matfusion import MatFusion, diffusion_loss
from invrender.types import InputError
from nets.model import Config, Network
from nets.store import channels_last
from nets.training.loss import total_loss
from nets.training.train import Loss

WEIGHTS = Path(__file__).with_name("weights")
SIZE = Config(8, (1, 1, 2), 2, (1, 1, 1))


class DenoisedNoClues(Denoised, NoClues):
    """LPL++: no clues, behind the denoiser."""


class DenoisedPaper(Denoised, PaperClues):
    """The paper's clues, behind its denoiser."""


METHODS: dict[str, tuple[Callable[[Config], nn.Module], Loss]] = {
    "ours": (Network, total_loss),
    "paper": (DenoisedPaper, denoising_loss),
    "lpl+": (NoClues, total_loss),
    "lpl++": (DenoisedNoClues, denoising_loss),
    "mirror-ball": (MirrorBall, total_loss),
    "coloured-clues": (ColouredClues, total_loss),
    "plane-clues": (PlaneClues, total_loss),
    "deepbasis+": (DeepBasis, total_loss),
    "matfusion": (MatFusion, diffusion_loss),
}


def fresh(name: str) -> Any:
    """An untrained network of the method. Raises `InputError` for an unknown name."""
    if name not in METHODS:
        raise InputError(f"there is no method {name!r}; there are {', '.join(METHODS)}")
    return channels_last(METHODS[name][0](SIZE))


def trained(name: str, folder: Path = WEIGHTS) -> Any:
    """The method's network with the weights ``folder``/NAME.safetensors, in evaluation mode."""
    network = fresh(name)
    path = folder / f"{name}.safetensors"
    if not path.is_file():
        raise InputError(f"{path} is missing; python -m benchmarks.baselines.train {name} makes it")
    network.load_state_dict({k: v.float() for k, v in load_file(path).items()})
    return network.eval()


def parameters(network: nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())

