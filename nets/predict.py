"""From a capture's sample and lights to material maps and their uncertainty, and one step on."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from invrender.lights import Lights
from invrender.maps import Maps, resize_maps
from invrender.refine.enlarge import WHOLE, fitting
from invrender.refine.gauss_newton import linearise
from invrender.refine.lobes import FIT_SIZE, Lobes, fit_lobes, lobe_terms, read_lobes
from invrender.refine.theta import to_theta
from invrender.render.fast.estimator import Fast
from invrender.render.renderer import Renderer
from invrender.render.scene import scene_under
from invrender.sampling import resize
from invrender.types import Array, InputError
from nets.batch import Batch, batch_of, lobe_input, positions
from nets.blocks import without_grid
from nets.clues import light_inputs, white_level
from nets.model import LEAST_LEVEL, MAPS, MAX_PHOTO
from nets.scales import COARSE, Prediction, enlarged, shaded, shrunk
from nets.store import load_weights

WEIGHTS = Path(__file__).with_name("weights")
PASSES = 3  # of the correction, at most
SETTLED = 0.04  # mean change of roughness from which on another pass follows
LEAST_LENGTH = 1e-6  # of a normal
LIGHTS_SHARE = 0.3  # of the time that a reconstruction takes: the preparation of the lights


class Reconstructor:
    """A network ready for use. Raises `InputError` where there are no weights."""

    def __init__(self, weights: Path | None = None) -> None:
        self.network, self.notes = load_weights(weights or WEIGHTS / "small.safetensors")

    def __call__(
        self,
        photo: Array,
        lights: Lights,
        progress: Callable[[float], None] | None = None,
    ) -> Prediction:
        """Maps of the sample from its photo (H, W, 3), linear radiance, row 0 at +y.

        Of a photo larger than `WHOLE` they are those of it shrunk to that, `enlarged`.

        lights: in the photo's unit of radiance, whatever that is. Pixels that are not finite count
        as black. ``progress`` is told the share done.
        """
        photo = np.asarray(photo, np.float32)
        if photo.ndim != 3 or photo.shape[2] != 3 or 0 in photo.shape:
            raise InputError(f"the photo must be (H, W, 3), got {photo.shape}")
        report = progress or (lambda share: None)
        report(0.0)
        inputs = light_inputs(
            lights.rig, lights.pattern, lights.gain, lights.environment, lights.pattern_captured,
            device=lights.device,
        )  # fmt: skip
        unit = white_level(inputs)
        scale = 1 / max(unit, LEAST_LEVEL)
        renderer = Fast(scene_under(lights, scale))
        report(LIGHTS_SHARE)

        terms_of = cache(partial(lobe_terms, renderer))

        def read(photo: Array) -> Lobes:
            seen = np.clip(np.nan_to_num(photo * scale, posinf=0.0, neginf=0.0), 0, MAX_PHOTO)
            terms = terms_of(*(min(FIT_SIZE, n) for n in photo.shape[:2]))
            return read_lobes(seen, renderer, terms=terms)

        large, longest = photo, max(photo.shape[:2])
        if longest > WHOLE:
            photo = resize(photo, *fitting(photo, WHOLE))
        photos = [photo]
        if longest > COARSE:
            photos.append(resize(photo, *fitting(photo, COARSE)))
        # The network works at one size while the lobes of the next are read.
        with ThreadPoolExecutor(len(photos)) as beside:
            asked = []
            for photo in photos:
                lobes = read(photo)
                batch = batch_of(photo, inputs, lobes)
                asked.append((lobes, beside.submit(predict, self.network, batch)))
        found, *coarse = (
            replace(estimate_of(out.result(), unit), lobes=lobes) for lobes, out in asked
        )
        found = replace(found, coarse=coarse[0] if coarse else None)
        report(1.0)
        return enlarged(found, large) if longest > WHOLE else found


@torch.inference_mode()
def predict(network: torch.nn.Module, batch: Batch) -> Batch:
    """A network's output for a batch, its maps `without_grid`."""
    out: Batch = network(batch)
    plain = {k: without_grid(out[k]) for k in MAPS}
    return out | plain | {k: plain[k].clamp(0, 1) for k in MAPS if k != "normal"}


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
        roughness takes its large shades from a step at `COARSE`; albedos' and roughness's large
        shades are the mean of that and of what ``estimate.coarse`` is corrected to; and of a photo
        larger than `WHOLE`, ``estimate.whole`` is corrected, and `enlarged`."""
        if estimate.whole:
            small, _, few = shrunk(WHOLE, photo, estimate, clipped)
            found = self(small, renderer, estimate.whole, few, samples, progress)
            return enlarged(found, photo)
        if estimate.coarse:
            small, _, few = shrunk(COARSE, photo, estimate, clipped)
            alone = replace(estimate, coarse=None)
            fine = self(photo, renderer, alone, clipped, samples, progress)
            coarse = self(small, renderer, estimate.coarse, few, samples)
            pooled = shaded(fine, coarse, ("diffuse", "specular", "roughness"), 1 / 2)
            return replace(pooled, interrupted=fine.interrupted or coarse.interrupted)
        try:
            known = estimate.lobes
            lobes = known.maps if known else fit_lobes(photo, renderer, samples)
            for i in range(PASSES):
                found = self._step(photo, renderer, estimate, lobes, clipped, samples)
                if max(photo.shape[:2]) > COARSE:
                    small, start, few = shrunk(COARSE, photo, estimate, clipped)
                    own = resize_maps(lobes, *small.shape[:2])
                    coarse = self._step(small, renderer, start, own, few, samples)
                    found = shaded(found, coarse, ["roughness"])
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
    unit = max(estimate.unit, LEAST_LEVEL)
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


def estimate_of(out: Batch, unit: float) -> Prediction:
    """The first capture of a network's output, as numpy arrays."""
    image = lambda x: np.ascontiguousarray(x[0].permute(1, 2, 0).numpy())  # noqa: E731
    normal = image(out["normal"])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), LEAST_LENGTH)
    maps = Maps(
        image(out["diffuse"]), image(out["specular"]), image(out["roughness"])[..., 0], normal
    )
    sigma = image(out["sigma"])
    return Prediction(maps, {k: sigma[..., i] for i, k in enumerate(MAPS)}, unit)
