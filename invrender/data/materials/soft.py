"""Procedural cloth, leather, skin, wood, paper, cardboard, plastic, rubber and foam."""

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
    metal,
    uniform,
    varied,
)
from invrender.data.materials.noise import Array, Canvas, generator, noise, warped
from invrender.data.materials.patterns import WEAVES, mixed, smoothstep, voronoi, weave
from invrender.data.materials.patterns import bricks as brick_cells

Rng = np.random.Generator


def fabric(canvas: Canvas, rng: Rng) -> Layers:
    """Woven cloth: plain, twill, satin and more, perhaps striped, checked or printed."""
    threads = log_uniform(rng, 10, 55)
    turn = float(rng.integers(2)) * np.pi / 2 if chance(rng, 0.6) else uniform(rng, 0, np.pi)
    points = warped(canvas, rng, uniform(rng, 2, 6), 0.15 / threads, canvas.turned(turn))
    points = warped(canvas, rng, threads, uniform(rng, 0.01, 0.06) / threads, points)
    kind = list(WEAVES)[int(rng.integers(len(WEAVES)))]
    crown, up, i, j = weave(points, threads, kind, uniform(rng, 0.02, 0.25))
    table = generator(rng).random((3, 1024), dtype=np.float32)
    ii, jj = i.astype(np.intp) % 1024, j.astype(np.intp) % 1024
    warp = dye(rng, (0.015, 0.7))
    weft = varied(rng, warp, 0.25) if chance(rng, 0.6) else dye(rng, (0.015, 0.7))
    warp_tone: Array = np.broadcast_to(warp, (*crown.shape, 3))
    weft_tone: Array = np.broadcast_to(weft, (*crown.shape, 3))
    if chance(rng, 0.3):  # stripes and checks
        stripe = dye(rng)
        every, wide = int(rng.integers(6, 24)), int(rng.integers(2, 8))
        warp_tone = np.where((ii % every < wide)[..., None], stripe, warp_tone)
        if chance(rng, 0.5):
            weft_tone = np.where((jj % every < wide)[..., None], stripe, weft_tone)
    tone = np.where(up[..., None], warp_tone, weft_tone)
    if chance(rng, 0.2):
        print_ = smoothstep(-0.05, 0.05, noise(canvas, rng, uniform(rng, 2, 6), 2))
        tone = mixed(tone, dye(rng), print_ * np.float32(0.85))
    single = np.where(up, table[0][ii], table[1][jj]) - np.float32(0.5)
    fibre = noise(canvas, rng, min(4 * threads, 128), 1)
    shade = (uniform(rng, 0.2, 0.6) + crown) / np.float32(1.3)
    tone = tone * (np.exp(0.3 * single + 0.12 * fibre) * np.clip(shade, 0.1, 1.2))[..., None]
    shiny = uniform(rng, 0.25, 0.5) if chance(rng, 0.2) else uniform(rng, 0.55, 0.98)
    folds = bumps(canvas, rng, uniform(rng, 1, 3), log_uniform(rng, 0.01, 0.2), 2)
    metallic = 1.0 if chance(rng, 0.03) else 0.0
    return Layers(
        tone,
        crown / np.float32(2 * threads) + folds + fibre / np.float32(40 * threads),
        shiny + 0.1 * (1 - crown) * uniform(rng, -0.5, 1) + 0.06 * single,
        metallic,
        f0=None,
        relief=(5, 40),
    )


def knit(canvas: Canvas, rng: Rng) -> Layers:
    """Knitted loops in columns."""
    f = log_uniform(rng, 6, 24)
    x, y = warped(canvas, rng, 4, 0.1 / f, canvas.turned(float(rng.integers(4)) * np.pi / 2))
    x, y = x * np.float32(f), y * np.float32(1.25 * f)
    a = x - np.floor(x) - np.float32(0.5)
    side = np.where(a < 0, np.float32(-1), np.float32(1))
    t = y + np.abs(a) * np.float32(uniform(rng, 0.8, 1.4))
    stitch = np.floor(t)
    t = t - stitch - np.float32(0.5)
    across = np.abs(a) - np.float32(0.25)
    yarn = np.clip(1 - (across / 0.3) ** 2 - (t / 0.62) ** 2, 0, 1) ** np.float32(0.5)
    twist = np.sin((t * 1.2 + side * across * 3) * np.float32(4 * np.pi))
    base = dye(rng, (0.02, 0.7))
    row = stitch.astype(np.intp)
    tone: Array = np.broadcast_to(base, (*yarn.shape, 3))
    if chance(rng, 0.35):
        every = int(rng.integers(4, 14))
        tone = np.where((row % every < every // 2)[..., None], dye(rng), tone)
    fuzz = noise(canvas, rng, 5 * f, 2, 0.8)
    tone = tone * (np.exp(0.15 * fuzz + 0.06 * twist) * (0.3 + 0.75 * yarn))[..., None]
    return Layers(
        tone,
        (yarn + 0.04 * twist + 0.03 * fuzz) / np.float32(4 * f),
        uniform(rng, 0.65, 0.98) + 0.03 * fuzz,
        relief=(10, 45),
    )


def carpet(canvas: Canvas, rng: Rng) -> Layers:
    """Tufts, fleece, felt, towelling."""
    f = log_uniform(rng, 14, 50)
    points = warped(canvas, rng, f / 2, uniform(rng, 0.05, 0.3) / f)
    cells = voronoi(canvas, rng, f, uniform(rng, 0.4, 1), at=points)
    tuft = smoothstep(0, 0.45, cells.inside * np.float32(f))
    if chance(rng, 0.3):  # felt: matted fibres only
        tuft = smoothstep(-2, 2, noise(canvas, rng, f, 3, 0.8, True))
    base = dye(rng, (0.03, 0.7))
    tone = mixed(base, varied(rng, base, 0.6), cells.values(rng))
    if chance(rng, 0.3):
        tone = mixed(tone, dye(rng), smoothstep(-0.1, 0.1, noise(canvas, rng, 4, 2)))
    fibre = noise(canvas, rng, min(5 * f, 120), 1)
    tone = tone * (np.exp(0.25 * fibre) * (0.35 + 0.7 * tuft))[..., None]
    lean = bumps(canvas, rng, 4, 0.1, 3)
    return Layers(
        tone,
        (tuft + 0.12 * fibre + 0.3 * cells.values(rng) * tuft) / np.float32(3 * f) + lean,
        uniform(rng, 0.55, 1.0) + 0.04 * fibre,
        relief=(10, 50),
    )


def velvet(canvas: Canvas, rng: Rng) -> Layers:
    """Dark pile: velvet, suede, black flock."""
    base = colour(rng, (0, 1), (0, 0.9), (0.006, 0.08))
    crush = noise(canvas, rng, log_uniform(rng, 2, 9), 4, at=warped(canvas, rng, 3, 0.08))
    nap = noise(canvas, rng, (30, 100), 2, 0.8)
    return Layers(
        base * np.exp(0.3 * crush + 0.15 * nap)[..., None],
        crush / np.float32(25) + nap / np.float32(900),
        uniform(rng, 0.7, 1.0) - 0.05 * crush,
        f0=uniform(rng, 0.02, 0.04),
        relief=(2, 18),
    )


def leather(canvas: Canvas, rng: Rng) -> Layers:
    """Grained hide, smooth to coarse, with creases; perhaps stitched or patent."""
    f = log_uniform(rng, 9, 45)
    points = warped(canvas, rng, f / 3, 0.25 / f)
    points = warped(canvas, rng, f, 0.08 / f, points)
    cells = voronoi(canvas, rng, f, 0.9, at=points)
    fine = voronoi(canvas, rng, 2.2 * f, 1.0, at=points)
    pebble = smoothstep(0.0, uniform(rng, 0.15, 0.4), cells.inside * np.float32(f))
    small = smoothstep(0.0, 0.25, fine.inside * np.float32(2.2 * f))
    pores = pebble * (0.75 + 0.25 * small)
    crease = smoothstep(0.9, 1.5, noise(canvas, rng, uniform(rng, 2, 5), 4, 0.5, True, points))
    base = colour(rng, (0.01, 0.1), (0.3, 0.85), (0.01, 0.35)) if chance(rng, 0.7) else dye(rng)
    tone = base * np.exp(0.15 * noise(canvas, rng, 4, 5))[..., None]
    tone = tone * (0.55 + 0.45 * pores - 0.15 * crease)[..., None]
    smooth = uniform(rng, 0.25, 0.65)
    return Layers(
        tone,
        pores * np.float32(0.4 / f) - crease * np.float32(0.004) + bumps(canvas, rng, 2, 0.03, 2),
        smooth + uniform(rng, 0.05, 0.25) * (1 - pores) + 0.03 * noise(canvas, rng, 12, 3),
        relief=(3, 40),
    )


def wood(canvas: Canvas, rng: Rng) -> Layers:
    """Veneer, planks or parquet, raw, oiled or varnished."""
    angle = float(rng.integers(2)) * np.pi / 2 + 0.04 * uniform(rng, -1, 1)
    x, y = canvas.turned(angle)
    base = colour(rng, (0.045, 0.1), (0.4, 0.85), (0.06, 0.6))
    joint: Array = np.zeros_like(x)
    board: Array = np.zeros_like(x)
    if chance(rng, 0.5):
        width = 1 / uniform(rng, 2, 9)
        cells = brick_cells(rng, (x, y), width * uniform(rng, 4, 12), width, 0.37)
        gap = log_uniform(rng, 0.0015, 0.006)
        joint = smoothstep(gap, gap * 0.3, cells.inside)
        board = cells.values(rng)
        x, y = x + board * 13, y + cells.values(rng) * 9
    bend = noise(canvas, rng, (0.8, 2.5), 3, 0.5, at=(x, y))
    rings = y * np.float32(uniform(rng, 5, 25)) + bend * np.float32(uniform(rng, 0.3, 1.6))
    phase = rings - np.floor(rings)
    grain = phase**2 * smoothstep(1.0, 0.88, phase)
    streak = noise(canvas, rng, (2.5, 50), 2, 0.8, at=(x, y))
    pore = smoothstep(1.0, 2.2, noise(canvas, rng, (5, 90), 1, at=(x, y)) + 0.4 * grain)
    dark = base * np.array([0.5, 0.4, 0.33], np.float32)
    strength = uniform(rng, 0.3, 1)
    tone = mixed(base, dark, np.clip(grain * strength + 0.15 * streak * strength, 0, 1))
    tone = tone * (np.exp(0.5 * (board - 0.5) + 0.05 * streak) * (1 - 0.4 * pore))[..., None]
    tone = mixed(tone, base * np.float32(0.1), joint)
    varnish = chance(rng, 0.5)
    rough = log_uniform(rng, 0.08, 0.4) if varnish else uniform(rng, 0.45, 0.85)
    height = (-0.3 * grain + 0.1 * streak - 0.8 * pore) * np.float32(0.004)
    height = height * (0.3 if varnish else 1) - joint * np.float32(0.008)
    return Layers(
        tone,
        height + bumps(canvas, rng, 3, 0.005, 2),
        rough + uniform(rng, 0, 0.15) * grain + 0.15 * pore + 0.3 * joint,
        relief=(0.5, 6) if varnish else (2, 25),
    )


def paper(canvas: Canvas, rng: Rng) -> Layers:
    """Paper and board: blank, creased, printed."""
    base = (
        grey(rng, (0.5, 0.88))
        if chance(rng, 0.6)
        else colour(rng, (0.05, 0.13), (0.2, 0.6), (0.2, 0.6))
    )
    fibre = noise(canvas, rng, 40, 3, 0.8)
    tone = base * np.exp(0.03 * fibre + 0.02 * noise(canvas, rng, 4, 3))[..., None]
    height = bumps(canvas, rng, 30, 0.03, 3, 0.7)
    rough = np.full_like(fibre, uniform(rng, 0.25, 0.95)) + 0.02 * fibre
    if chance(rng, 0.35):  # crumpled
        f = uniform(rng, 3, 8)
        facets = voronoi(canvas, rng, f)
        planes = (facets.values(rng, 2) - np.float32(0.5)) * np.float32(0.25)
        ridge = smoothstep(0.08, 0, facets.inside * np.float32(f))
        height = height + planes[..., 0] * facets.x + planes[..., 1] * facets.y
        height = height + bumps(canvas, rng, f, 0.15, 3, 0.5, True)
        tone = tone * (1 - 0.06 * ridge)[..., None]
    if chance(rng, 0.6):
        tone, ink = printed(canvas, rng, tone)
        rough = rough + ink * np.float32(uniform(rng, -0.3, 0.05))
    return Layers(tone, height, rough, relief=(0.7, 15))


def printed(canvas: Canvas, rng: Rng, under: Array) -> tuple[Array, Array]:
    """Ink on a colour (H, W, 3), without relief: stripes, dots, blocks, text-like marks, blobs.

    Returns the colour and where the ink is, (H, W) in [0, 1].
    """
    edge = 0.7 * canvas.pixel
    points = canvas.turned(uniform(rng, 0, np.pi) if chance(rng, 0.5) else 0.0)
    style = int(rng.integers(5))
    if style == 0:
        f = uniform(rng, 2, 16)
        wave = np.abs((points[0] * np.float32(f)) % 1 - np.float32(0.5)) / np.float32(f)
        ink = smoothstep(-edge, edge, wave - np.float32(uniform(rng, 0.1, 0.4) / f))
    elif style == 1:
        f = uniform(rng, 3, 16)
        dots = voronoi(canvas, rng, f, uniform(rng, 0, 0.5), chance(rng, 0.5), points)
        ink = smoothstep(edge, -edge, np.hypot(dots.x, dots.y) - uniform(rng, 0.15, 0.4) / f)
    elif style == 2:
        cells = brick_cells(rng, points, 1 / uniform(rng, 2, 9), 1 / uniform(rng, 2, 9), 0.3)
        ink = (cells.values(rng) > uniform(rng, 0.2, 0.7)).astype(np.float32)
    elif style == 3:  # lines of "letters"
        size = 1 / uniform(rng, 8, 25)
        cells = brick_cells(rng, points, size * 0.6, size, 0.0)
        word = cells.values(rng) > 0.2
        line = np.abs(cells.y) < size * 0.25
        strokes = noise(canvas, rng, 1.6 / size, 1, at=points)
        ink = smoothstep(0.0, 0.3, np.abs(strokes) - 0.35) * word * line
    else:
        ink = smoothstep(-0.06, 0.06, noise(canvas, rng, uniform(rng, 2, 7), 3, at=points))
    n = int(rng.integers(1, 4))
    colours = np.stack([dye(rng, (0.01, 0.8)) for _ in range(n)])
    if n > 1:
        zone = brick_cells(rng, points, 1 / uniform(rng, 1, 5), 1 / uniform(rng, 1, 5), 0.4)
        number = (zone.values(rng) * n).astype(np.intp)
        tint: Array = colours[np.minimum(number, n - 1)]
    else:
        tint = colours[0]
    return mixed(under, tint, ink * np.float32(uniform(rng, 0.75, 1))), ink


def plastic(canvas: Canvas, rng: Rng) -> Layers:
    """Moulded plastic, lacquer, vinyl: glossy or grained, perhaps ribbed or printed."""
    base = dye(rng, (0.01, 0.8))
    rough = log_uniform(rng, 0.06, 0.6)
    tone = base * np.exp(0.02 * noise(canvas, rng, 3, 4))[..., None]
    height = bumps(canvas, rng, log_uniform(rng, 1, 4), log_uniform(rng, 0.002, 0.03), 3)
    style = rng.random()
    if style < 0.35:
        height = height + bumps(canvas, rng, uniform(rng, 25, 70), 0.15, 2)
        relief = (1.0, 18.0)
    elif style < 0.5:
        f = uniform(rng, 4, 25)
        x, _ = canvas.turned(float(rng.integers(4)) * np.pi / 4)
        rib = np.tanh(np.sin(x * np.float32(2 * np.pi * f)) * uniform(rng, 1, 4))
        height = height + rib / np.float32(8 * f)
        relief = (5.0, 45.0)
    elif style < 0.65:
        f = uniform(rng, 5, 20)
        knobs = voronoi(canvas, rng, f, 0.0, chance(rng, 0.5))
        d = np.hypot(knobs.x, knobs.y) * np.float32(f)
        height = height + smoothstep(uniform(rng, 0.3, 0.5), 0.1, d) / np.float32(5 * f)
        relief = (5.0, 45.0)
    else:
        relief = (0.2, 4.0)
    field = rough * np.exp(uniform(rng, 0.02, 0.25) * noise(canvas, rng, 4, 5))
    if chance(rng, 0.25):
        tone, ink = printed(canvas, rng, tone)
        field = field + ink * np.float32(uniform(rng, -0.1, 0.3))
    if chance(rng, 0.15):  # metal flakes under lacquer
        flakes = voronoi(canvas, rng, uniform(rng, 40, 90))
        glint = (flakes.values(rng) > 0.6) * flakes.values(rng)
        tone = mixed(tone, metal(rng) * np.float32(0.8), glint * np.float32(0.5))
        return Layers(tone, height, field, glint * np.float32(0.6), relief=relief)
    return Layers(tone, height, field, f0=uniform(rng, 0.035, 0.06), relief=relief)


def rubber(canvas: Canvas, rng: Rng) -> Layers:
    """Rubber, silicone and foam, plain or studded, dusty."""
    base = grey(rng, (0.008, 0.08)) if chance(rng, 0.7) else dye(rng)
    height = bumps(canvas, rng, uniform(rng, 20, 60), 0.1, 2)
    style = rng.random()
    if style < 0.3:
        f = uniform(rng, 4, 14)
        studs = voronoi(canvas, rng, f, 0.0, True)
        d = np.hypot(studs.x, studs.y) * np.float32(f)
        height = height + smoothstep(0.4, 0.3, d) / np.float32(6 * f)
    elif style < 0.6:
        f = uniform(rng, 10, 35)
        holes = voronoi(canvas, rng, f)
        height = height - smoothstep(0.4, 0.1, np.hypot(holes.x, holes.y) * np.float32(f)) * (
            holes.values(rng) > 0.4
        ) / np.float32(5 * f)
    level = height / max(float(height.std()), 1e-6)
    dust = smoothstep(0.2, 2.0, noise(canvas, rng, 5, 5) - 0.5 * level) * uniform(rng, 0, 0.4)
    tone = mixed(base * np.exp(0.1 * noise(canvas, rng, 50, 2))[..., None], earth(rng), dust)
    return Layers(
        tone, height, uniform(rng, 0.4, 0.85) + 0.25 * dust + 0.03 * level, relief=(2, 35)
    )


def foam(canvas: Canvas, rng: Rng) -> Layers:
    """Open cells like a sponge, or closed ones under a thin skin like packing foam."""
    base = grey(rng, (0.03, 0.8)) if chance(rng, 0.5) else dye(rng, (0.05, 0.8))
    f = log_uniform(rng, 12, 50)
    cells = voronoi(canvas, rng, f, uniform(rng, 0.6, 1.0))
    wall = cells.inside * np.float32(f)  # distance from the walls, in cells
    size = np.float32(0.6) + np.float32(0.8) * cells.values(rng)
    if chance(rng, 0.5):  # open
        hole = smoothstep(0.08, 0.3, wall * size) * (cells.values(rng) > uniform(rng, 0.0, 0.4))
        small = smoothstep(0.1, 0.35, voronoi(canvas, rng, 2.7 * f).inside * np.float32(2.7 * f))
        height = -(hole + 0.25 * small) / np.float32(2.5 * f)
        tone = base * (1 - uniform(rng, 0.4, 0.8) * hole - 0.15 * small)[..., None]
        return Layers(tone, height, uniform(rng, 0.75, 1.0), relief=(15, 48))
    dome = smoothstep(0.0, 0.45, wall * size)
    height = dome / np.float32(6 * f) + bumps(canvas, rng, 2, 0.04, 3)
    tone = base * (0.8 + 0.2 * dome)[..., None]
    rough = uniform(rng, 0.4, 0.8) + 0.1 * (1 - dome)
    return Layers(tone, height, rough, relief=(3, 18))


def cardboard(canvas: Canvas, rng: Rng) -> Layers:
    """Kraft or grey board: fibres and specks, flutes that show through, creases, print."""
    kraft = colour(rng, (0.07, 0.1), (0.4, 0.6), (0.25, 0.45))
    base = kraft if chance(rng, 0.75) else grey(rng, (0.25, 0.8))
    angle = float(rng.integers(2)) * np.pi / 2 if chance(rng, 0.7) else uniform(rng, 0, np.pi)
    along = canvas.turned(angle)
    fibre = noise(canvas, rng, (20, 90), 2, 0.8, at=along)
    speck = smoothstep(1.6, 2.6, noise(canvas, rng, 60, 2, 0.8))
    tone = base * np.exp(0.06 * fibre + 0.05 * noise(canvas, rng, 3, 4))[..., None]
    tone = mixed(tone, base * np.float32(0.4), speck * np.float32(uniform(rng, 0.1, 0.6)))
    height = bumps(canvas, rng, 40, 0.02, 2, 0.7)
    rough = uniform(rng, 0.65, 0.95) + 0.03 * fibre
    if chance(rng, 0.65):  # flutes under the liner
        f = uniform(rng, 10, 32)
        flute = np.cos(along[0] * np.float32(2 * np.pi * f) + 0.3 * noise(canvas, rng, 3, 2))
        height = height + flute * np.float32(uniform(rng, 0.01, 0.08) / f)
        tone = tone * (1 + uniform(rng, 0.0, 0.06) * flute)[..., None]
    if chance(rng, 0.35):  # folds, whose fibres are broken and pale
        lines = brick_cells(rng, along, 1 / uniform(rng, 1, 2.5), 1 / uniform(rng, 1, 2.5), 0.1)
        fold = smoothstep(0.012, 0.0, lines.inside)
        height = height - fold * np.float32(0.004)
        tone = mixed(tone, base * np.float32(1.3), fold * np.float32(0.4))
    if chance(rng, 0.4):
        tone, _ = printed(canvas, rng, tone)
    return Layers(tone, height, rough, f0=0.04, relief=(0.5, 10))


def skin(canvas: Canvas, rng: Rng) -> Layers:
    """Like human skin: furrows that cross in triangles, pores, blotches, a moist sheen."""
    base = colour(rng, (0.025, 0.075), (0.3, 0.65), (0.04, 0.65))
    f = log_uniform(rng, 14, 45)
    points = warped(canvas, rng, f / 4, 0.2 / f)
    plates = voronoi(canvas, rng, f, 0.9, at=points)
    fine = voronoi(canvas, rng, 2.1 * f, 1.0, at=points)
    furrow = smoothstep(0.16, 0.0, plates.inside * np.float32(f))
    furrow = np.maximum(furrow, 0.5 * smoothstep(0.14, 0.0, fine.inside * np.float32(2.1 * f)))
    pits = voronoi(canvas, rng, f / 2)
    pore = smoothstep(0.1, 0.03, np.hypot(pits.x, pits.y) * np.float32(f / 2))
    blood = smoothstep(-1.5, 2.0, noise(canvas, rng, log_uniform(rng, 2, 8), 4))
    red = base * np.array([1.0, 0.72, 0.68], np.float32)
    tone = mixed(base, red, blood) * (1 - 0.12 * furrow - 0.25 * pore)[..., None]
    if chance(rng, 0.4):  # moles and freckles
        spot = smoothstep(1.3, 2.0, noise(canvas, rng, log_uniform(rng, 5, 14), 2))
        tone = mixed(tone, base * np.array([0.45, 0.35, 0.3], np.float32), spot)
    rough = uniform(rng, 0.3, 0.55) + 0.15 * furrow + 0.04 * noise(canvas, rng, 6, 3)
    height = -(furrow + 0.8 * pore) * np.float32(0.25 / f) + bumps(canvas, rng, 3, 0.05, 3)
    return Layers(tone, height, rough, f0=0.028, relief=(2, 16))
