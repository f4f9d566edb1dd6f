"""Lamps that a photo clips, made as bright as the table around the sample says they are.

A clipped pixel says only that there was at least so much light. But room and screen light the
table as well, and the screen's share of that, whose radiance the ball shows, has a shape and
colours of its own: the brighter the room, the flatter and less coloured the table's shading.
"""

from __future__ import annotations

import numpy as np
from scipy import optimize

from invrender.capture.ball_image import BallImage
from invrender.capture.environment import fill_environment, unfold_environment
from invrender.capture.robust import cauchy_residuals, spread
from invrender.capture.settings import CLIPPED_LAMPS, TABLE_METER
from invrender.capture.table import distant_pairs, lit_table, room_irradiance
from invrender.colour import AXES
from invrender.device import Device
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.types import TINY, Array, Mask


def clipped_share(photo: Photo, rig: Rig, image: BallImage, height: int) -> Array:
    """(H, 2H, 3): the share of each texel of the environment whose channel is clipped."""
    area = image.area
    if photo.clip_level is None or photo.image[area].max() < photo.clip_level:
        return np.zeros((height, 2 * height, 3), np.float32)
    full = np.zeros(photo.image.shape, np.float32)
    full[area] = photo.image[area] >= photo.clip_level
    share, _ = unfold_environment(Photo(full), rig, image, height)
    return np.asarray(share * np.asarray(rig.ball_reflectance), np.float32)


def raise_clipped(
    photo: Photo, rig: Rig, image: BallImage, screen: tuple[Array, Array, Device],
    environment: Array, coverage: Array,
) -> tuple[Array, float]:  # fmt: skip
    """The environment (H, 2H, 3) with its clipped texels raised; and how many times, the mean.

    The screen: pattern (h, w, 3), gain (3,) and display. One factor per channel is found for
    all clipped texels, the most probable one under a log-normal prior and a Lambertian table: the
    logarithms of its radiance some way apart are compared, robustly (Cauchy), since textures,
    papers and shadows have edges, and colour apart from brightness, which varies more. That the
    screen shades the table from the clipped lamps counts too. 1 where nothing is clipped.
    """
    share = clipped_share(photo, rig, image, len(environment))
    if not share.any():
        return environment, 1.0
    assert photo.clip_level is not None
    extra = np.asarray(share * photo.clip_level / np.asarray(rig.ball_reflectance), np.float32)
    filled = fill_environment(environment, coverage)
    seen, at, use, known = lit_table(photo, rig, image.ball, screen, filled)
    factor = np.exp(_excess(seen, use, known, room_irradiance(rig, at, extra)))
    raised = environment + extra * (factor - 1).astype(np.float32)
    return np.asarray(raised, np.float32), float(factor.mean())


def _excess(seen: Array, use: Mask, known: Array, extra: Array) -> Array:
    """Logarithms (3,) of the clipped light's factor.

    ``seen``: log radiance of the used blocks (n, 3); irradiance is known + (factor - 1)·extra.
    """
    apart = distant_pairs(use)
    pairs = [pair for pair, _ in apart]
    # Textures are alike over several blocks: so many pairs count as one.
    weights = [1 / lag for _, lag in apart]

    def steps(log: Array) -> list[Array]:
        return [(log[i] - log[j]) @ AXES for i, j in pairs]

    wanted = steps(seen)

    def off(x: Array) -> list[Array]:
        light = known + np.expm1(x) * extra
        return [w - s for w, s in zip(wanted, steps(np.log(np.maximum(light, TINY))), strict=True)]

    def residuals(x: Array, scales: list[Array]) -> Array:
        brightness = (x.mean() - CLIPPED_LAMPS.mean) / CLIPPED_LAMPS.deviation
        parts = [np.array([brightness]), (x - x.mean()) / CLIPPED_LAMPS.channel_deviation]
        for error, scale, weight in zip(off(x), scales, weights, strict=True):
            parts.append((weight * cauchy_residuals(error / scale)).ravel())
        return np.concatenate(parts)

    x = np.full(3, CLIPPED_LAMPS.mean)
    low, high = CLIPPED_LAMPS.inside, CLIPPED_LAMPS.greatest - CLIPPED_LAMPS.inside
    for turn in range(3):
        scales = [np.maximum(spread(e, 0), TABLE_METER.least_spread) for e in off(x)]
        if turn == 0:  # the Cauchy loss has more than one minimum
            starts = [np.full(3, s) for s in np.linspace(*CLIPPED_LAMPS.starts)]
            x = min(starts, key=lambda s: float((residuals(s, scales) ** 2).sum()))
        bounds = (0, CLIPPED_LAMPS.greatest)
        x = optimize.least_squares(residuals, np.clip(x, low, high), "3-point",
                                   bounds, args=(scales,)).x  # fmt: skip
    return np.asarray(x)
