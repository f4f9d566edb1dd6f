"""Procedural metals: bare, worked, painted, rusty."""

from __future__ import annotations

import numpy as np

from invrender.data.materials.layers import (
    Layers,
    bumps,
    chance,
    colour,
    dye,
    log_uniform,
    metal,
    uniform,
    varied,
)
from invrender.data.materials.noise import Array, Canvas, noise, warped
from invrender.data.materials.patterns import bricks as brick_cells
from invrender.data.materials.patterns import mixed, scratches, smoothstep, voronoi

Rng = np.random.Generator


def _rust(canvas: Canvas, rng: Rng) -> tuple[Array, Array]:
    """Colour (H, W, 3) and height of rust."""
    n = smoothstep(-1.6, 1.6, noise(canvas, rng, log_uniform(rng, 4, 14), 5, 0.75))
    dark, bright = (
        colour(rng, (0.01, 0.05), (0.5, 0.85), (0.02, 0.1)),
        colour(rng, (0.03, 0.08), (0.65, 0.92), (0.12, 0.42)),
    )
    grain = np.exp(0.15 * noise(canvas, rng, 60, 2, 0.8))
    return mixed(dark, bright, n) * grain[..., None], bumps(canvas, rng, 15, 0.25, 4, 0.6)


def brushed_metal(canvas: Canvas, rng: Rng) -> Layers:
    """Metal brushed along one direction, or turned on a lathe."""
    base = metal(rng)
    if chance(rng, 0.15):
        x0, y0 = rng.uniform(-0.3, 1.3, 2)
        radius = np.hypot(canvas.u - x0, canvas.v - y0).astype(np.float32)
        turn = (np.arctan2(canvas.v - y0, canvas.u - x0) / np.pi).astype(np.float32)
        points = turn, radius
    else:
        angle = float(rng.integers(2)) * np.pi / 2 if chance(rng, 0.6) else uniform(rng, 0, np.pi)
        points = canvas.turned(angle + 0.02 * uniform(rng, -1, 1))
    fine, length = uniform(rng, 50, 110), uniform(rng, 1, 5)
    lines = noise(canvas, rng, (length, fine), 2, 0.8, at=points)
    broad = noise(canvas, rng, (length / 2, fine / 6), 3, at=points)
    rough = log_uniform(rng, 0.12, 0.55)
    tone = np.exp(uniform(rng, 0.01, 0.08) * lines + 0.03 * broad)
    return Layers(
        base * tone[..., None],
        lines / np.float32(fine) * np.float32(0.1) + broad / np.float32(fine) * np.float32(0.1),
        rough * np.exp(uniform(rng, 0.05, 0.25) * (0.6 * lines + 0.6 * broad)),
        1.0,
        relief=(0.4, 9),
    )


def polished_metal(canvas: Canvas, rng: Rng) -> Layers:
    """Nearly a mirror to satin: rolled sheet, chrome, with faint smears."""
    rough = log_uniform(rng, 0.05, 0.45)
    smear = noise(canvas, rng, log_uniform(rng, 1.5, 6), 5, 0.6)
    base = metal(rng)
    return Layers(
        base * np.exp(uniform(rng, 0, 0.05) * smear)[..., None],
        bumps(canvas, rng, log_uniform(rng, 1, 5), 0.02, 3),
        rough * np.exp(uniform(rng, 0.02, 0.35) * smear),
        1.0,
        relief=(0.2, 3),
    )


def hammered_metal(canvas: Canvas, rng: Rng) -> Layers:
    """Dents of a hammer, or crumpled foil, or cast grain."""
    base, rough = metal(rng), log_uniform(rng, 0.08, 0.5)
    f = log_uniform(rng, 4, 20)
    style = rng.random()
    height: Array
    if style < 0.5:
        cells = voronoi(canvas, rng, f, uniform(rng, 0.5, 1), at=warped(canvas, rng, f, 0.06 / f))
        dent = np.hypot(cells.x, cells.y) * np.float32(f)
        height = (dent**2 + 0.3 * cells.values(rng)) / np.float32(f)
        cavity = smoothstep(0.0, 0.12, cells.inside * np.float32(f))
    elif style < 0.75:
        cells = voronoi(canvas, rng, f, at=warped(canvas, rng, f / 2, 0.1 / f))
        planes = cells.values(rng, 2) - np.float32(0.5)
        height = planes[..., 0] * cells.x + planes[..., 1] * cells.y
        height = height + bumps(canvas, rng, f / 2, 0.3, 3, 0.5, True)
        cavity = smoothstep(0.0, 0.1, cells.inside * np.float32(f))
    else:
        height = bumps(canvas, rng, uniform(rng, 20, 60), 0.3, 2)
        cavity = smoothstep(-2, 1, height / max(float(height.std()), 1e-6))
    tone = base * (1 - uniform(rng, 0, 0.5) * (1 - cavity))[..., None]
    return Layers(
        tone, height, rough * (1 + uniform(rng, 0, 0.7) * (1 - cavity)), 1.0, relief=(5, 40)
    )


def perforated_metal(canvas: Canvas, rng: Rng) -> Layers:
    """A sheet with holes or slots, or a raised tread pattern."""
    f = uniform(rng, 4, 18)
    angle = float(rng.choice([0, np.pi / 4, np.pi / 2]))
    points = canvas.turned(angle)
    base = metal(rng)
    rough = log_uniform(rng, 0.1, 0.5) * np.exp(0.15 * noise(canvas, rng, 4, 5))
    if chance(rng, 0.5):
        cells = voronoi(canvas, rng, f, 0.0, chance(rng, 0.6), points)
        radius = uniform(rng, 0.2, 0.38) / f
        distance = np.hypot(cells.x, cells.y)
        hole = smoothstep(radius, radius - 1.2 * canvas.pixel, distance)
        rim = smoothstep(radius * 1.35, radius, distance)
        under = dye(rng, (0.004, 0.05))
        return Layers(
            mixed(base * np.exp(0.03 * noise(canvas, rng, 5, 4))[..., None], under, hole),
            -rim * np.float32(radius * 0.3) * (1 - hole),
            mixed(rough, uniform(rng, 0.6, 0.95), hole),
            1 - hole,
            relief=(3, 45),
        )
    # tread plate: lozenges whose direction alternates
    cells = brick_cells(rng, points, 1 / f, 1 / f)
    odd = (np.floor(cells.number / 7919.0) + cells.number) % 2 == 0
    along, across = np.where(odd, cells.x, cells.y), np.where(odd, cells.y, cells.x)
    shape = np.abs(along) * np.float32(2.4 * f) + np.abs(across) * np.float32(7 * f)
    bar = smoothstep(1.1, 0.55, shape)
    wear = bar * uniform(rng, 0, 0.6)
    return Layers(
        base * (0.75 + 0.25 * bar + 0.05 * noise(canvas, rng, 6, 5))[..., None],
        bar * np.float32(0.1 / f) + bumps(canvas, rng, 40, 0.03, 2),
        rough * (1 - wear),
        1.0,
        relief=(12, 50),
    )


def rusty_metal(canvas: Canvas, rng: Rng) -> Layers:
    """Bare metal under spreading rust."""
    spread = noise(canvas, rng, log_uniform(rng, 2, 10), 7, uniform(rng, 0.6, 0.85))
    amount = uniform(rng, -1.2, 1.4)
    edge = log_uniform(rng, 0.05, 0.6)
    there = smoothstep(-edge, edge, spread + amount)
    halo = smoothstep(-edge - 0.7, edge, spread + amount)
    base = metal(rng) * np.float32(0.7)
    rust, crust = _rust(canvas, rng)
    smear = noise(canvas, rng, 5, 4)
    bare = base * np.exp(0.08 * smear)[..., None]
    bare = mixed(bare, bare * np.array([0.8, 0.6, 0.45], np.float32), halo)
    scale = uniform(rng, 0.2, 1)
    return Layers(
        mixed(bare, rust, there),
        there * (crust + np.float32(0.01)) * np.float32(scale) + bumps(canvas, rng, 5, 0.02, 3),
        mixed(
            np.clip(uniform(rng, 0.2, 0.5) * np.exp(0.15 * smear) + 0.15 * halo, 0, 1),
            uniform(rng, 0.75, 1.0) + 0.06 * noise(canvas, rng, 20, 3),
            there,
        ),
        1 - there,
        relief=(2, 30),
    )


def painted_metal(canvas: Canvas, rng: Rng) -> Layers:
    """Paint that has flaked off metal (perhaps with rust below), with a raised edge."""
    paint = dye(rng, (0.02, 0.75))
    f = log_uniform(rng, 2, 9)
    loss = noise(canvas, rng, f, 7, uniform(rng, 0.5, 0.75), at=warped(canvas, rng, f, 0.2 / f))
    if chance(rng, 0.4):  # cracks bound the flakes
        cracks = voronoi(canvas, rng, 3 * f, at=warped(canvas, rng, 4 * f, 0.06 / f))
        loss = (
            0.7 * loss
            + (cracks.values(rng) - np.float32(0.5)) * 2
            + smoothstep(0.1, 0, cracks.inside * np.float32(3 * f))
        )
    if chance(rng, 0.5):
        loss = loss + 2.5 * scratches(canvas, rng, int(rng.integers(3, 12)), 0.004)
    threshold = uniform(rng, 0.4, 2.0)
    bare = smoothstep(threshold - 0.06, threshold + 0.06, loss)
    lift = smoothstep(threshold - 0.5, threshold - 0.06, loss) * (1 - bare)
    rough = log_uniform(rng, 0.1, 0.6)
    coat = varied(rng, paint, 0.1) * np.exp(0.08 * noise(canvas, rng, 4, 5))[..., None]
    rust, crust = _rust(canvas, rng)
    rusty = smoothstep(-0.5, 0.5, noise(canvas, rng, 2 * f, 5) + uniform(rng, -2, 2))
    base = metal(rng) * np.float32(0.8)
    under = mixed(base * np.ones_like(coat), rust, rusty)
    stain = lift * uniform(rng, 0, 0.7) * rusty
    thick = log_uniform(rng, 0.002, 0.01)
    peel = bumps(canvas, rng, uniform(rng, 20, 60), log_uniform(rng, 0.005, 0.06), 2)
    return Layers(
        mixed(mixed(coat, rust, stain), under, bare),
        (1 - bare) * np.float32(thick) * (1 + uniform(rng, 0, 1) * lift)
        + peel * (1 - bare)
        + crust * bare * rusty * np.float32(0.4),
        mixed(
            rough * (1 + 0.1 * noise(canvas, rng, 8, 4)) + 0.2 * stain,
            mixed(np.float32(uniform(rng, 0.2, 0.5)), np.float32(uniform(rng, 0.7, 0.95)), rusty),
            bare,
        ),
        bare * (1 - rusty),
        relief=(3, 40),
    )


def corrugated_metal(canvas: Canvas, rng: Rng) -> Layers:
    """Waved or ribbed sheet: zinc, painted, weathered."""
    f = uniform(rng, 3, 14)
    x, _ = canvas.turned(float(rng.integers(2)) * np.pi / 2 + 0.05 * uniform(rng, -1, 1))
    wave = np.sin(2 * np.float32(np.pi) * x * np.float32(f) + uniform(rng, 0, 6))
    if chance(rng, 0.5):
        wave = np.tanh(wave * np.float32(uniform(rng, 1.5, 5)))
    height = wave / np.float32(6 * f) + bumps(canvas, rng, 6, 0.03, 3)
    spangle = voronoi(canvas, rng, uniform(rng, 6, 25), at=warped(canvas, rng, 20, 0.01))
    base = metal(rng)
    dirt = smoothstep(-0.6, 2, noise(canvas, rng, 3, 5) - wave)
    rough = log_uniform(rng, 0.15, 0.5) * (0.8 + 0.4 * spangle.values(rng))
    metallic: Array = np.full(wave.shape, 0.0 if chance(rng, 0.4) else 1.0, np.float32)
    tone = base * (0.85 + 0.3 * spangle.values(rng))[..., None]
    if metallic[0, 0] < 0.5:
        tone, rough = dye(rng) * np.ones_like(tone), np.full_like(wave, uniform(rng, 0.15, 0.6))
    rust, _ = _rust(canvas, rng)
    dirt = dirt * np.float32(uniform(rng, 0, 0.9))
    return Layers(
        mixed(tone, rust, dirt),
        height,
        mixed(rough, 0.85, dirt),
        metallic * (1 - dirt),
        relief=(12, 55),
    )
