"""Photographs of a capture sheet on a table, by looking every pixel's ray up in its picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import ndimage

from invrender.capture.sheet_layout import Sheet, capture_sheet, draw_sheet
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.sampling import resize_pattern

RESOLUTION = 6000  # pixels a metre of the sheet's picture


def irradiance(rig: Rig, points: Any, gain: Any, room: Any) -> Any:
    """Irradiance (..., 3) on the table from the default pattern and an even room."""
    pattern = resize_pattern(default_pattern(), 24) * np.asarray(gain)
    cosines = rig.screen_cosines(points, 24)
    return np.einsum("...ij,ijc->...c", cosines, pattern) + np.asarray(room)


def lit(rig: Rig, gain: Any, room: Any, extent: float = 0.6) -> Any:
    """The same as a quick look-up: a function of points (..., 3)."""
    grid = np.linspace(-extent, extent, 97)
    points = np.stack([*np.meshgrid(grid, grid), np.zeros((97, 97))], -1)
    table = irradiance(rig, points, gain, room)

    def look_up(points: Any) -> Any:
        at = (np.clip(points[..., 1::-1], -extent, extent) + extent) / (2 * extent) * 96
        at = np.moveaxis(at, -1, 0)
        return np.stack([ndimage.map_coordinates(table[..., c], at, order=1) for c in range(3)], -1)

    return look_up


def paper_reflectance(sheet: Sheet, points: Any, table: float = 0.25, sample: float = 0.4) -> Any:
    """Reflectance (...,) of the table with the sheet on it and a plain sample in its window."""
    picture = draw_sheet(sheet, RESOLUTION)
    x0, y0, x1, y1 = sheet.page
    x, y = points[..., 0], points[..., 1]
    rows, columns = picture.shape
    at = np.stack([(y1 - y) / (y1 - y0) * rows - 0.5, (x - x0) / (x1 - x0) * columns - 0.5])
    seen = ndimage.map_coordinates(picture, at, order=1, mode="nearest")
    page = (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    window = np.maximum(abs(x), abs(y)) < sheet.window / 2
    return np.where(window, sample, np.where(page, seen, table))


def sheet_photo(
    rig: Rig,
    height: int,
    width: int,
    *,
    sheet: Sheet | None = None,
    gain: Any = (2.0, 2.1, 1.9),
    room: Any = 0.3,
    k1: float = 0.0,
    centre: tuple[float, float] = (0.0, 0.0),
    samples: int = 2,
    blur: float = 0.0,
    vignetting: float = 0.0,
    noise: float = 0.0,
    lies: int = 0,
    seed: int = 0,
) -> Any:
    """Linear photo (H, W, 3). k1: radial distortion; centre: the principal point from the middle,
    in widths; blur: in pixels; vignetting: loss in the corners; noise: of a pixel at the mean
    (shot); lies: quarters by which the sheet is turned counter-clockwise."""
    sheet = capture_sheet(rig) if sheet is None else sheet
    focal = rig.focal(width)
    ys = (np.arange(height * samples) + 0.5) / samples - height / 2 - centre[1] * width
    xs = (np.arange(width * samples) + 0.5) / samples - width / 2 - centre[0] * width
    d = np.stack(np.broadcast_arrays(xs[None] / focal, ys[:, None] / focal), -1)
    q = d.copy()
    for _ in range(20):  # undo d = q·(1 + k1·|q|²)
        q = d / (1 + k1 * (q * q).sum(-1, keepdims=True))
    ray = np.concatenate([q * [1, -1], -np.ones((*q.shape[:-1], 1))], -1) @ rig.camera_axes
    points = rig.camera - ray * (rig.camera[2] / ray[..., 2:])
    place = points.copy()
    for _ in range(lies):
        place[..., 0], place[..., 1] = place[..., 1].copy(), -place[..., 0].copy()
    seen = paper_reflectance(sheet, place).reshape(height, samples, width, samples).mean((1, 3))
    points = points[samples // 2 :: samples, samples // 2 :: samples]
    image = seen[..., None] / math.pi * lit(rig, gain, room)(points)
    if blur:
        image = ndimage.gaussian_filter(image, (blur, blur, 0))
    edge = (d[samples // 2 :: samples, samples // 2 :: samples] ** 2).sum(-1)
    image = image * (1 - vignetting * edge / edge.max())[..., None]
    if noise:
        rng = np.random.default_rng(seed)
        sigma = noise * np.sqrt(np.maximum(image, 0) * image.mean())
        image = image + sigma * rng.standard_normal(image.shape)
    return np.maximum(image, 0).astype(np.float32)
