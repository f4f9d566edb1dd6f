"""The part of a photo around the mirror ball, and the curves and edges in it.

A ball is given by its circle (3,): x and y of its centre on the table, and its radius, in metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from invrender.capture.mirror import ball_centre, horizon_points, outline_points
from invrender.capture.settings import BALL_VIEW
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sampling import means_of_blocks
from invrender.types import TINY, Array


@dataclass(frozen=True)
class View:
    """A part of a photo of ``size`` (H, W), shrunk ``step`` times; it begins at ``origin`` (x, y).

    ``image`` (h, w, 3): linear radiance over its median, cut at ``white``, where the photo is
    saturated, at most `BALL_VIEW.brightest`. Photo pixel p is view position (p - origin) / step.
    """

    origin: Array
    step: int
    size: tuple[int, int]
    image: Array
    white: float

    @cached_property
    def tone(self) -> Array:
        """Logarithm of the radiance, (h, w, 3)."""
        return np.asarray(np.log(self.image + BALL_VIEW.toe))

    @cached_property
    def levels(self) -> Array:
        """The image ever more blurred, (5, h, w, 3)."""
        return np.stack([_smooth(self.image, sigma) for sigma in BALL_VIEW.blurs])

    @cached_property
    def tensor(self) -> Array:
        """The structure tensor of the tone summed over the channels, (h, w, 3): xx, xy, yy."""
        smooth = _smooth(self.tone, BALL_VIEW.tensor_blur)
        gy, gx = (
            ndimage.correlate1d(smooth, [-0.5, 0, 0.5], axis=a, mode="nearest") for a in (0, 1)
        )
        parts = [(gx * gx).sum(-1), (gx * gy).sum(-1), (gy * gy).sum(-1)]
        return np.stack(parts, -1).astype(np.float32)

    @cached_property
    def noise(self) -> float:
        """The median of the structure tensor's trace."""
        trace = self.tensor[..., 0] + self.tensor[..., 2]
        return float(np.median(trace)) + BALL_VIEW.least_noise

    def at(self, points: Array, rig: Rig) -> Array:
        """Points in space to view positions (..., 2), x right, y down."""
        return (rig.project(points, *self.size) - self.origin) / self.step

    def rays(self, positions: Array, rig: Rig) -> Array:
        """Unit directions (..., 3) from the camera through view positions (..., 2)."""
        return rig.rays(positions * self.step + self.origin, *self.size)


def _smooth(image: Array, sigma: float) -> Array:
    """A Gaussian over an image (h, w, 3), the border repeated."""
    import cv2  # SciPy takes five times as long

    size = 2 * round(4 * sigma) + 1
    image = image.astype(np.float32)
    return np.asarray(
        cv2.GaussianBlur(image, (size, size), sigma, None, sigma, cv2.BORDER_REPLICATE)
    )


def view_around(photo: Photo, middle: Array, reach: float, shrink: float) -> View:
    """The photo within ``reach`` pixels of ``middle`` (x, y), shrunk about ``shrink`` times."""
    step = max(1, round(shrink))
    low = np.maximum(np.floor(middle - reach), 0).astype(int)
    high = np.minimum(np.ceil(middle + reach), [photo.width, photo.height]).astype(int)
    high = low + np.maximum((high - low) // step, 1) * step
    part = means_of_blocks(photo.image[low[1] : high[1], low[0] : high[0]], step)
    level = max(float(np.median(part)), BALL_VIEW.least_level * float(part.max()), TINY)
    white = min((photo.clip_level or math.inf) / level, BALL_VIEW.brightest)
    image = np.minimum(part / level, BALL_VIEW.brightest)
    return View(low.astype(float), step, (photo.height, photo.width), image, white)


def horizon_curve(view: View, rig: Rig, circle: Array, count: int) -> Array:
    """The image of the horizon in the ball, view positions (count, 2)."""
    return view.at(horizon_points(rig, ball_centre(rig, circle), circle[2], count), rig)


def outline_curve(view: View, rig: Rig, circle: Array, count: int) -> Array:
    """The ball's outline, view positions (count, 2)."""
    return view.at(outline_points(rig, ball_centre(rig, circle), circle[2], count), rig)


def normals(curve: Array) -> Array:
    """Outward unit normals (n, 2) of a closed curve (n, 2)."""
    along = np.roll(curve, -1, 0) - np.roll(curve, 1, 0)
    normal = np.stack([along[:, 1], -along[:, 0]], -1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), TINY)
    outward = np.sum(normal * (curve - curve.mean(0)), -1, keepdims=True)
    return np.asarray(normal * np.where(outward < 0, -1, 1))


def edges(view: View, curve: Array, normal: Array, reach: float) -> tuple[Array, Array]:
    """Signed distance (n,) along each normal to the strongest edge, and its weight in [0, 1]."""
    per_pixel, margin = BALL_VIEW.edge_steps, BALL_VIEW.edge_margin
    count = math.ceil(reach * per_pixel) + margin
    t = np.arange(-count, count + 1) / per_pixel
    at = curve[:, None] + t[None, :, None] * normal[:, None]
    at = np.stack([at[..., 1] - 0.5, at[..., 0] - 0.5])
    slope = np.zeros(at.shape[1:])
    for c in range(3):
        line = ndimage.map_coordinates(view.tone[..., c], at, order=1, mode="nearest")
        line = ndimage.gaussian_filter1d(line, BALL_VIEW.edge_blur, axis=1, order=1, mode="nearest")
        slope += line**2
    i = np.argmax(slope[:, margin:-margin], 1) + margin
    row = np.arange(len(curve))
    before, here, after = (np.sqrt(slope[row, i + k]) for k in (-1, 0, 1))
    bend = before - 2 * here + after
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = np.where(bend < 0, 0.5 * (before - after) / bend, 0)
    interior = (i > margin) & (i < len(t) - margin - 1)
    typical = np.median(slope) + BALL_VIEW.least_slope
    strength = np.clip(here**2 / (BALL_VIEW.edge_strength * typical) - 0.5, 0, 1)
    return t[i] + np.clip(shift, -0.5, 0.5) / per_pixel, strength * interior
