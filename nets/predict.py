"""From a capture's sample and lights to material maps and their uncertainty, and one step on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch import Tensor

from invrender.lights import Lights
from invrender.maps import NAMES, Estimate, Maps, resize_maps, unit_normals
from invrender.refine.gauss_newton import linearise
from invrender.refine.lobes import Lobes, fit_lobes, read_lobes
from invrender.refine.theta import to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.renderer import Renderer
from invrender.render.scene import make_scene
from invrender.sampling import resize
from invrender.types import Array, InputError
from nets.batch import PIXELS, Batch, batch_of, lobe_input, positions
from nets.clues import light_inputs, white_level
from nets.model import MAPS
from nets.store import load_weights

WEIGHTS = Path(__file__).with_name("weights")
TILE, OVERLAP = 1024, 64
PASSES = 3  # of the correction, at most
SETTLED = 0.04  # mean change of roughness from which on another pass follows
WHOLE = 256  # pixels of the longer side at which a sample is judged as a whole
COARSE = 128  # pixels of the longer side at which the correction was trained


@dataclass(frozen=True)
class Prediction(Estimate):
    """What a network estimates of a photo; where that says nothing the deviations are large.

    unit: the radiance of a white plane under the capture's lights. lobes: what
    `invrender.refine.lobes` found of the photo, at most `WHOLE` pixels a side. interrupted: by
    Ctrl-C, before all passes of the correction were done.
    """

    unit: float
    lobes: Lobes | None = None
    interrupted: bool = False


class Reconstructor:
    """A network ready for use. Raises `InputError` where there are no weights."""

    def __init__(self, weights: Path | None = None) -> None:
        self.network, self.notes = load_weights(weights or WEIGHTS / "small.safetensors")

    def __call__(
        self,
        photo: Array,
        lights: Lights,
        progress: Callable[[float], None] | None = None,
        keep: Path | None = None,
    ) -> Prediction:
        """Maps of the sample from its photo (H, W, 3), linear radiance, row 0 at +y.

        The maps of a photo larger than `WHOLE` take their large shades and expected errors from it
        shrunk to that.

        lights: in the photo's unit of radiance, whatever that is. Pixels that are not finite count
        as black. ``progress`` is told the share done. keep: a folder for the tiles of an image of
        several; those that lie there are not computed again.
        """
        photo = np.asarray(photo, np.float32)
        if photo.ndim != 3 or photo.shape[2] != 3 or 0 in photo.shape:
            raise InputError(f"the photo must be (H, W, 3), got {photo.shape}")
        report = progress or (lambda _: None)
        report(0.0)
        rig, pattern, room = lights.rig, lights.pattern, lights.environment
        inputs = light_inputs(rig, pattern, lights.gain, room, lights.pattern_captured)
        unit = white_level(inputs)
        scale = 1 / max(unit, 1e-20)
        scene = make_scene(rig, pattern, room, np.asarray(lights.gain) * scale, scale)
        renderer = Fast(scene)
        report(0.3)

        def maps_of(photo: Array, progress: Callable[[float], None] | None = None) -> Prediction:
            seen = np.clip(np.nan_to_num(photo * scale, posinf=0.0, neginf=0.0), 0, 1e3)
            lobes = read_lobes(seen, renderer)
            kept = keep and _kept(keep, self.notes, photo, *inputs.values())
            out = predict(self.network, batch_of(photo, inputs, lobes), progress, kept)
            return replace(estimate_of(out, unit), lobes=lobes)

        found = maps_of(photo, partial(_told, report, 0.3, 0.7))
        if max(photo.shape[:2]) > WHOLE:
            found = _joined(found, maps_of(resize(photo, *_fitting(photo, WHOLE))))
        return found


class Corrector:
    """The learned correction (`nets.correction`) ready for use."""

    def __init__(self, weights: Path | None = None) -> None:
        self.network, _ = load_weights(weights or WEIGHTS / "correction.safetensors")

    def __call__(
        self,
        photo: Array,
        renderer: Renderer,
        estimate: Prediction,
        clipped: NDArray[np.bool_] | None = None,
        samples: int = 64,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Prediction:
        """Steps from an estimate towards what explains the photo (H, W, 3), until one changes
        roughness by less than `SETTLED` or there were `PASSES`; ``clipped``: where the photo is
        saturated. Ctrl-C ends it with what was found so far. ``progress`` is told the share done.

        What is shared by many pixels is judged best at the size of the training: beyond that
        roughness takes its large shades from a step at `COARSE`, and of a photo larger than
        `WHOLE` only the large shades are corrected."""
        if max(photo.shape[:2]) > WHOLE:
            small, start, few = _shrunk(WHOLE, photo, estimate, clipped)
            return _joined(estimate, self(small, renderer, start, few, samples, progress))
        try:
            known = estimate.lobes
            lobes = known.maps if known else fit_lobes(photo, renderer, samples)
            for i in range(PASSES):
                found = self._step(photo, renderer, estimate, lobes, clipped, samples)
                if max(photo.shape[:2]) > COARSE:
                    small, start, few = _shrunk(COARSE, photo, estimate, clipped)
                    own = resize_maps(lobes, *small.shape[:2])
                    coarse = self._step(small, renderer, start, own, few, samples)
                    found = _shaded(found, coarse, ["roughness"])
                change = np.abs(found.maps.roughness - estimate.maps.roughness).mean()
                estimate = found
                progress((i + 1) / PASSES)
                if change < SETTLED:
                    break
        except KeyboardInterrupt:
            estimate = replace(estimate, interrupted=True)
        return estimate

    def _step(
        self, photo: Array, renderer: Renderer, estimate: Prediction, lobes: Maps,
        clipped: NDArray[np.bool_] | None, samples: int,
    ) -> Prediction:  # fmt: skip
        """One pass."""
        inputs = linearised(photo, renderer, estimate, lobes, clipped, samples)
        batch = {k: torch.from_numpy(v)[None] for k, v in inputs.items()}
        return estimate_of(predict(self.network, batch), estimate.unit)


def _fitting(photo: Array, longest: int) -> tuple[int, int]:
    """Height and width of the photo (H, W, 3) shrunk until the longer of them is ``longest``."""
    height, width = photo.shape[:2]
    scale = longest / max(height, width)
    return max(1, round(height * scale)), max(1, round(width * scale))


def _shrunk(
    longest: int, photo: Array, estimate: Prediction, clipped: NDArray[np.bool_] | None
) -> tuple[Array, Prediction, NDArray[np.bool_] | None]:
    """All of it shrunk until the longer side is ``longest``; what touches a saturated pixel is."""
    low = _fitting(photo, longest)
    few = None if clipped is None else resize(clipped.astype(np.float32), *low) > 0
    maps, sigma = resize_maps(estimate.maps, *low), _resized(estimate.sigma, *low)
    return resize(photo, *low), replace(estimate, maps=maps, sigma=sigma), few


def _resized(sigma: dict[str, Array], height: int, width: int) -> dict[str, Array]:
    return {k: resize(v, height, width) for k, v in sigma.items()}


def _shaded(estimate: Prediction, coarse: Prediction, names: Iterable[str]) -> Prediction:
    """The estimate, whose maps ``names`` take from a coarser one all that this one can show."""
    own, maps = resize_maps(estimate.maps, *coarse.maps.shape), dict(vars(estimate.maps))
    for name in names:
        shades = getattr(coarse.maps, name) - getattr(own, name)
        maps[name] = maps[name] + resize(shades, *estimate.maps.shape)
    diffuse, specular = np.clip(maps["diffuse"], 0, 1), np.clip(maps["specular"], 0, 1)
    roughness, normal = np.clip(maps["roughness"], 0.02, 1), unit_normals(maps["normal"])
    return replace(estimate, maps=Maps(diffuse, specular, roughness, normal))


def _joined(fine: Prediction, whole: Prediction) -> Prediction:
    """An estimate with the large shades and the expected errors of a coarser one."""
    shaded, sigma = _shaded(fine, whole, NAMES), _resized(whole.sigma, *fine.maps.shape)
    return replace(shaded, sigma=sigma, lobes=whole.lobes, interrupted=whole.interrupted)


def _told(progress: Callable[[float], None], start: float, length: float, share: float) -> None:
    """Tell the whole's progress the share done of one of its parts."""
    progress(start + length * share)


def _kept(folder: Path, notes: dict[str, Any], photo: Array, *seen: NDArray[Any]) -> Path | None:
    """Where in ``folder`` the tiles of a photo lie, by a digest of the network's notes and of all
    that it sees; None for a photo of one tile, which is not worth keeping."""
    if max(photo.shape[:2]) <= TILE:
        return None
    digest = hashlib.sha256(json.dumps(notes, sort_keys=True).encode())
    for array in (photo, *seen):
        digest.update(np.ascontiguousarray(array).data)
    return folder / digest.hexdigest()[:16]


def linearised(
    photo: Array,
    renderer: Renderer,
    estimate: Prediction,
    lobes: Maps,
    clipped: NDArray[np.bool_] | None,
    samples: int,
) -> dict[str, Array]:
    """The correction's inputs (`nets.correction`), float32, without a batch axis."""
    height, width = photo.shape[:2]
    theta = to_theta(estimate.maps)
    image, jacobian = linearise(renderer, theta, samples)
    diagonal = [jacobian[..., range(3), range(k, k + 3)] for k in (0, 3)]
    columns = [jacobian[..., k] for k in (6, 7, 8)]
    unit = max(estimate.unit, 1e-20)
    seen = np.zeros((height, width), bool) if clipped is None else clipped
    images = {
        "photo": photo / unit,
        "image": image / unit,
        "jacobian": np.concatenate([*diagonal, *columns], -1) / unit,
        "theta": theta,
        "sigma0": np.stack([estimate.sigma[k] for k in MAPS], -1),
        "clipped": seen[..., None],
    }
    out = {k: np.ascontiguousarray(np.moveaxis(v, -1, 0), np.float32) for k, v in images.items()}
    return {**out, "lobes": lobe_input(lobes), "position": positions(height, width).numpy()}


@torch.inference_mode()
def predict(
    network: torch.nn.Module,
    batch: Batch,
    progress: Callable[[float], None] | None = None,
    keep: Path | None = None,
) -> Batch:
    """A network's output (B, C, H, W) for a batch of any size, in overlapping tiles where it is
    large. Each tile is kept in the folder ``keep`` or read from there."""
    height, width = batch["photo"].shape[-2:]
    tiles = list(_tiles(height, width))
    sums: dict[str, Tensor] = {}
    total = torch.zeros(1, 1, height, width)
    for i, (rows, columns) in enumerate(tiles):
        path = keep and keep / f"{i}.safetensors"
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


def estimate_of(out: Batch, unit: float) -> Prediction:
    """The first capture of a network's output, as numpy arrays."""
    image = lambda x: np.ascontiguousarray(x[0].permute(1, 2, 0).numpy())  # noqa: E731
    normal = image(out["normal"])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    maps = Maps(
        image(out["diffuse"]), image(out["specular"]), image(out["roughness"])[..., 0], normal
    )
    sigma = image(out["sigma"])
    return Prediction(maps, {k: sigma[..., i] for i, k in enumerate(MAPS)}, unit)
