"""A network's output for an image of any size, in overlapping tiles where it is large."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor

from invrender.types import Array
from nets.batch import PIXELS, Batch

# Pixels a side of a tile, and over which neighbours are blended: four of the network's coarsest
# cells. Chosen by hand, so that a tile needs little memory and no seam is seen.
TILE_SIZE, OVERLAP = 1024, 64


@torch.inference_mode()
def predict(
    network: torch.nn.Module,
    batch: Batch,
    progress: Callable[[float], None] | None = None,
    folder: Path | None = None,
) -> Batch:
    """A network's output (B, C, H, W) for a batch of any size, in overlapping tiles where it is
    large. Each tile is written to the ``folder``, or read where it lies there already."""
    height, width = batch["photo"].shape[-2:]
    tiles = list(_tiles(height, width))
    sums: dict[str, Tensor] = {}
    total = torch.zeros(1, 1, height, width)
    for i, (rows, columns) in enumerate(tiles):
        path = folder and folder / f"{i}.safetensors"
        if path and path.exists():
            out = load_file(path)
        else:
            out = network({
                k: v[..., rows, columns] if k in (*PIXELS, "position") else v
                for k, v in batch.items()
            })  # fmt: skip
            if path:
                path.parent.mkdir(parents=True, exist_ok=True)
                part = path.with_suffix(".part")
                save_file({k: v.contiguous() for k, v in out.items()}, part)
                part.replace(path)
        if progress:
            progress((i + 1) / len(tiles))
        if len(tiles) == 1:
            return out
        weight = _ramp(rows, height)[:, None] * _ramp(columns, width)
        for k, v in out.items():
            if k not in sums:
                sums[k] = torch.zeros(*v.shape[:2], height, width)
            sums[k][..., rows, columns] += v * weight
        total[..., rows, columns] += weight
    return {k: v / total for k, v in sums.items()}


def _starts(length: int) -> list[int]:
    if length <= TILE_SIZE:
        return [0]
    n = -(-(length - OVERLAP) // (TILE_SIZE - OVERLAP))
    return [round(i * (length - TILE_SIZE) / (n - 1)) for i in range(n)]


def _tiles(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    for y in _starts(height):
        for x in _starts(width):
            yield slice(y, min(y + TILE_SIZE, height)), slice(x, min(x + TILE_SIZE, width))


def _ramp(part: slice, length: int) -> Tensor:
    """Weights of a tile's rows: rising over the overlap, except at the image's own border."""
    i = torch.arange(part.start, part.stop, dtype=torch.float32)
    rise = (i - part.start + 1) / OVERLAP if part.start > 0 else torch.ones_like(i)
    fall = (part.stop - i) / OVERLAP if part.stop < length else torch.ones_like(i)
    return torch.minimum(rise, fall).clamp(max=1)


def tile_folder(
    folder: Path, notes: dict[str, Any], photo: Array, *inputs: NDArray[Any]
) -> Path | None:
    """Where in ``folder`` the tiles of a photo lie, by a digest of the network's notes and of all
    its inputs; None for a photo of one tile, which is not worth keeping."""
    if max(photo.shape[:2]) <= TILE_SIZE:
        return None
    digest = hashlib.sha256(json.dumps(notes, sort_keys=True).encode())
    for array in (photo, *inputs):
        digest.update(np.ascontiguousarray(array).data)
    return folder / digest.hexdigest()[:16]
