"""Captures turned and mirrored as a whole: sample, screen, room and camera together.

Light knows neither left nor right, so a turned capture is as true as the one that was rendered,
and a network that has seen all eight ways does not learn one orientation of the pattern by heart.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nets.batch import Batch

WAYS = 8  # of a square: bit 0 swaps x and y, then bit 1 mirrors x, bit 2 mirrors y

# Channels that are components along x, and those along y, of vectors in the sample's plane.
VECTORS = {
    "maps": (slice(0, 1), slice(1, 2)),
    "slope_clues": (slice(0, 9), slice(9, 18)),
    "position": (slice(0, 1), slice(1, 2)),
    "theta": (slice(7, 8), slice(8, 9)),
    "jacobian": (slice(9, 12), slice(12, 15)),
}


def turned(batch: Batch, way: int) -> Batch:
    """The batch seen another way, one of `WAYS`; 0 leaves it as it is.

    Every tensor (B, C, S, S) is taken for an image with x to the right and y up, those of
    `VECTORS` with channels that go along; ``maps`` may be bytes. ``rig`` keeps its screen's edges
    along +x and +y, so that the pattern's image turns like all others.

        batch = turned(batch, int(rng.integers(WAYS)))
    """
    if not 0 <= way < WAYS:
        raise ValueError(f"way must be between 0 and {WAYS - 1}, got {way}")
    out = {k: turned_image(v, way) if v.ndim == 4 else v for k, v in batch.items()}
    for key in VECTORS.keys() & out.keys():
        out[key] = _turned_vectors(out[key], VECTORS[key], way)
    if "rig" in out:
        out["rig"] = _turned_rig(out["rig"], way)
    return out


def turned_image(image: Tensor, way: int) -> Tensor:
    """The pixels of a square image (..., S, S), row 0 at +y."""
    if way & 1:
        image = image.transpose(-1, -2).flip((-1, -2))
    mirrored = [axis for axis, bit in ((-1, 2), (-2, 4)) if way & bit]
    return image.flip(mirrored) if mirrored else image


def _turned_vectors(image: Tensor, channels: tuple[slice, slice], way: int) -> Tensor:
    """Both components of the vectors of an image (B, C, H, W); bytes v stand for 2·v/255 - 1."""
    parts = [image[:, c] for c in channels]
    if way & 1:
        parts.reverse()
    out = image.clone()
    for part, place, bit in zip(parts, channels, (2, 4), strict=True):
        negative = 255 - part if image.dtype == torch.uint8 else -part
        out[:, place] = negative if way & bit else part
    return out


def _turned_rig(rig: Tensor, way: int) -> Tensor:
    """Of `nets.splitsum.pack_rig`, (B, 12)."""
    vectors = rig.unflatten(1, (4, 3)).clone()
    if way & 1:
        vectors = vectors[..., [1, 0, 2]][:, [0, 1, 3, 2]]
    for axis, bit in ((0, 2), (1, 4)):
        if way & bit:
            vectors[..., axis] *= -1
            edge = vectors[:, 2 + axis].clone()  # now along the negative axis
            vectors[:, 1] += edge
            vectors[:, 2 + axis] = -edge
    return vectors.flatten(1)
