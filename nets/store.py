"""Networks by name, and their weights on disk."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import nn

from invrender.types import InputError
from nets.correction import Correction
from nets.model import Config, Network

AnyNetwork = Network | Correction

NETWORKS: dict[str, type[Network] | type[Correction]] = {
    "network": Network,
    "correction": Correction,
}
CONFIGS: dict[str, tuple[str, Config]] = {
    "small": ("network", Config()),
    "tiny": ("network", Config(8, (1, 1), 1, (1, 1))),  # for tests
    "correction": ("correction", Config(16, (1, 1, 2), 2, (1, 1, 1))),
}

# In headers of version 0.1: what was built in besides `Config`'s sizes. Other values were ablations
# (now `benchmarks.baselines.ablations`). "correction" was the kind.
SWITCHES_0_1 = {
    "clues": "full", "active": True, "slopes": True, "lobes": True, "clue_skips": True,
    "narrow_fusion": True, "denoiser": False,
}  # fmt: skip


def build(name: str) -> AnyNetwork:
    """A fresh network from `CONFIGS`, in the channels-last layout."""
    if name not in CONFIGS:
        raise InputError(f"no preset {name!r}; there are {', '.join(CONFIGS)}")
    kind, config = CONFIGS[name]
    return channels_last(NETWORKS[kind](config))


def channels_last(network: Any) -> Any:
    """The same network with its weights in the channels-last layout, as all activations are."""
    return network.to(memory_format=torch.channels_last)


def save_weights(path: Path, network: nn.Module, notes: dict[str, Any], half: bool = False) -> None:
    """Write safetensors with the network's kind, `Config` and ``notes`` in its header."""
    assert isinstance(network.config, Config)
    kinds = [k for k, kind in NETWORKS.items() if type(network) is kind]
    metadata = {
        "kind": kinds[0] if kinds else type(network).__name__,
        "config": json.dumps(asdict(network.config)),
        "notes": json.dumps(notes),
    }
    tensors = {k: (v.half() if half else v).contiguous() for k, v in network.state_dict().items()}
    part = path.with_suffix(".part")
    save_file(tensors, part, metadata=metadata)
    part.replace(path)


def load_weights(path: Path) -> tuple[AnyNetwork, dict[str, Any]]:
    """A network in evaluation mode from `save_weights`, and its notes. Raises `InputError`."""
    try:
        with safe_open(path, "pt") as f:
            metadata = f.metadata() or {}
        kind, config = _described(metadata)
        if kind not in NETWORKS:
            raise InputError(f"{path} holds an ablation's weights ({kind}), for benchmarks alone")
        network = channels_last(NETWORKS[kind](config))
        network.load_state_dict({k: v.float() for k, v in load_file(path).items()})
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as e:
        if isinstance(e, InputError):
            raise
        raise InputError(f"{path} holds no weights of this program: {e}") from None
    except Exception as e:  # safetensors has its own error class
        if type(e).__name__ != "SafetensorError":
            raise
        raise InputError(f"{path} is not a safetensors file: {e}") from None
    return network.eval(), json.loads(metadata.get("notes", "{}"))


def _described(metadata: dict[str, str]) -> tuple[str, Config]:
    """Kind and sizes of the network that a header describes."""
    values = json.loads(metadata["config"])
    sizes: dict[str, Any] = {f.name: values[f.name] for f in fields(Config)}
    for name in ("encoder", "decoder"):
        sizes[name] = tuple(sizes[name])
    config = Config(**sizes)
    if "kind" in metadata:
        return metadata["kind"], config
    if values["correction"]:
        return "correction", config
    changed = [k for k, v in SWITCHES_0_1.items() if values.get(k, v) != v]
    return " and ".join(changed) or "network", config
