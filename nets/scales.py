"""Estimates at other sizes: what a network was trained to judge at small sizes it judges at those,
and the details of a larger photo's maps come from the photo."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from invrender.maps import Estimate, Maps, resize_maps, unit_normals
from invrender.refine.lobes import Lobes
from invrender.sampling import resize
from invrender.types import TINY, Array
from nets.model import LEAST_MAP_ROUGHNESS

WHOLE = 256  # pixels of the longer side at which a sample is judged as a whole
COARSE = 128  # pixels of the longer side at which the correction was trained
# Of the guided filter, by hand: pixels a side of its window; deviation of the photo's logarithm
# that tells nothing; what is added to the photo before, of its mean; n·z of the steepest normal.
GUIDE_SIZE, GUIDE_NOISE, DARK, STEEPEST_SLOPE = 5, 0.03, 0.02, 0.1


@dataclass(frozen=True)
class Prediction(Estimate):
    """What a network estimates of a photo; where that says nothing the deviations are large.

    unit: the radiance of a white plane under the capture's lights. lobes: what
    `invrender.refine.lobes` found of the photo, at most `WHOLE` pixels a side. coarse: what the
    network estimates of the photo shrunk to `COARSE`, where it is larger. whole: likewise to
    `WHOLE`, which `enlarged` to the photo's size this is. interrupted: by Ctrl-C, before all passes
    of the correction were done.
    """

    unit: float
    lobes: Lobes | None = None
    coarse: Prediction | None = None
    whole: Prediction | None = None
    interrupted: bool = False


def fitting(photo: Array, longest: int) -> tuple[int, int]:
    """Height and width of the photo (H, W, 3) shrunk until the longer of them is ``longest``."""
    height, width = photo.shape[:2]
    scale = longest / max(height, width)
    return max(1, round(height * scale)), max(1, round(width * scale))


def shrunk(
    longest: int, photo: Array, estimate: Prediction, clipped: NDArray[np.bool_] | None
) -> tuple[Array, Prediction, NDArray[np.bool_] | None]:
    """All of it shrunk until the longer side is ``longest``; what touches a saturated pixel is."""
    low = fitting(photo, longest)
    few = None if clipped is None else resize(clipped.astype(np.float32), *low) > 0
    maps, sigma = resize_maps(estimate.maps, *low), resized(estimate.sigma, *low)
    return resize(photo, *low), replace(estimate, maps=maps, sigma=sigma), few


def resized(sigma: dict[str, Array], height: int, width: int) -> dict[str, Array]:
    """Expected errors at another size."""
    return {k: resize(v, height, width) for k, v in sigma.items()}


def shaded(
    estimate: Prediction, coarse: Prediction, names: Iterable[str], share: float = 1.0
) -> Prediction:
    """The estimate, whose maps ``names`` take from a coarser one ``share`` of the large shades, all
    that this one can show, and keep the rest of their own."""
    own, maps = resize_maps(estimate.maps, *coarse.maps.shape), dict(vars(estimate.maps))
    for name in names:
        shades = getattr(coarse.maps, name) - getattr(own, name)
        maps[name] = maps[name] + np.float32(share) * resize(shades, *estimate.maps.shape)
    diffuse, specular = np.clip(maps["diffuse"], 0, 1), np.clip(maps["specular"], 0, 1)
    roughness = np.clip(maps["roughness"], LEAST_MAP_ROUGHNESS, 1)
    normal = unit_normals(maps["normal"])
    return replace(estimate, maps=Maps(diffuse, specular, roughness, normal))


def enlarged(whole: Prediction, photo: Array) -> Prediction:
    """The estimate of a photo (H, W, 3) from that of the photo shrunk.

    A guided filter (He, Sun, Tang 2013): slopes and albedos are linear in the logarithm of the
    photo around each small pixel, and what is linear there goes on to the details. Roughness, and
    expected errors, are interpolated: with the photo they do not vary.
    """
    height, width = photo.shape[:2]
    low = whole.maps.shape
    dark = DARK * photo.mean((0, 1)) + TINY
    guide = np.log(np.maximum(photo, 0) + dark).astype(np.float32)
    small = resize(guide, *low)
    guide -= resize(small, height, width)  # now what the small one does not show
    mean = _around(small)
    spread = _around(small[..., :, None] * small[..., None, :])
    spread -= mean[..., :, None] * mean[..., None, :]
    inverse = np.linalg.inv(spread + np.float32(GUIDE_NOISE**2) * np.eye(3, dtype=np.float32))

    def detailed(image: Array) -> Array:
        out = resize(image, height, width)
        for k in range(image.shape[-1]):
            x = image[..., k : k + 1]
            covariance = _around(small * x) - mean * _around(x)
            slope = np.einsum("hwij,hwj->hwi", inverse, covariance)
            out[..., k] += np.einsum("hwi,hwi->hw", resize(_around(slope), height, width), guide)
        return out

    maps = whole.maps
    normal = np.ones((height, width, 3), np.float32)
    normal[..., :2] = detailed(
        maps.normal[..., :2] / np.maximum(maps.normal[..., 2:], STEEPEST_SLOPE)
    )
    maps = Maps(
        np.clip(detailed(maps.diffuse), 0, 1),
        np.clip(detailed(maps.specular), 0, 1),
        resize(maps.roughness, height, width),
        unit_normals(normal),
    )
    sigma = resized(whole.sigma, height, width)
    return replace(whole, maps=maps, sigma=sigma, coarse=None, whole=whole)


def _around(image: Array) -> Array:
    """Means over the square around each pixel of (H, W, ...)."""
    from kornia.filters import box_blur

    planes = torch.from_numpy(image.reshape(*image.shape[:2], -1)).permute(2, 0, 1)[None]
    blurred = box_blur(planes, GUIDE_SIZE, border_type="replicate", separable=True)
    return blurred[0].permute(1, 2, 0).numpy().reshape(image.shape)
