"""The rays of the photo that the ball mirrors, and what they meet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from invrender.capture.mirror import Ball, mirror_normals
from invrender.capture.settings import UNFOLDING
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array, Mask


@dataclass(frozen=True)
class BallImage:
    """The window of a photo that holds the ball, and what each of its pixels sees.

    rows, columns: the window in the photo; pixels (h, w, 2): positions of the pixels' centres;
    point, mirrored (h, w, 3): where the ray meets the ball, and the unit direction into which it is
    mirrored; visible (h, w): whether it meets the ball at all, the rest is undefined. Made once for
    a photo by `trace_image`; only the camera and the ball matter to it, not the screen.
    """

    ball: Ball
    rows: slice
    columns: slice
    pixels: Array
    point: Array
    mirrored: Array
    visible: Mask

    @property
    def area(self) -> tuple[slice, slice]:
        """The window, to index the photo with."""
        return self.rows, self.columns

    @property
    def origin(self) -> tuple[int, int]:
        """Row and column of the window's first pixel."""
        return self.rows.start, self.columns.start

    @property
    def sky(self) -> Mask:
        """(h, w): pixels that see what is above the horizon."""
        return self.visible & (self.mirrored[..., 2] > 0)

    def screen(self, rig: Rig) -> Mask:
        """(h, w): pixels that see the screen, or its bezel, and so not the room."""
        if not rig.has_screen:
            return np.zeros_like(self.visible)
        return self.visible & _meet(*rig.screen_body, self.point, self.mirrored)[2]


def trace_image(rig: Rig, ball: Ball) -> BallImage:
    """The ball's image with the rays of its pixels' centres."""
    rows, columns = window(ball)
    pixels = pixel_grid(rows, columns)
    return BallImage(ball, rows, columns, pixels, *trace_ball(rig, ball, pixels))


def screen_coordinates(rig: Rig, origin: Array, direction: Array) -> tuple[Array, Array, Mask]:
    """Where rays meet the screen: (s, t) along its edges, and whether within its lit area."""
    return _meet(rig.screen_corner, rig.screen_edges, origin, direction)


def _meet(
    corner: Array, edges: tuple[Array, Array], origin: Array, direction: Array
) -> tuple[Array, Array, Mask]:
    """Where rays meet a parallelogram: (s, t) along its edges, and whether within it."""
    e_x, e_y = edges
    normal = np.cross(e_x, e_y)
    along = direction @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((corner - origin) @ normal) / along
        point = origin + distance[..., None] * direction - corner
        s, t = point @ e_x / (e_x @ e_x), point @ e_y / (e_y @ e_y)
        hit = (distance > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return s, t, hit


def trace_ball(rig: Rig, ball: Ball, pixels: Array) -> tuple[Array, Array, Mask]:
    """Points on the ball and mirrored unit directions, both (..., 3), for photo pixels (..., 2).

    The mask says which pixels see the ball at all; the rest is undefined.
    """
    ray = rig.rays(pixels, *ball.size)
    centre = np.asarray(ball.position)
    to_ball = centre - rig.camera
    b = ray @ to_ball
    discriminant = b * b - to_ball @ to_ball + ball.radius_m**2
    distance = b - np.sqrt(np.maximum(discriminant, 0))
    point = rig.camera + distance[..., None] * ray
    normal = (point - centre) / ball.radius_m
    mirrored = ray - 2 * np.sum(ray * normal, -1, keepdims=True) * normal
    return point, mirrored, (discriminant > 0) & (point[..., 2] >= 0)


def window(ball: Ball) -> tuple[slice, slice]:
    """Rows and columns of the photo that hold the ball."""
    (x, y), r = ball.centre, max(ball.ellipse[2:4]) + UNFOLDING.window_margin
    h, w = ball.size
    return (
        slice(max(0, math.floor(y - r)), min(h, math.ceil(y + r))),
        slice(max(0, math.floor(x - r)), min(w, math.ceil(x + r))),
    )


def pixel_grid(rows: slice, columns: slice) -> Array:
    """Positions (H, W, 2) of the centres of a window's pixels."""
    y = rows.start + np.arange(rows.stop - rows.start) + 0.5
    x = columns.start + np.arange(columns.stop - columns.start) + 0.5
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)


def sample_image(image: Array, pixels: Array, origin: tuple[int, int] = (0, 0)) -> Array:
    """Bilinear look-ups (..., C) at pixels (..., 2); the image starts at ``origin`` (row, col)."""
    at = np.stack([pixels[..., 1] - origin[0] - 0.5, pixels[..., 0] - origin[1] - 0.5])
    planes = image[..., None] if image.ndim == 2 else image
    out = [
        ndimage.map_coordinates(planes[..., c], at, order=1, mode="nearest")
        for c in range(planes.shape[-1])
    ]
    return np.stack(out, -1) if image.ndim == 3 else out[0]


def screen_mask(rig: Rig, image: BallImage, margin: float) -> Array:
    """(h, w): 1 where the ball's image shows the screen, grown by ``margin`` pixels."""
    distance = ndimage.distance_transform_edt(~image.screen(rig))
    # The edge of the mask's pixels lies half a pixel outside their centres.
    return np.asarray(distance <= margin + 0.5, np.float32)


def unfold_pattern(photo: Photo, rig: Rig, ball: Ball, size: int = 256) -> Array:
    """The screen as the ball shows it, (size, size, 3) radiance, row 0 at +y, column 0 at -x.

    For each point of the screen the photo is looked up at the point of the ball that mirrors it
    into the camera; the screen counts as near.
    """
    rows, columns = window(ball)
    s = (np.arange(size) + 0.5) / size
    e_x, e_y = rig.screen_edges
    target = rig.screen_corner + s[None, :, None] * e_x + (1 - s)[:, None, None] * e_y
    centre = np.asarray(ball.position)
    normal = mirror_normals(rig, centre, ball.radius_m, target, True)
    pixels = rig.project(centre + ball.radius_m * normal, *ball.size)
    light = sample_image(photo.image[rows, columns], pixels, (rows.start, columns.start))
    return np.asarray(light / np.asarray(rig.ball_reflectance), np.float32)
