"""The rays of the photo that the ball mirrors, and what they meet."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from invrender.capture.mirror import Ball, mirror_normals
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array, Mask

# Pixels around the screen's image that may hold some of its light, and how many more for each of
# the camera's blur: the screen is often a hundred times as bright as the room beside it.
SCREEN_MARGIN = 1.5
# A veil over the ball is told from the table that is mirrored from 1.8 radii on.
BARE = 1.8


def screen_coordinates(rig: Rig, origin: Array, direction: Array) -> tuple[Array, Array, Mask]:
    """Where rays meet the screen: (s, t) along its edges, and whether within its rectangle."""
    e_x, e_y = rig.screen_edges
    normal = np.cross(e_x, e_y)
    along = direction @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((rig.screen_corner - origin) @ normal) / along
        point = origin + distance[..., None] * direction - rig.screen_corner
        s, t = point @ e_x / (e_x @ e_x), point @ e_y / (e_y @ e_y)
        hit = (distance > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return s, t, hit


def trace_ball(rig: Rig, ball: Ball, pixels: Array) -> tuple[Array, Array, Mask]:
    """Points on the ball and mirrored unit directions, both (..., 3), for photo pixels (..., 2).

    The mask says which pixels see the hemisphere at all; the rest is undefined.
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


def window(ball: Ball, margin: float = 4.0) -> tuple[slice, slice]:
    """Rows and columns of the photo that hold the ball."""
    (x, y), r = ball.centre, max(ball.ellipse[2:4]) + margin
    h, w = ball.size
    return (
        slice(max(0, math.floor(y - r)), min(h, math.ceil(y + r))),
        slice(max(0, math.floor(x - r)), min(w, math.ceil(x + r))),
    )


def pixel_grid(rows: slice, columns: slice, samples: int = 1) -> Array:
    """Positions (H·samples, W·samples, 2) evenly within the pixels of a window."""
    y = rows.start + (np.arange((rows.stop - rows.start) * samples) + 0.5) / samples
    x = columns.start + (np.arange((columns.stop - columns.start) * samples) + 0.5) / samples
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


def screen_mask(rig: Rig, ball: Ball, margin: float) -> tuple[Array, tuple[slice, slice]]:
    """1 where the ball's image shows the screen, grown by ``margin`` pixels; and its window."""
    rows, columns = area = window(ball)
    point, mirrored, seen = trace_ball(rig, ball, pixel_grid(rows, columns))
    _, _, hit = screen_coordinates(rig, point, mirrored)
    distance = ndimage.distance_transform_edt(~(hit & seen))
    # The edge of the mask's pixels lies half a pixel outside their centres.
    return np.asarray(distance <= margin + 0.5, np.float32), area


def unfold_pattern(photo: Photo, rig: Rig, ball: Ball, size: int = 256, samples: int = 1) -> Array:
    """The screen as the ball shows it, (size, size, 3) radiance, row 0 at +y, column 0 at -x.

    For each point of the screen the point of the ball that mirrors it into the camera, near field.
    """
    rows, columns = window(ball)
    n = size * samples
    s = (np.arange(n) + 0.5) / n
    e_x, e_y = rig.screen_edges
    target = rig.screen_corner + s[None, :, None] * e_x + (1 - s)[:, None, None] * e_y
    centre = np.asarray(ball.position)
    normal = mirror_normals(rig, centre, ball.radius_m, target, True)
    pixels = rig.project(centre + ball.radius_m * normal, *ball.size)
    light = sample_image(photo.image[rows, columns], pixels, (rows.start, columns.start))
    light = light.reshape(size, samples, size, samples, 3).mean((1, 3))
    return (light / np.asarray(rig.ball_reflectance)).astype(np.float32)
