"""A lamp that is near: how far, by the table's shading.

The ball shows a lamp's direction, not its distance. But the table below a near lamp is brighter
than elsewhere, as cos θ / r² has it. Where the logarithms of the table's radiance some blocks apart
say so, the lamp has a place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.capture.mirror import Ball
from invrender.capture.robust import spread
from invrender.capture.settings import NEAR_LAMP, TABLE_METER
from invrender.capture.table import distant_pairs, table_blocks
from invrender.files.images import Photo
from invrender.lights import NearLamp
from invrender.rig import Rig
from invrender.sampling import parabola_top
from invrender.sphere import sky_flux
from invrender.types import TINY, Array, Mask

Indices = NDArray[np.intp]


def find_near_lamp(photo: Photo, rig: Rig, ball: Ball, environment: Array) -> NearLamp | None:
    """The brightest lamp in the environment (H, 2H, 3), if the table says that it is near."""
    lamp = brightest_lamp(environment)
    if lamp is None:
        return None
    seen, points, use = table_blocks(photo, rig, ball)
    pairs = [pair for pair, _ in distant_pairs(use)]
    if not pairs:
        return None
    d, flux = sky_flux(environment)
    own = lamp[: len(lamp) // 2].ravel()
    light, room = flux[own].sum(0), flux[~own].sum(0)
    towards = flux[own].mean(-1) @ d[own]
    towards /= np.linalg.norm(towards)
    log, at = np.log(seen[use]), points[use] - np.asarray(ball.position)

    def left(nearness: float) -> float:
        """What the table's shading leaves unexplained, the median lag's spread."""
        to = towards - nearness * at
        ratio = to[:, 2] / np.linalg.norm(to, axis=-1) ** 3 / towards[2]
        albedo = (log - np.log(np.maximum(room + light * ratio[:, None], TINY))).mean(-1)
        return float(np.median([spread(albedo[i] - albedo[j]) for i, j in pairs]))

    nearest = 1 / (NEAR_LAMP.nearest * rig.sample_size)
    tried = np.linspace(0, nearest, NEAR_LAMP.steps)
    errors = np.array([left(n) for n in tried])
    best = int(np.argmin(errors))
    least = max(errors[best], TABLE_METER.least_spread)
    if not best or least > NEAR_LAMP.ratio * errors[0]:
        return None
    distance = 1 / (tried[best] + parabola_top(-errors, best) * tried[1])
    x, y, z = (np.asarray(ball.position) + distance * towards).tolist()
    return NearLamp((x, y, z), ball.position, lamp.astype(np.float32))


def brightest_lamp(environment: Array) -> Mask | None:
    """The texels (H, 2H) of the lamp that lights most: brighter than the room by far, next to each
    other, and not much of the sky. None where no lamp gives a good part of the light."""
    height, width = environment.shape[:2]
    d, flux = sky_flux(environment)
    d, flux = d.reshape(height // 2, width, 3), flux.mean(-1).reshape(height // 2, width)
    level = environment[: height // 2].mean(-1)
    best, most = None, NEAR_LAMP.share * float(flux.sum())
    for part in connected(level > NEAR_LAMP.bright * np.median(level)):
        own = np.zeros_like(flux, bool)
        own.flat[part] = True
        total = float(flux[own].sum())
        if total <= most:
            continue
        middle = flux[own] @ d[own]
        middle /= np.linalg.norm(middle)
        off = 1 - d[own] @ middle
        if float(flux[own] @ off) / total < 1 - np.cos(np.radians(NEAR_LAMP.widest)):
            best, most = own, total
    if best is None:
        return None
    return np.concatenate([best, np.zeros_like(best)])


def connected(mask: Mask) -> list[Indices]:
    """The parts of a mask (h, W) of an environment whose texels touch each other, also where it
    begins and ends: flat indices, the largest part first."""
    width = mask.shape[1]
    label, count = ndimage.label(np.tile(mask, 2), np.ones((3, 3)))  # twice around
    row, column = np.nonzero(label)
    number, at = label[row, column], row * width + column % width
    order = np.argsort(number, kind="stable")
    ends = np.cumsum(np.bincount(number, minlength=count + 1)[1:])
    parts = [np.unique(part) for part in np.split(at[order], ends[:-1])] if count else []
    taken = np.zeros(mask.size, bool)
    found: list[Indices] = []
    for part in sorted(parts, key=len, reverse=True):
        if not taken[part[0]]:  # else it is a copy, or what the end cuts off
            taken[part] = True
            found.append(part)
    return found
