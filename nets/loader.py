"""Batches from shards of captures, in an order that depends on seed, data and step alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor

from invrender.errors import InputError
from nets.model import Batch

GROUP = 8  # shards that are shuffled together
PIXELS = ("photo", "ideal", "maps", "clipped", "theta", "sigma0", "image", "jacobian", "lobes")


def shards(folder: Path) -> list[Path]:
    """The shards of a folder, sorted. Raises `InputError` when there is none."""
    found = sorted(Path(folder).glob("shard_*.safetensors"))
    if not found:
        raise InputError(f"{folder} holds no shards; make some with python -m nets.data")
    return found


def positions(height: int, width: int) -> Tensor:
    """Pixel centres over the sample, (2, H, W) in [-1, 1], x right and y up."""
    x = (torch.arange(width) + 0.5) / width * 2 - 1
    y = 1 - (torch.arange(height) + 0.5) / height * 2
    return torch.stack(torch.meshgrid(x, y, indexing="xy"))


def _read(path: Path, rows: list[int], corners: np.ndarray | None, crop: int) -> Batch:
    """Captures ``rows`` of a shard, cut to crop × crop at ``corners`` (row, column)."""
    out: Batch = {}
    with safe_open(path, "pt") as f:
        size = f.get_slice("photo").get_shape()[-1]
        crop = min(crop, size)
        cuts = [(0, 0)] * len(rows) if corners is None else [
            (int(u * (size - crop + 1)), int(v * (size - crop + 1))) for u, v in corners
        ]  # fmt: skip
        for key in f.keys():  # noqa: SIM118  (no dict)
            source = f.get_slice(key)
            if key in PIXELS:
                parts = [
                    source[r : r + 1, :, y : y + crop, x : x + crop]
                    for r, (y, x) in zip(rows, cuts, strict=True)
                ]
            else:
                parts = [source[r : r + 1] for r in rows]
            tensor = torch.cat(parts)
            out[key] = tensor if key == "maps" else tensor.float()
    grid = positions(size, size)
    out["position"] = torch.stack([grid[:, y : y + crop, x : x + crop] for y, x in cuts])
    return out


def count(path: Path) -> int:
    """Captures in a shard."""
    with safe_open(path, "pt") as f:
        return int(f.get_slice("photo").get_shape()[0])


def read_batch(path: Path, batch: int) -> Iterator[Batch]:
    """A shard's captures in order, whole."""
    n = count(path)
    for start in range(0, n, batch):
        yield _read(path, list(range(start, min(start + batch, n))), None, 1 << 16)


def batches(
    folder: Path,
    batch: int,
    crop: int,
    seed: int,
    start: int = 0,
    rank: int = 0,
    world: int = 1,
) -> Iterator[Batch]:
    """Endless random crops, from step ``start`` on; each of ``world`` processes gets its own part.

    An epoch is made of what the folder holds when it begins, so shards may be added meanwhile.
    """
    step, epoch = 0, 0
    while True:
        rng = np.random.default_rng([seed, epoch])
        paths = shards(folder)
        order = [paths[i] for i in rng.permutation(len(paths))]
        for at in range(0, len(order), GROUP):
            members = [(p, i) for p in order[at : at + GROUP] for i in range(count(p))]
            members = [members[i] for i in rng.permutation(len(members))]
            corners = rng.random((len(members), 2))
            for k in range(0, len(members) - batch * world + 1, batch * world):
                step += 1
                if step <= start:
                    continue
                mine = slice(k + rank * batch, k + (rank + 1) * batch)
                yield _gather(members[mine], corners[mine], crop)
        if step == 0:
            raise InputError(f"{folder} holds fewer captures than a batch of {batch * world}")
        epoch += 1


def _gather(members: list[tuple[Path, int]], corners: np.ndarray, crop: int) -> Batch:
    parts = [_read(p, [i], c[None], crop) for (p, i), c in zip(members, corners, strict=True)]
    return {k: torch.cat([p[k] for p in parts]) for k in parts[0]}
