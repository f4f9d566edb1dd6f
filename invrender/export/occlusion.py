"""Ambient occlusion of a height map: the share of an even sky's light that reaches each point.

With h(φ) the elevation of the horizon in the direction φ, the sky above it gives cos² h of the
light of the whole sky, weighed by the cosine to the mean plane's normal; occlusion is its mean
over φ [Bavoil, Sainz and Dimitrov 2008, "Image-space horizon-based ambient occlusion"].
"""

from __future__ import annotations

import numpy as np

from invrender.types import Array

AZIMUTHS = 8
GROWTH = 1.5  # between the distances at which the horizon is looked for, from one pixel on
FARTHEST_OCCLUDER = 0.125  # of the shorter side


def ambient_occlusion(height: Array, pixel: float) -> Array:
    """(H, W) in [0, 1], 1 where the sky is free, of heights (H, W) and pixels in metres.

    Heights go on beyond the border as they are at it.
    """
    rows, columns = height.shape
    reach = max(1, int(FARTHEST_OCCLUDER * min(rows, columns)))
    padded = np.pad(np.asarray(height, np.float32) / np.float32(pixel), reach, mode="edge")
    here = padded[reach : reach + rows, reach : reach + columns]
    distances = [1.0]
    while distances[-1] * GROWTH <= reach:
        distances.append(distances[-1] * GROWTH)
    total = np.zeros_like(here)
    for angle in 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS:
        steepest = np.zeros_like(here)  # tangent of the horizon's elevation
        for distance in distances:
            x, y = round(distance * np.cos(angle)), round(distance * np.sin(angle))
            there = padded[reach + y : reach + y + rows, reach + x : reach + x + columns]
            np.maximum(steepest, (there - here) / np.float32(np.hypot(x, y)), out=steepest)
        total += 1 / (1 + steepest * steepest)
    return total / AZIMUTHS
