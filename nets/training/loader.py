"""Batches from shards of captures, in an order that depends on seed, data and step alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import Tensor

from invrender.types import InputError
from nets.batch import PIXELS, Batch, positions
from nets.training.turn import WAYS, turned

GROUP = 8  # shards that are shuffled together
CPU = torch.device("cpu")


def shards(folder: Path) -> list[Path]:
    """The shards of a folder, sorted. Raises `InputError` when there is none."""
    found = sorted(Path(folder).glob("shard_*.safetensors"))
    if not found:
        raise InputError(
            f"{folder} holds no shards; make some with python -m nets.training.dataset"
        )
    return found


def count(path: Path) -> int:
    """Captures in a shard."""
    with safe_open(path, "pt") as f:
        return int(f.get_slice("photo").get_shape()[0])


_keep = cache(load_file)


def load_shards(paths: Sequence[Path], device: torch.device) -> Batch:
    """The captures of some shards, one after another. A GPU keeps every shard that it has seen."""
    load = _keep if device.type == "cuda" else load_file
    parts = [load(path, str(device)) for path in paths]
    for part in parts:
        if "readings" in part:  # the evidence's name in shards of version 0.1
            part["evidence"] = part.pop("readings")
    return {k: torch.cat([part[k] for part in parts]) for k in parts[0]}


def _cut(
    captures: Batch,
    rows: Sequence[int] | np.ndarray,
    corners: np.ndarray | None = None,
    crop: int = 1 << 16,
) -> Batch:
    """Captures ``rows``, whole or cut to crop × crop at ``corners`` (row, column in [0, 1])."""
    photo = captures["photo"]
    size = photo.shape[-1]
    crop = min(crop, size)
    cuts = [(0, 0)] * len(rows) if corners is None else [
        (int(u * (size - crop + 1)), int(v * (size - crop + 1))) for u, v in corners
    ]  # fmt: skip
    index = torch.as_tensor(rows, device=photo.device)

    def pixels(images: Tensor) -> Tensor:
        if crop == size:
            return images
        parts = [x[:, r : r + crop, c : c + crop] for x, (r, c) in zip(images, cuts, strict=True)]
        return torch.stack(parts)

    out = {k: pixels(v[index]) if k in PIXELS else v[index] for k, v in captures.items()}
    out = {k: v if k == "maps" else v.float() for k, v in out.items()}
    grid = positions(size, size).to(photo.device)
    return {**out, "position": pixels(grid.expand(len(rows), -1, -1, -1))}


def read_batch(path: Path, batch: int, device: torch.device = CPU) -> Iterator[Batch]:
    """A shard's captures in order, whole."""
    captures = load_shards([path], device)
    n = len(captures["photo"])
    for start in range(0, n, batch):
        yield _cut(captures, range(start, min(start + batch, n)))


def batches(
    folder: Path,
    batch: int,
    crop: int,
    seed: int,
    start: int = 0,
    rank: int = 0,
    world: int = 1,
    device: torch.device = CPU,
    turning: float = 0.0,
) -> Iterator[Batch]:
    """Endless random crops, from step ``start`` on; each of ``world`` processes gets its own part.
    A share ``turning`` of the batches is `turned` to any of the eight ways.

    An epoch is made of what the folder holds when it begins, so shards may be added meanwhile;
    those that are deleted meanwhile are left out.
    """
    step, epoch = 0, 0
    while True:
        rng = np.random.default_rng([seed, epoch])
        paths = shards(folder)
        order = [paths[i] for i in rng.permutation(len(paths))]
        for at in range(0, len(order), GROUP):
            group = [p for p in order[at : at + GROUP] if p.exists()]
            members = rng.permutation(sum(count(p) for p in group))
            corners = rng.random((len(members), 2))
            ways = rng.integers(WAYS, size=len(members)) * (rng.random(len(members)) < turning)
            captures: Batch = {}
            for k in range(0, len(members) - batch * world + 1, batch * world):
                step += 1
                if step <= start:
                    continue
                try:
                    captures = captures or load_shards(group, device)
                except FileNotFoundError:  # deleted since the group was formed
                    break
                mine = slice(k + rank * batch, k + (rank + 1) * batch)
                yield turned(_cut(captures, members[mine], corners[mine], crop), int(ways[k]))
        if step == 0:
            raise InputError(f"{folder} holds fewer captures than a batch of {batch * world}")
        epoch += 1
