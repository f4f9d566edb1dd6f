"""Estimates at other sizes: what a network was trained to judge at small sizes it judges at those,
and the details of a larger photo's maps come from the photo."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from invrender.maps import Estimate, Maps, resize_maps, unit_normals
from invrender.refine.enlarge import enlarge, fitting
from invrender.refine.lobes import Lobes
from invrender.sampling import resize
from invrender.types import Array
from nets.model import LEAST_MAP_ROUGHNESS

COARSE = 128  # pixels of the longer side at which the correction was trained


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
    """The estimate of a photo (H, W, 3) from that of the photo shrunk. Expected errors are
    interpolated: with the photo they do not vary."""
    sigma = resized(whole.sigma, *photo.shape[:2])
    return replace(whole, maps=enlarge(whole.maps, photo), sigma=sigma, coarse=None, whole=whole)
