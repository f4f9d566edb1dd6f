"""The sample's square of the photo, resampled to the maps' pixels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.capture.settings import CROP
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array, InputError


def crop_sample(photo: Photo, rig: Rig, size: int = 256) -> Array:
    """The sample's square of the photo as (size, size, 3) radiance, row 0 at +y.

    Each pixel is the mean over its square of the sample when the photo is finer than the crop, and
    interpolated by cubic splines where it is coarser. Raises `InputError` if the sample is not
    whole in the photo.
    """
    if size < 1:
        raise InputError(f"the sample's size must be at least one pixel, got {size}")
    h, w = photo.height, photo.width
    corners = sample_corners(photo, rig)
    low, high = corners.min(0), corners.max(0)
    x0, y0 = np.maximum(np.floor(low).astype(int) - CROP.margin, 0)
    x1, y1 = np.minimum(np.ceil(high).astype(int) + CROP.margin, [w, h])
    crop = photo.image[y0:y1, x0:x1]
    scale = float((high - low).max()) / size  # photo pixels in one of the crop's
    samples = min(max(1, math.ceil(scale)), CROP.samples)
    wide = 2 * round((scale / samples - 1) / 2) + 1  # odd, so that nothing moves
    order = 3 if scale < CROP.spline_scale else 1  # the mean over many pixels needs no splines
    pixels = rig.project(rig.sample_points(size * samples, size * samples), h, w)
    at = np.stack([pixels[..., 1] - y0 - 0.5, pixels[..., 0] - x0 - 0.5])
    planes = []
    for c in range(3):
        plane = crop[..., c]
        if wide > 1:
            plane = ndimage.uniform_filter(plane, wide, mode="nearest")
        plane = ndimage.map_coordinates(plane, at, order=order, mode="nearest")
        planes.append(plane.reshape(size, samples, size, samples).mean((1, 3)))
    return np.maximum(np.stack(planes, -1), 0).astype(np.float32)


def crop_mask(photo: Photo, rig: Rig, size: int) -> NDArray[np.bool_]:
    """(size, size): pixels of the sample's crop that a saturated photo pixel touches."""
    corners = sample_corners(photo, rig)
    x0, y0 = np.maximum(np.floor(corners.min(0)).astype(int) - CROP.mask_margin, 0)
    x1, y1 = np.ceil(corners.max(0)).astype(int) + CROP.mask_margin
    clipped = photo.clipped
    if not clipped[y0:y1, x0:x1].any():
        return np.zeros((size, size), bool)
    mask = np.zeros((*clipped.shape, 3), np.float32)
    mask[y0:y1, x0:x1] = ndimage.maximum_filter(clipped[y0:y1, x0:x1], 3)[..., None]
    return crop_sample(Photo(mask), rig, size)[..., 0] > CROP.touched


def sample_corners(photo: Photo, rig: Rig) -> Array:
    """The sample's corners in photo pixels, (4, 2), one after another around it.

    Raises `InputError` if the sample is not whole in the photo.
    """
    h, w = photo.height, photo.width
    corners = rig.project(rig.sample_corners, h, w)
    if not (
        np.isfinite(corners).all()
        and (corners >= -CROP.tolerance).all()
        and (corners <= np.array([w, h]) + CROP.tolerance).all()
    ):
        raise InputError("the sample reaches beyond the photo: check the rig's sizes and fov")
    return corners
