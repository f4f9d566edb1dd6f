"""Lamps that a photo clips, made as bright as the table around the sample says they are.

A clipped pixel tells only that there was at least so much light. But room and screen light the
table as well, and the screen's share of that, whose radiance the ball shows, has a shape and
colours of its own: the brighter the room, the flatter and less coloured the table's shading.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from invrender.environments import resample_environment
from invrender.images import Photo
from invrender.mirror import Ball
from invrender.pattern import resize_pattern
from invrender.rig import Rig
from invrender.unfold import (
    Mask,
    fill_environment,
    room_irradiance,
    unfold_environment,
    window,
)

Array = NDArray[np.floating[Any]]
BLOCKS = 64  # across the photo; the table is compared as the means of these
SIDE = 32  # pixels of a block that count, a side, at most about
CELLS, ROWS = 16, 32  # of the screen, a side, and of the environment that is not clipped
LAGS = (8, 16, 32)  # blocks between those that are compared
# Logarithm of how many times brighter than the clipping level what is clipped is: mean, standard
# deviation, and that of the channels about their mean.
EXCESS, SPREAD, COLOUR = 0.5, 1.0, 0.25
BRIGHTEST = 6.0  # the greatest such logarithm
# Standard deviation of the logarithm from block to block, at least: the rounding to 8 bits, too.
ROUGH = 0.02
MIN_PAIRS = 50
# Axes of a residual in log RGB: what all channels share, and two of its colour.
AXES = np.array([[1, 1, 1], [1, -1, 0], [1, 1, -2]]).T / np.sqrt([3, 2, 6])


def clipped_share(photo: Photo, rig: Rig, ball: Ball, height: int) -> Array:
    """(H, 2H, 3): the share of each texel of the environment whose channel is clipped."""
    area = window(ball)
    if photo.clip_level is None or photo.image[area].max() < photo.clip_level:
        return np.zeros((height, 2 * height, 3), np.float32)
    full = np.zeros(photo.image.shape, np.float32)
    full[area] = photo.image[area] >= photo.clip_level
    share, _ = unfold_environment(Photo(full), rig, ball, height)
    return np.asarray(share * np.asarray(rig.ball_reflectance), np.float32)


def raise_clipped(
    photo: Photo, rig: Rig, ball: Ball, pattern: Array, gain: Array, environment: Array,
    coverage: Array,
) -> tuple[Array, float]:  # fmt: skip
    """The environment (H, 2H, 3) with its clipped texels raised; and how many times, the mean.

    The screen's radiance is pattern (h, w, 3) times gain (3,). One factor per channel is found for
    all clipped texels, the most probable one under a log-normal prior and a Lambertian table: the
    logarithms of its radiance some way apart are compared, robustly (Cauchy), since textures,
    papers and shadows have edges, and colour apart from brightness, which varies more. That the
    screen shades the table from the clipped lamps counts too. 1 where nothing is clipped.
    """
    share = clipped_share(photo, rig, ball, len(environment))
    if not share.any():
        return environment, 1.0
    assert photo.clip_level is not None
    extra = np.asarray(share * photo.clip_level / np.asarray(rig.ball_reflectance), np.float32)
    filled = fill_environment(environment, coverage)
    seen, at, use, known = lit_table(photo, rig, ball, pattern, gain, filled)
    factor = np.exp(_excess(seen, use, known, room_irradiance(rig, at, extra)))
    raised = environment + extra * (factor - 1).astype(np.float32)
    return np.asarray(raised, np.float32), float(factor.mean())


def lit_table(
    photo: Photo, rig: Rig, ball: Ball, pattern: Array, gain: Array, environment: Array
) -> tuple[Array, Array, Mask, Array]:
    """The blocks that show the table: log radiance (n, 3), points (n, 3), which those are (h, w),
    and their irradiance (n, 3) from the screen and the filled environment."""
    seen, points, use = table_blocks(photo, rig, ball)
    at = points[use]
    cells = resize_pattern(pattern, CELLS) * gain
    screen = np.einsum("nij,ijc->nc", rig.screen_cosines(at, CELLS), cells)
    room = room_irradiance(rig, at, resample_environment(environment, ROWS))
    return np.log(seen[use]), at, use, screen + room


def table_blocks(photo: Photo, rig: Rig, ball: Ball) -> tuple[Array, Array, Mask]:
    """The photo's blocks: mean radiance (h, w, 3), point of the table (h, w, 3), and which show it.

    Sample, ball, its contact shadow and saturated blocks do not count.
    """
    step = max(1, photo.width // (BLOCKS * SIDE))
    k = max(1, photo.width // (BLOCKS * step))
    h, w = photo.height // (k * step), photo.width // (k * step)

    def cut(a: Any) -> Any:
        a = a[step // 2 :: step, step // 2 :: step][: h * k, : w * k]
        return a.reshape(h, k, w, k, *a.shape[2:])

    mean = cut(photo.image).mean((1, 3))
    block = k * step
    centre = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1) * block
    ray = rig.rays(centre, photo.height, photo.width)
    down = ray[..., 2] < -0.2
    points = rig.camera - ray * (rig.camera[2] / np.where(down, ray[..., 2], -1))[..., None]
    block = block / rig.focal(photo.width) * rig.camera[2]
    sample = (np.abs(points[..., :2]) < rig.sample_size / 2 + 1.5 * block).all(-1)
    distance = np.linalg.norm(points - np.asarray(ball.position), axis=-1)
    use = down & ~sample & (distance > 3 * ball.radius_m + block)
    use &= ~cut(photo.clipped).any((1, 3)) & (mean.min(-1) > 0)
    return mean, points, use


def distant_pairs(use: Mask) -> list[tuple[tuple[Any, Any], int]]:
    """Pairs of used blocks, as indices among these, each of `LAGS` apart down and across: those of
    one lag and way, and the lag. Too few pairs do not count."""
    index = np.full(use.shape, -1)
    index[use] = np.arange(use.sum())
    pairs = []
    for lag in LAGS:
        for first, second in ((index[lag:], index[:-lag]), (index[:, lag:], index[:, :-lag])):
            both = (first >= 0) & (second >= 0)
            if both.sum() >= MIN_PAIRS:
                pairs.append(((first[both], second[both]), lag))
    return pairs


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
        return [w - s for w, s in zip(wanted, steps(np.log(np.maximum(light, 1e-12))), strict=True)]

    def residuals(x: Array, scales: list[Array]) -> Array:
        parts = [np.array([(x.mean() - EXCESS) / SPREAD]), (x - x.mean()) / COLOUR]
        for error, scale, weight in zip(off(x), scales, weights, strict=True):
            z = error / scale
            parts.append((weight * np.sign(z) * np.sqrt(np.log1p(z * z))).ravel())
        return np.concatenate(parts)

    x = np.full(3, EXCESS)
    for turn in range(3):
        scales = [np.maximum(1.48 * np.median(np.abs(e), 0), ROUGH) for e in off(x)]
        if turn == 0:  # the Cauchy loss has more than one minimum
            starts = [np.full(3, s) for s in np.linspace(0.05, 4, 10)]
            x = min(starts, key=lambda s: float((residuals(s, scales) ** 2).sum()))
        bounds = (0, BRIGHTEST)
        x = optimize.least_squares(residuals, np.clip(x, 1e-6, BRIGHTEST - 1e-6), "3-point",
                                   bounds, args=(scales,)).x  # fmt: skip
    return np.asarray(x)
