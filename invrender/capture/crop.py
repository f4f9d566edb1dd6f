"""The sample's square of the photo, resampled to the maps' pixels."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import ndimage

from invrender.capture.settings import CROP
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sampling import means_of_blocks
from invrender.types import Array, InputError, Mask


def crop_sample(photo: Photo, rig: Rig, size: int = 256) -> Array:
    """The sample's square of the photo as (size, size, 3) radiance, row 0 at +y.

    Each pixel is the mean over its square of the sample when the photo is finer than the crop, and
    interpolated by cubic splines where it is coarser. A photo pixel or two at the sample's border
    are not taken, the next inside are. Raises `InputError` if the sample is not
    whole in the photo.
    """
    sample_corners(photo, rig)
    return crop_part(photo, rig, size)


def crop_part(
    photo: Photo, rig: Rig, size: int, place: Array | None = None, sharp: bool = False,
    around: bool = False,
) -> Array:  # fmt: skip
    """As `crop_sample`, of another part of the table: where the homography ``place`` (3, 3) takes
    the sample's square, [-1, 1]², x right and y up. What is beyond the photo is its border.

    around: what lies around the photo's own square too, not the nearest of the square. sharp: the
    photo is the spline whose means over its pixels are the photo's values, so that
    neither the size of these nor interpolation blurs.
    """
    if size < 1:
        raise InputError(f"the sample's size must be at least one pixel, got {size}")
    h, w = photo.height, photo.width
    corners = rig.project(_placed(rig.sample_corners, rig, place), h, w)
    low, high = corners.min(0), corners.max(0)
    x0, y0 = np.clip(np.floor(low).astype(int) - CROP.margin, 0, [w - 1, h - 1])
    x1, y1 = np.clip(np.ceil(high).astype(int) + CROP.margin, 1, [w, h])
    crop = photo.image[y0:y1, x0:x1]
    scale = float((high - low).max()) / size  # photo pixels in one of the crop's
    samples = min(max(CROP.sharp_samples if sharp else 1, math.ceil(scale)), CROP.samples)
    wide = 2 * round((scale / samples - 1) / 2) + 1  # odd, so that nothing moves
    order = 3 if scale < CROP.spline_scale else 1  # the mean over many pixels needs no splines
    planes = [np.asarray(crop[..., c], np.float32) for c in range(3)]
    if wide > 1:
        planes = [ndimage.uniform_filter(plane, wide, mode="nearest") for plane in planes]
    margin = 0
    spline = order + sharp  # a spline's means over pixels are values of the one of the next order
    if spline > 1:  # as `map_coordinates` does it, but once for all bands
        margin = CROP.spline_margin
        planes = [
            ndimage.spline_filter(np.pad(p, margin, mode="edge"), spline, mode="nearest")
            for p in planes
        ]
    # Next to the border the lens mixes in what lies around the sample, often white paper.
    edge = CROP.edge * max(1.0, w / CROP.edge_width) / (scale * size)
    inner = rig.sample_size * (0.5 - min(edge, 0.5))
    out = np.empty((size, size, 3), np.float32)
    rows = max(1, CROP.band // (size * samples**2))
    for top in range(0, size, rows):
        band = slice(top, min(top + rows, size))
        points = _placed(_sample_rows(rig, size * samples, band, samples), rig, place)
        if not around:
            points[..., :2] = np.clip(points[..., :2], -inner, inner)
        pixels = rig.project(points, h, w)
        at = np.stack([pixels[..., 1] - y0 - 0.5, pixels[..., 0] - x0 - 0.5]) + margin
        for c, plane in enumerate(planes):
            fine = ndimage.map_coordinates(plane, at, order=order, mode="nearest", prefilter=False)
            out[band, :, c] = np.maximum(means_of_blocks(fine, samples), 0)
    return out


def _sample_rows(rig: Rig, size: int, band: slice, samples: int) -> Array:
    """The rows of `Rig.sample_points` (size, size) that lie in a band of rows ``samples`` as
    high."""
    x, y = rig.sample_points(1, size)[0, :, 0], rig.sample_points(size, 1)[:, 0, 1]
    y = y[band.start * samples : band.stop * samples]
    return np.stack([*np.meshgrid(x, y), np.zeros((len(y), size))], -1)


def _placed(points: Array, rig: Rig, place: Array | None) -> Array:
    """Points (..., 3) of the table where a homography of the sample's square takes them."""
    if place is None:
        return points
    half = rig.sample_size / 2
    moved = np.concatenate([points[..., :2] / half, np.ones_like(points[..., :1])], -1) @ place.T
    return np.concatenate([moved[..., :2] / moved[..., 2:] * half, points[..., 2:]], -1)


def in_photo(photo: Photo, rig: Rig, size: int, place: Array) -> Mask:
    """(size, size): which pixels of `crop_part` the photo shows."""
    pixels = rig.project(
        _placed(rig.sample_points(size, size), rig, place), photo.height, photo.width
    )
    inside = (pixels > 0) & (pixels < [photo.width, photo.height])  # NaN is not
    return np.asarray(inside.all(-1))


def crop_mask(photo: Photo, rig: Rig, size: int, place: Array | None = None) -> Mask:
    """(size, size): pixels of `crop_part` that a saturated photo pixel touches, or that lie outside
    of the photo's own square of the sample."""
    outside: Mask = np.zeros((size, size), bool)
    if place is not None:
        points = _placed(rig.sample_points(size, size), rig, place)
        outside |= np.any(np.abs(points[..., :2]) > rig.sample_size / 2 * CROP.beyond, axis=-1)
    corners = rig.project(_placed(rig.sample_corners, rig, place), photo.height, photo.width)
    x0, y0 = np.maximum(np.floor(corners.min(0)).astype(int) - CROP.mask_margin, 0)
    x1, y1 = np.maximum(np.ceil(corners.max(0)).astype(int) + CROP.mask_margin, 0)
    clipped = replace(photo, image=photo.image[y0:y1, x0:x1]).clipped
    if not clipped.any():
        return outside
    mask = np.zeros(photo.image.shape, np.float32)
    mask[y0:y1, x0:x1] = ndimage.maximum_filter(clipped, 3)[..., None]
    return outside | (crop_part(Photo(mask), rig, size, place)[..., 0] > CROP.touched)


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
