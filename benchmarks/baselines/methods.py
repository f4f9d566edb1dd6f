"""The methods that are compared, all of one size on the same blocks, by the names of their rows."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from safetensors import safe_open
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


@cache
def trained(name: str) -> Any:
    """The method's network with the weights `WEIGHTS`/NAME.safetensors, in evaluation mode."""
    network = fresh(name)
    network.load_state_dict({k: v.float() for k, v in load_file(weights_of(name)).items()})
    return network.eval()


def weights_of(name: str) -> Path:
    """The file of a method's weights. Raises `InputError` where it is missing."""
    path = WEIGHTS / f"{name}.safetensors"
    if not path.is_file():
        raise InputError(f"{path} is missing; python -m benchmarks.baselines.train {name} makes it")
    return path


def training_notes(name: str) -> dict[str, Any]:
    """How a method was trained: what `benchmarks.baselines.train` wrote beside its weights."""
    with safe_open(weights_of(name), "pt") as f:
        return dict(json.loads(f.metadata()["notes"]))


def parameters(network: nn.Module) -> int:
    return sum(p.numel() for p in network.parameters())
