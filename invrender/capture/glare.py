"""Veiling glare over the ball's image, measured and removed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import optimize

from invrender.capture.ball_image import BARE, pixel_grid, sample_image, trace_ball, window
from invrender.capture.mirror import Ball
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array

VEILED = 0.7  # what it must leave of the residuals' cost to be believed


def lift_veil(photo: Photo, rig: Rig, ball: Ball) -> Photo:
    """The photo without the glare that veils a part of the ball, if there is one.

    Between horizon and outline the ball mirrors the table, which the photo shows as well: what it
    shows more than that, over and over, is no image. That is fitted by a Gaussian in the photo with
    a colour of its own (least squares with Cauchy's loss), and taken from the whole ball where it
    explains the difference. A veil that ends before the horizon stays unseen.
    """
    area = rows, columns = window(ball)
    pixels = pixel_grid(rows, columns)
    point, mirrored, seen = trace_ball(rig, ball, pixels)
    table = point - mirrored * (point[..., 2:] / np.minimum(mirrored[..., 2:], -1e-3))
    at = rig.project(table, *ball.size)
    far = np.linalg.norm((table - np.asarray(ball.position))[..., :2], axis=-1)
    use = seen & (mirrored[..., 2] < -0.02) & (far > BARE * ball.radius_m)
    use &= (at > 1).all(-1) & (at < np.array(ball.size[::-1]) - 1).all(-1)
    # The sample may shine, and so look different from there.
    use &= ~(np.abs(table[..., :2]) < 0.51 * rig.sample_size).all(-1) & ~photo.clipped[area]
    mirror = np.asarray(rig.ball_reflectance)
    extra = photo.image[area][use] - mirror * sample_image(photo.image, at[use])
    spread = 1.48 * float(np.median(np.abs(extra))) if use.any() else 0.0
    if not spread > 0:
        return photo
    inside, outside = ((p - ball.centre) / ball.radius for p in (pixels, at[use]))

    def veil(p: Array, place: Array) -> Array:
        return np.asarray(np.exp(-((place - p[:2]) ** 2).sum(-1) / p[2] ** 2)[..., None] * p[3:])

    def off(p: Array) -> Array:
        seen = veil(p, inside[use]) - mirror * veil(p, outside)
        return np.asarray((seen - extra / spread).ravel())

    def cost(p: Array) -> float:
        return float(np.log1p(off(p) ** 2).sum())

    starts = []
    for angle in np.arange(12) * (math.pi / 6):
        start = np.array([math.cos(angle), math.sin(angle), 0.4, 0, 0, 0])
        near = ((inside[use] - start[:2]) ** 2).sum(-1) < 0.4**2
        if near.any():
            start[3:] = np.maximum(np.median(extra[near], 0) / spread, 0)
            starts.append(start)
    if not starts:
        return photo
    bounds = [-2, -2, 0.1, 0, 0, 0], [2, 2, 1, np.inf, np.inf, np.inf]
    start = min(starts, key=cost)
    p = optimize.least_squares(off, start, bounds=bounds, loss="cauchy", ftol=1e-6).x
    strength = veil(p, inside).sum(-1)
    # Nor is it believed where it would be stronger than anywhere it can be seen.
    sky = seen & (mirrored[..., 2] > 0)
    if not cost(p) < VEILED * cost(p * [1, 1, 1, 0, 0, 0]) or (
        strength[sky].max(initial=0) > strength[use].max()
    ):
        return photo
    image = photo.image.copy()
    lifted = np.maximum(image[area] - veil(p, inside) * spread, 0)
    image[area] = np.where(photo.clipped[area][..., None], image[area], lifted)
    return replace(photo, image=image)
