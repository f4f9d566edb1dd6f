"""From a capture's sample and lights to material maps and their uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from invrender.errors import InputError
from invrender.maps import Maps
from invrender.rig import Rig
from nets.clues import light_inputs
from nets.loader import positions
from nets.model import MAPS, Batch, load_weights

Array = NDArray[np.floating[Any]]

WEIGHTS = Path(__file__).with_name("weights") / "small.safetensors"
TILE, OVERLAP = 1024, 64


@dataclass
class Estimate:
    """Maps, and for each the standard deviation (H, W) that the network expects of its error.

    Those of normals are of the encoded map, n/2 + 1/2; where the photo says nothing they are large.
    """

    maps: Maps
    sigma: dict[str, Array]


class Reconstructor:
    """A network ready for use. Raises `InputError` where there are no weights."""

    def __init__(self, weights: Path | None = None) -> None:
        self.network, self.notes = load_weights(WEIGHTS if weights is None else Path(weights))

    def __call__(
        self,
        photo: Array,
        rig: Rig,
        pattern: Array,
        gain: Any,
        environment: Array | None = None,
        captured: Array | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Estimate:
        """Maps of the sample from its photo (H, W, 3), linear radiance, row 0 at +y.

        pattern (P, P, 3) and gain (RGB): the screen's radiance; environment (H, 2H, 3) radiance in
        the photo's unit, whatever that is; captured: the screen's radiance as the ball shows it.
        Pixels that are not finite count as black. ``progress`` is told the share done.
        """
        photo = np.asarray(photo, np.float32)
        if photo.ndim != 3 or photo.shape[2] != 3 or 0 in photo.shape:
            raise InputError(f"the photo must be (H, W, 3), got {photo.shape}")
        report = progress or (lambda _: None)
        report(0.0)
        lights = light_inputs(rig, pattern, gain, environment, captured)
        report(0.3)
        batch = {k: torch.from_numpy(v)[None] for k, v in lights.items()}
        batch["photo"] = torch.from_numpy(np.ascontiguousarray(photo.transpose(2, 0, 1)))[None]
        batch["position"] = positions(*photo.shape[:2])[None]
        out = self.predict(batch, lambda x: report(0.3 + 0.7 * x))
        return _estimate(out)

    @torch.inference_mode()
    def predict(self, batch: Batch, progress: Callable[[float], None] | None = None) -> Batch:
        """The network on a batch of any size, in overlapping tiles where it is large."""
        height, width = batch["photo"].shape[-2:]
        tiles = list(_tiles(height, width))
        if len(tiles) == 1:
            out = self.network(batch)
            if progress:
                progress(1.0)
            return out
        sums: dict[str, Tensor] = {}
        total = torch.zeros(1, 1, height, width)
        for i, (rows, columns) in enumerate(tiles):
            cut = {
                k: v[..., rows, columns] if k in ("photo", "position") else v
                for k, v in batch.items()
            }
            weight = _ramp(rows, height)[:, None] * _ramp(columns, width)
            for k, v in self.network(cut).items():
                if k not in sums:
                    sums[k] = torch.zeros(*v.shape[:2], height, width)
                sums[k][..., rows, columns] += v * weight
            total[..., rows, columns] += weight
            if progress:
                progress((i + 1) / len(tiles))
        return {k: v / total for k, v in sums.items()}


def _starts(length: int) -> list[int]:
    if length <= TILE:
        return [0]
    n = -(-(length - OVERLAP) // (TILE - OVERLAP))
    return [round(i * (length - TILE) / (n - 1)) for i in range(n)]


def _tiles(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    for y in _starts(height):
        for x in _starts(width):
            yield slice(y, min(y + TILE, height)), slice(x, min(x + TILE, width))


def _ramp(part: slice, length: int) -> Tensor:
    """Weights of a tile's rows: rising over the overlap, except at the image's own border."""
    i = torch.arange(part.start, part.stop, dtype=torch.float32)
    rise = (i - part.start + 1) / OVERLAP if part.start > 0 else torch.ones_like(i)
    fall = (part.stop - i) / OVERLAP if part.stop < length else torch.ones_like(i)
    return torch.minimum(rise, fall).clamp(max=1)


def _estimate(out: Batch) -> Estimate:
    image = lambda x: np.ascontiguousarray(x[0].permute(1, 2, 0).numpy())  # noqa: E731
    normal = image(out["normal"])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    maps = Maps(
        image(out["diffuse"]), image(out["specular"]), image(out["roughness"])[..., 0], normal
    )
    sigma = image(out["sigma"])
    return Estimate(maps, {k: sigma[..., i] for i, k in enumerate(MAPS)})
