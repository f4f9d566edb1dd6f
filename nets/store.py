"""Networks by name, and their weights on disk."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from invrender.types import InputError
from nets.correction import Correction
from nets.model import Config, Network

PRESETS = {
    "small": Config(),
    "paper": Config(
        32, (2, 2, 4, 8), 12, (2, 2, 2, 2),
        active=False, slopes=False, lobes=False, clue_skips=False, narrow_fusion=False,
        denoiser=True,
    ),
    "tiny": Config(8, (1, 1), 1, (1, 1)),  # for tests
    "correction": Config(16, (1, 1, 2), 2, (1, 1, 1), correction=True),
}  # fmt: skip


AnyNetwork = Network | Correction


def _fresh(config: Config) -> AnyNetwork:
    network = (Correction if config.correction else Network)(config)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def build(name: str, **changes: Any) -> AnyNetwork:
    """A network from `PRESETS`, with fields of `Config` changed, in the channels-last layout."""
    if name not in PRESETS:
        raise InputError(f"no preset {name!r}; there are {', '.join(PRESETS)}")
    return _fresh(replace(PRESETS[name], **changes))


def save_weights(
    path: Path, network: AnyNetwork, notes: dict[str, Any], half: bool = False
) -> None:
    """Write safetensors with the `Config` and ``notes`` as JSON in its header."""
    tensors = {k: (v.half() if half else v).contiguous() for k, v in network.state_dict().items()}
    metadata = {"config": json.dumps(asdict(network.config)), "notes": json.dumps(notes)}
    part = path.with_suffix(".part")
    save_file(tensors, part, metadata=metadata)
    part.replace(path)


def load_weights(path: Path) -> tuple[AnyNetwork, dict[str, Any]]:
    """A network in evaluation mode from `save_weights`, and its notes. Raises `InputError`."""
    try:
        with safe_open(path, "pt") as f:
            metadata = f.metadata() or {}
        fields = json.loads(metadata["config"])
        changes: dict[str, Any] = {k: tuple(v) if type(v) is list else v for k, v in fields.items()}
        network = _fresh(Config(**changes))
        network.load_state_dict({k: v.float() for k, v in load_file(path).items()})
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as e:
        raise InputError(f"{path} holds no weights of this program: {e}") from None
    except Exception as e:  # safetensors has its own error class
        if type(e).__name__ != "SafetensorError":
            raise
        raise InputError(f"{path} is not a safetensors file: {e}") from None
    return network.eval(), json.loads(metadata.get("notes", "{}"))
