"""Veiling glare over the ball's image, measured and removed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy import optimize

from invrender.capture.ball_image import BallImage, sample_image
from invrender.capture.robust import spread
from invrender.capture.settings import GLARE_FIT
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import Array


def remove_glare(photo: Photo, rig: Rig, image: BallImage) -> Photo:
    """The photo without the glare that veils a part of the ball, if there is one.

    Between horizon and outline the ball mirrors the table, which the photo shows as well: what the
    ball shows more than that is glare. It is fitted by a Gaussian in the photo with a colour of its
    own (least squares with Cauchy's loss), and subtracted from the whole ball where it explains the
    difference. Glare that ends before the horizon is not found.
    """
    ball, area = image.ball, image.area
    point, mirrored = image.point, image.mirrored
    down = np.minimum(mirrored[..., 2:], -GLARE_FIT.least_downward)
    table = point - mirrored * (point[..., 2:] / down)
    at = rig.project(table, *ball.size)
    far = np.linalg.norm((table - np.asarray(ball.position))[..., :2], axis=-1)
    use = image.visible & (mirrored[..., 2] < -GLARE_FIT.downward)
    use &= far > GLARE_FIT.bare * ball.radius_m
    use &= (at > 1).all(-1) & (at < np.array(ball.size[::-1]) - 1).all(-1)
    # The sample may shine, and so look different from the ball.
    use &= ~(np.abs(table[..., :2]) < GLARE_FIT.sample * rig.sample_size).all(-1)
    shown = replace(photo, image=photo.image[area])
    use &= ~shown.clipped
    reflectance = np.asarray(rig.ball_reflectance)
    extra = shown.image[use] - reflectance * sample_image(photo.image, at[use])
    scale = float(spread(extra)) if use.any() else 0.0
    if not scale > 0:
        return photo
    inside, outside = ((p - ball.centre) / ball.radius for p in (image.pixels, at[use]))
    measured = inside[use]
    some = slice(None, None, max(1, len(measured) // GLARE_FIT.pixels))  # glare is smooth

    def glare(p: Array, place: Array) -> Array:
        return np.asarray(np.exp(-((place - p[:2]) ** 2).sum(-1) / p[2] ** 2)[..., None] * p[3:])

    def residuals(p: Array) -> Array:
        expected = glare(p, measured[some]) - reflectance * glare(p, outside[some])
        return np.asarray((expected - extra[some] / scale).ravel())

    def cost(p: Array) -> float:
        return float(np.log1p(residuals(p) ** 2).sum())

    starts = []
    width = GLARE_FIT.start_width
    for angle in np.arange(GLARE_FIT.directions) * (2 * math.pi / GLARE_FIT.directions):
        start = np.array([math.cos(angle), math.sin(angle), width, 0, 0, 0])
        near = ((measured - start[:2]) ** 2).sum(-1) < width**2
        if near.any():
            start[3:] = np.maximum(np.median(extra[near], 0) / scale, 0)
            starts.append(start)
    if not starts:
        return photo
    least, most = GLARE_FIT.widths
    reach = GLARE_FIT.farthest
    bounds = [-reach, -reach, least, 0, 0, 0], [reach, reach, most, np.inf, np.inf, np.inf]
    start = min(starts, key=cost)
    p = optimize.least_squares(
        residuals, start, bounds=bounds, loss="cauchy", ftol=GLARE_FIT.precision
    ).x
    strength = glare(p, inside).sum(-1)
    # Glare that would be stronger over the sky than anywhere it was measured is not believed.
    if not cost(p) < GLARE_FIT.cost_ratio * cost(p * [1, 1, 1, 0, 0, 0]) or (
        strength[image.sky].max(initial=0) > strength[use].max()
    ):
        return photo
    result = photo.image.copy()
    clean = np.maximum(result[area] - glare(p, inside) * scale, 0)
    result[area] = np.where(shown.clipped[..., None], result[area], clean)
    return replace(photo, image=result)
