"""Procedural bricks, tiles, stones, concrete and what else is mineral."""

from __future__ import annotations

import numpy as np

from invrender.data.materials.layers import (
    Layers,
    bumps,
    chance,
    colour,
    dye,
    earth,
    grey,
    log_uniform,
    uniform,
    varied,
)
from invrender.data.materials.noise import Array, Canvas, Points, noise, warped
from invrender.data.materials.patterns import Cells, mixed, ramp, smoothstep, voronoi
from invrender.data.materials.patterns import bricks as brick_cells

Rng = np.random.Generator


def _maybe_turned(canvas: Canvas, rng: Rng, probability: float = 0.3) -> Points:
    angle = rng.random() * np.pi if chance(rng, probability) else rng.integers(4) * np.pi / 2
    return canvas.turned(float(angle))


def _tilted(cells: Cells, rng: Rng, slope: float) -> Array:
    """A plane of its own for each cell: heights with slopes of about that size."""
    planes = (cells.values(rng, 3) - np.float32(0.5)) * np.float32(2 * slope)
    size = np.float32(0.1)
    return planes[..., 0] * cells.x + planes[..., 1] * cells.y + planes[..., 2] * size


def _speckled(canvas: Canvas, rng: Rng, base: Array, spread: float = 0.25) -> Array:
    """A colour with soft stains and fine grain of relatives, (H, W, 3)."""
    coarse = noise(canvas, rng, log_uniform(rng, 2, 8), 5, 0.6)
    fine = noise(canvas, rng, log_uniform(rng, 30, 90), 2, 0.7)
    grain = np.exp(np.float32(spread * 0.45) * fine)[..., None]
    return mixed(base, varied(rng, base, 2 * spread), smoothstep(-1.5, 1.5, coarse)) * grain


def bricks(canvas: Canvas, rng: Rng) -> Layers:
    """Fired bricks in mortar."""
    height = 1 / uniform(rng, 3, 11)
    width = height * uniform(rng, 1.8, 3.6)
    points = _maybe_turned(canvas, rng, 0.2)
    points = warped(canvas, rng, uniform(rng, 4, 10), height * uniform(rng, 0.005, 0.04), points)
    shift = float(rng.choice([0.5, 0.5, 0.33, 0.25]))
    cells = brick_cells(rng, points, width, height, shift, height * uniform(rng, 0.02, 0.2))
    mortar = height * uniform(rng, 0.04, 0.12)
    chips = noise(canvas, rng, 3 / height, 4, 0.6) * np.float32(mortar * uniform(rng, 0.05, 0.5))
    inside = cells.inside + chips
    bevel = height * log_uniform(rng, 0.03, 0.15)
    body = smoothstep(mortar, mortar + bevel, inside)
    face = smoothstep(mortar * 0.8, mortar * 1.1, inside)
    base = earth(rng, (0.08, 0.4))
    tone = np.exp(uniform(rng, 0.1, 0.6) * (cells.values(rng) - np.float32(0.5)))
    hues = ramp(cells.values(rng), np.stack([base, varied(rng, base, 0.5), varied(rng, base, 0.5)]))
    brick = _speckled(canvas, rng, np.ones(3, np.float32) * 0.9) * hues * tone[..., None]
    joint = _speckled(canvas, rng, grey(rng, (0.1, 0.55)) * np.array([1, 0.96, 0.9], np.float32))
    surface = bumps(canvas, rng, 12, uniform(rng, 0.05, 0.4), 5, 0.55)
    rough = uniform(rng, 0.45, 0.85) if not chance(rng, 0.15) else uniform(rng, 0.12, 0.35)
    rough_face = (
        np.float32(rough)
        + 0.04 * noise(canvas, rng, 20, 3)
        + 0.1 * (cells.values(rng) - np.float32(0.5))
    )
    return Layers(
        mixed(joint, brick, face),
        body * np.float32(bevel) + _tilted(cells, rng, 0.05) * body + surface * (0.4 + 0.6 * body),
        mixed(uniform(rng, 0.7, 0.95), rough_face, face),
        relief=(10, 55),
    )


def tiles(canvas: Canvas, rng: Rng) -> Layers:
    """Glazed, matt or stone tiles with grout: squares, oblongs or honeycombs."""
    size = 1 / uniform(rng, 1.5, 9)
    points = _maybe_turned(canvas, rng)
    if chance(rng, 0.25):
        cells = voronoi(canvas, rng, 1 / size, 0.0, True, points)
    else:
        oblong = float(rng.choice([1, 1, 1, 2, 3]))
        shift = float(rng.choice([0, 0.5])) if oblong > 1 else 0.0
        corner = size * (0.0 if chance(rng, 0.5) else uniform(rng, 0.02, 0.15))
        cells = brick_cells(rng, points, size * oblong, size, shift, corner)
    joint = size * log_uniform(rng, 0.012, 0.06)
    bevel = size * log_uniform(rng, 0.01, 0.1)
    body = smoothstep(joint, joint + bevel, cells.inside)
    face = smoothstep(joint * 0.9, joint + bevel * 0.25, cells.inside)
    base = dye(rng, (0.05, 0.8))
    number = cells.values(rng)
    if chance(rng, 0.35):
        other = dye(rng, (0.02, 0.8))
        glaze = mixed(base, other, (number > uniform(rng, 0.3, 0.8)).astype(np.float32))
    else:
        glaze = mixed(base, varied(rng, base, 0.3), number)
    if chance(rng, 0.5):
        glaze = glaze * _speckled(canvas, rng, np.full(3, 0.9, np.float32), 0.15)
    if chance(rng, 0.25):  # marbled tiles, the pattern broken from tile to tile
        shifted = canvas.u + number * 7, canvas.v + cells.values(rng) * 5
        vein = smoothstep(0.55, 1.25, noise(canvas, rng, 4, 5, 0.6, True, shifted))
        glaze = mixed(glaze, varied(rng, base, 1.2), vein * np.float32(0.8))
    smooth = log_uniform(rng, 0.05, 0.5)
    rough = np.float32(smooth) * (1 + 0.15 * noise(canvas, rng, 5, 4)) + np.float32(0.05) * (
        cells.values(rng)
    )
    wavy = bumps(canvas, rng, 1.5 / size, log_uniform(rng, 0.003, 0.06), 2)
    grout = _speckled(canvas, rng, grey(rng, (0.03, 0.6)))
    return Layers(
        mixed(grout, glaze, face),
        body * np.float32(bevel)
        + (wavy + _tilted(cells, rng, log_uniform(rng, 0.002, 0.03))) * body
        + bumps(canvas, rng, 50, 0.1, 2) * (1 - face),
        mixed(uniform(rng, 0.6, 0.95), rough, face),
        relief=(5, 45),
    )


def stone(canvas: Canvas, rng: Rng) -> Layers:
    """Rough or cut rock."""
    f = log_uniform(rng, 1.5, 6)
    points = warped(canvas, rng, f, 0.3 / f)
    ridges = bumps(canvas, rng, f, 0.4, 6, uniform(rng, 0.45, 0.62), chance(rng, 0.5), points)
    height: Array = ridges + bumps(canvas, rng, 6 * f, uniform(rng, 0.05, 0.3), 4)
    if chance(rng, 0.4):  # layers
        step = uniform(rng, 0.05, 0.2)
        level = height / np.float32(step) * f * 3
        height = mixed(
            height,
            (np.floor(level) + smoothstep(0.6, 1, level - np.floor(level)))
            * np.float32(step / f / 3),
            np.full_like(height, 0.6),
        )
    low = smoothstep(-1.8, 1.2, height / max(float(height.std()), 1e-6))
    base = earth(rng, (0.03, 0.45))
    rock = _speckled(canvas, rng, base, uniform(rng, 0.1, 0.4)) * (0.5 + 0.6 * low)[..., None]
    if chance(rng, 0.3):  # moss or sand in the hollows
        growth = smoothstep(0.55, 0.35, low + 0.1 * noise(canvas, rng, 8, 4))
        rock = mixed(
            rock,
            varied(
                rng,
                earth(rng)
                if chance(rng, 0.5)
                else colour(rng, (0.17, 0.28), (0.5, 0.8), (0.03, 0.2)),
            ),
            growth,
        )
    rough = uniform(rng, 0.45, 0.9) + 0.06 * noise(canvas, rng, 4 * f, 4)
    return Layers(rock, height, rough + uniform(rng, -0.2, 0.1) * low, relief=(12, 60))


def pavement(canvas: Canvas, rng: Rng) -> Layers:
    """Cobbles, crazy paving, gravel: stones of all sizes in sand."""
    f = log_uniform(rng, 3, 22)
    points = warped(canvas, rng, 2 * f, 0.05 / f)
    cells = voronoi(canvas, rng, f, uniform(rng, 0.5, 1), at=points)
    gap = uniform(rng, 0.02, 0.1) / f
    width = uniform(rng, 0.1, 0.45) / f
    dome = smoothstep(gap, gap + width, cells.inside + bumps(canvas, rng, 5 * f, 0.1, 3))
    face = smoothstep(gap * 0.8, gap * 1.3, cells.inside)
    base = earth(rng, (0.06, 0.45))
    colours = np.stack([varied(rng, base, 0.6) for _ in range(4)])
    stones = ramp(cells.values(rng), colours) * _speckled(
        canvas, rng, np.full(3, 0.9, np.float32), 0.3
    )
    sand = _speckled(canvas, rng, varied(rng, base, 0.6) * np.float32(0.6))
    level = (cells.values(rng) - np.float32(0.5)) * np.float32(0.3 * width)
    rough = uniform(rng, 0.4, 0.8) + 0.15 * (cells.values(rng) - 0.5)
    return Layers(
        mixed(sand, stones, face),
        (
            dome * np.float32(width)
            + level * dome
            + _tilted(cells, rng, 0.15) * dome
            + bumps(canvas, rng, 4 * f, 0.15, 4)
        ),
        mixed(uniform(rng, 0.75, 1), rough + 0.05 * noise(canvas, rng, 30, 3), face),
        relief=(15, 55),
    )


def concrete(canvas: Canvas, rng: Rng) -> Layers:
    """Cast concrete or asphalt, with pores, stains and perhaps a crack."""
    dark = chance(rng, 0.3)
    base = grey(rng, (0.02, 0.12) if dark else (0.15, 0.5)) * np.array([1, 0.97, 0.92], np.float32)
    tone = _speckled(canvas, rng, base, uniform(rng, 0.1, 0.35))
    height = bumps(canvas, rng, 6, 0.03, 4) + bumps(canvas, rng, 40, uniform(rng, 0.02, 0.25), 2)
    rough = uniform(rng, 0.5, 0.9) + 0.08 * noise(canvas, rng, 3, 5)
    f = log_uniform(rng, 8, 30)
    pores = voronoi(canvas, rng, f)
    size = pores.values(rng) ** 3 * np.float32(0.35 / f)
    hole = smoothstep(1, 0.6, np.hypot(pores.x, pores.y) / np.maximum(size, np.float32(1e-4)))
    hole = hole * (size > canvas.pixel * 0.7)
    height = height - hole * size
    tone = tone * (1 - 0.5 * hole)[..., None]
    if dark:  # chippings show on top
        chips = voronoi(canvas, rng, uniform(rng, 25, 60))
        top = smoothstep(0, 0.3, chips.inside * 40) * (chips.values(rng) > 0.4)
        height = height + top * np.float32(0.006)
        tone = mixed(tone, grey(rng, (0.1, 0.4)), top * chips.values(rng) * np.float32(0.7))
    if chance(rng, 0.35):
        lines = voronoi(canvas, rng, uniform(rng, 0.8, 2), at=warped(canvas, rng, 8, 0.02))
        crack = smoothstep(1, 0, lines.inside / np.float32(log_uniform(rng, 0.002, 0.008)))
        height = height - crack * np.float32(0.01)
        tone = tone * (1 - 0.6 * crack)[..., None]
        rough = rough + 0.1 * crack
    if chance(rng, 0.25):  # wet patches
        wet = smoothstep(-0.3, 0.3, noise(canvas, rng, uniform(rng, 1.5, 4), 5) - 0.5)
        tone, rough = tone * (1 - 0.5 * wet)[..., None], mixed(rough, 0.15, wet)
        height = height * (1 - 0.7 * wet)
    return Layers(tone, height, rough, relief=(3, 35))


def plaster(canvas: Canvas, rng: Rng) -> Layers:
    """Painted or bare plaster, render and stucco, perhaps with dried trowel strokes."""
    base = mixed(dye(rng, (0.3, 0.85)), grey(rng, (0.5, 0.85)), np.array(uniform(rng, 0.3, 1)))
    f = log_uniform(rng, 5, 30)
    if chance(rng, 0.4):
        angle = uniform(rng, 0, np.pi)
        points = warped(canvas, rng, 3, 0.05, canvas.turned(angle))
        height = bumps(canvas, rng, (f, f / uniform(rng, 3, 8)), 0.2, 4, 0.6, at=points)
    else:
        height = (
            np.abs(bumps(canvas, rng, f, 0.3, 3, 0.5))
            if chance(rng, 0.4)
            else bumps(canvas, rng, f, 0.3, 4, uniform(rng, 0.4, 0.65))
        )
    level = height / max(float(height.std()), 1e-6)
    tone = _speckled(canvas, rng, base, 0.08) * np.exp(0.06 * level)[..., None]
    rough = uniform(rng, 0.5, 0.95) + 0.03 * level
    return Layers(tone, height, rough, relief=(3, 35))


def terrazzo(canvas: Canvas, rng: Rng) -> Layers:
    """Polished chips in cement, or a speckled composite."""
    f = log_uniform(rng, 5, 16)
    base = dye(rng, (0.1, 0.8))
    tone, rough = _speckled(canvas, rng, base, 0.1), np.full(canvas.u.shape, 0.0, np.float32)
    for scale in (1.0, 2.3):
        chips = voronoi(canvas, rng, f * scale, at=warped(canvas, rng, 3 * f, 0.03 / f))
        size = (0.05 + 0.25 * chips.values(rng)) / np.float32(f * scale)
        edge = 0.7 * canvas.pixel
        chip = smoothstep(-edge, edge, chips.inside - size) * (chips.values(rng) > 0.25)
        colours = np.stack([varied(rng, dye(rng, (0.03, 0.8)), 0.3) for _ in range(4)])
        tone = mixed(tone, ramp(chips.values(rng), colours), chip)
        rough = np.maximum(rough, chip)
    smooth = log_uniform(rng, 0.07, 0.4)
    return Layers(
        tone,
        -rough * np.float32(1e-4) + bumps(canvas, rng, 3, 0.004, 3),
        smooth * (1.25 - uniform(rng, 0.1, 0.5) * rough) + 0.01 * noise(canvas, rng, 10, 3),
        relief=(0.2, 4),
    )


def marble(canvas: Canvas, rng: Rng) -> Layers:
    """Polished veined stone, or granite."""
    base = earth(rng, (0.02, 0.3)) if chance(rng, 0.5) else grey(rng, (0.01, 0.8))
    if chance(rng, 0.4):  # granite: grains of three minerals
        f = log_uniform(rng, 15, 60)
        grains = voronoi(canvas, rng, f, at=warped(canvas, rng, 2 * f, 0.1 / f))
        colours = np.stack([base, varied(rng, base, 0.8), grey(rng, (0.01, 0.6))])
        tone = ramp(grains.values(rng), colours)
        height = grains.values(rng) * np.float32(1e-4)
        figure = grains.values(rng)
    else:
        f = log_uniform(rng, 1.5, 5)
        points = warped(canvas, rng, f, uniform(rng, 0.1, 0.5) / f)
        cloud = noise(canvas, rng, f, 6, 0.55, at=points)
        figure = smoothstep(0.5, 1.4, noise(canvas, rng, f, 6, 0.55, True, points))
        tone = mixed(base, varied(rng, base, 0.7), smoothstep(-1.5, 1.5, cloud))
        tone = mixed(tone, grey(rng, (0.3, 0.9)) if chance(rng, 0.5) else earth(rng), figure)
        height = bumps(canvas, rng, 3, 0.003, 3) - figure * np.float32(1e-4)
    smooth = log_uniform(rng, 0.05, 0.3)
    return Layers(tone, height, smooth * (1 + uniform(rng, -0.3, 0.8) * figure), relief=(0.2, 2))


def ground(canvas: Canvas, rng: Rng) -> Layers:
    """Soil, sand and leaf litter."""
    f = log_uniform(rng, 2, 8)
    height = bumps(canvas, rng, f, 0.2, 6, 0.6)
    base = earth(rng, (0.05, 0.5))
    tone = _speckled(canvas, rng, base, 0.35)
    rough = uniform(rng, 0.45, 0.95) + 0.05 * noise(canvas, rng, 12, 4)
    for _ in range(int(rng.integers(0, 4))):  # pebbles, crumbs
        g = log_uniform(rng, 8, 35)
        lumps = voronoi(canvas, rng, g, at=warped(canvas, rng, 2 * g, 0.1 / g))
        radius = (0.15 + 0.3 * lumps.values(rng)) / np.float32(g)
        dome = np.sqrt(np.clip(1 - (np.hypot(lumps.x, lumps.y) / radius) ** 2, 0, 1))
        dome = dome * (lumps.values(rng) > uniform(rng, 0.3, 0.8))
        height = np.maximum(height, dome * radius * np.float32(0.5) + 0.3 * height)
        there = smoothstep(0.02, 0.2, dome)
        pebble = mixed(earth(rng, (0.05, 0.6)), earth(rng, (0.05, 0.6)), lumps.values(rng))
        tone = mixed(tone, pebble * np.exp(0.2 * noise(canvas, rng, 60, 2))[..., None], there)
        rough = mixed(rough, uniform(rng, 0.4, 0.8), there)
    return Layers(tone, height, rough, relief=(8, 55))
