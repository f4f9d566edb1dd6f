"""The table beside the sample as a light meter: its blocks and their irradiance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from invrender.capture.mirror import Ball
from invrender.capture.settings import TABLE_METER
from invrender.files.images import Photo
from invrender.lights import Device
from invrender.rig import Rig
from invrender.sampling import means_of_blocks, resize_pattern
from invrender.sphere import resample_environment, sky_flux
from invrender.types import Array, Mask

# Log radiance, points, which blocks those are, and irradiance from screen and room.
LitTable = tuple[Array, Array, Mask, Array, Array]


def lit_table(
    photo: Photo, rig: Rig, ball: Ball, screen: tuple[Array, Array, Device], environment: Array
) -> LitTable:
    """The blocks that show the table: log radiance (n, 3), points (n, 3), which those are (h, w),
    and their irradiance (n, 3) from the screen (pattern, gain, display), and from the filled
    environment."""
    seen, points, use = table_blocks(photo, rig, ball)
    at = points[use]
    lit = screen_irradiance(rig, at, screen, TABLE_METER.screen_cells)
    rows = TABLE_METER.environment_rows
    room = room_irradiance(rig, at, resample_environment(environment, rows))
    return np.log(seen[use]), at, use, lit, room


def screen_irradiance(
    rig: Rig, points: Array, screen: tuple[Array, Any, Device], cells: int
) -> Array:
    """Irradiance (n, 3) by the screen (pattern, gain, display) of ``points`` (n, 3) that face up,
    from ``cells`` × ``cells`` parts of it."""
    pattern, gain, device = screen
    light = resize_pattern(device.shown(pattern), cells) * gain
    return np.einsum("nij,ijc->nc", rig.screen_cosines(points, cells, device.falloff), light)


def table_blocks(photo: Photo, rig: Rig, ball: Ball) -> tuple[Array, Array, Mask]:
    """The photo's blocks: mean radiance (h, w, 3), point of the table (h, w, 3), and which show it.

    Sample, ball, its contact shadow and saturated blocks do not count.
    """
    blocks = TABLE_METER.blocks
    step = max(1, photo.width // (blocks * TABLE_METER.block_pixels))
    k = max(1, photo.width // (blocks * step))
    h, w = photo.height // (k * step), photo.width // (k * step)

    some = photo.image[step // 2 :: step, step // 2 :: step][: h * k, : w * k]
    mean = means_of_blocks(some, k)
    clipped = replace(photo, image=some).clipped.reshape(h, k, w, k).any((1, 3))
    block = k * step
    centre = np.stack(np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5), -1) * block
    points, down = points_seen(rig, centre, photo.height, photo.width)
    block = block / rig.focal(photo.width) * rig.camera[2]
    margin = TABLE_METER.sample_margin * block
    sample = (np.abs(points[..., :2]) < rig.sample_size / 2 + margin).all(-1)
    distance = np.linalg.norm(points - np.asarray(ball.position), axis=-1)
    use = down & ~sample & (distance > TABLE_METER.ball_margin * ball.radius_m + block)
    use &= ~clipped & (mean.min(-1) > 0)
    return mean, points, use


def points_seen(rig: Rig, pixels: Array, height: int, width: int) -> tuple[Array, Mask]:
    """The table's points (..., 3) that pixels (..., 2) of a photo of that size see, and which of
    them look down at it."""
    ray = rig.rays(pixels, height, width)
    down = ray[..., 2] < -TABLE_METER.downward
    return rig.camera - ray * (rig.camera[2] / np.where(down, ray[..., 2], -1))[..., None], down


def distant_pairs(use: Mask) -> list[tuple[tuple[Any, Any], int]]:
    """Pairs of used blocks, as indices among these, each of `TABLE_METER.lags` apart down and
    across: those of one lag and way, and the lag. Too few pairs do not count."""
    index = np.full(use.shape, -1)
    index[use] = np.arange(use.sum())
    pairs = []
    for lag in TABLE_METER.lags:
        for first, second in ((index[lag:], index[:-lag]), (index[:, lag:], index[:, :-lag])):
            both = (first >= 0) & (second >= 0)
            if both.sum() >= TABLE_METER.least_pairs:
                pairs.append(((first[both], second[both]), lag))
    return pairs


def hidden_by_screen(rig: Rig, points: Array, direction: Array) -> Mask:
    """Whether the screen, or its bezel, hides each of the directions (m, 3) from each of the points
    (n, 3)."""
    if not rig.has_screen:
        return np.zeros((len(points), len(direction)), bool)
    corner, (e_x, e_y) = rig.screen_body
    corners = corner + np.array([0 * e_x, e_x, e_x + e_y, e_y])
    way = corners - np.asarray(points)[:, None]
    # What it hides lies inside all four planes through the point and one of its sides.
    inward = np.cross(way, np.roll(way, -1, axis=1))
    inward *= np.sign(np.einsum("nij,nj->ni", inward, way.mean(1)))[..., None]
    inward, d = inward.astype(np.float32), np.asarray(direction, np.float32).T
    out = np.empty((len(way), d.shape[1]), bool)
    step = max(1, TABLE_METER.at_once // max(4 * d.shape[1], 1))
    for i in range(0, len(out), step):
        out[i : i + step] = (inward[i : i + step] @ d).min(1) > 0
    return out


def room_irradiance(rig: Rig, points: Array, environment: Array) -> Array:
    """Irradiance (n, 3) of upward faces at points (n, 3) from the room (H, 2H, 3) that the screen
    does not hide from them."""
    d, flux = sky_flux(environment)
    lit = np.flatnonzero(flux.any(-1))
    out = np.empty((len(points), 3))
    for band, seen in seen_past_screen(rig, points, d[lit]):
        out[band] = seen @ flux[lit]
    return out


def seen_past_screen(rig: Rig, points: Array, direction: Array) -> Iterator[tuple[slice, Mask]]:
    """Which directions (m, 3) the screen does not hide from points (n, 3), some points at once."""
    step = max(1, TABLE_METER.at_once // max(len(direction), 1))
    for i in range(0, len(points), step):
        band = slice(i, i + step)
        yield band, ~hidden_by_screen(rig, points[band], direction)
