"""Materials without end: `procedural_material` draws a kind, builds it and wears it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import uniform_filter

from invrender.data.materials import hard, soft
from invrender.data.materials import metal as metals
from invrender.data.materials.layers import Layers, chance, dye, earth, log_uniform, metal, uniform
from invrender.data.materials.noise import Array, Canvas, noise
from invrender.data.materials.patterns import mixed, scratches, slopes, smoothstep, voronoi
from invrender.maps import Maps
from invrender.types import InputError

Kind = Callable[[Canvas, np.random.Generator], Layers]

RELIEF_LIMIT = float(np.tan(np.radians(75)))
ROUGHNESS_FLOOR = 0.05


def _plain(canvas: Canvas, rng: np.random.Generator) -> Layers:
    """Anything: blobs of a few unrelated materials that share their borders. For coverage."""
    n = int(rng.integers(2, 5))
    field = noise(canvas, rng, log_uniform(rng, 1.5, 10), int(rng.integers(1, 6)), 0.55)
    if chance(rng, 0.4):
        field = voronoi(canvas, rng, log_uniform(rng, 2, 10)).values(rng) * 3 - 1.5
    index = np.clip(((field + 1.5) / 3 * n).astype(np.intp), 0, n - 1)
    conductor = rng.random(n) < 0.3
    base = np.stack([metal(rng) if c else dye(rng, (0.01, 0.85)) for c in conductor])
    rough = np.array([log_uniform(rng, 0.06, 1) for _ in range(n)], np.float32)
    depth = rng.random(n).astype(np.float32) * np.float32(0.01)
    grain = noise(canvas, rng, log_uniform(rng, 4, 60), 4, 0.6)
    bump = np.float32(log_uniform(rng, 0.0005, 0.004)) * grain
    return Layers(
        base[index] * np.exp(uniform(rng, 0, 0.2) * grain)[..., None],
        depth[index] + bump,
        rough[index] * np.exp(uniform(rng, 0, 0.2) * grain),
        conductor.astype(np.float32)[index],
        relief=(0.5, 45),
    )


# Every kind and how often it is drawn; those of weight 0 only by name, so that what a seed draws
# stays the same.
PRESETS: dict[str, tuple[Kind, float]] = {
    "bricks": (hard.bricks, 1.0),
    "tiles": (hard.tiles, 1.2),
    "stone": (hard.stone, 1.0),
    "pavement": (hard.pavement, 0.8),
    "concrete": (hard.concrete, 1.0),
    "plaster": (hard.plaster, 0.9),
    "terrazzo": (hard.terrazzo, 0.6),
    "marble": (hard.marble, 0.8),
    "ground": (hard.ground, 0.8),
    "fabric": (soft.fabric, 2.0),
    "knit": (soft.knit, 0.5),
    "carpet": (soft.carpet, 0.6),
    "velvet": (soft.velvet, 0.4),
    "leather": (soft.leather, 1.2),
    "wood": (soft.wood, 1.5),
    "paper": (soft.paper, 1.0),
    "plastic": (soft.plastic, 1.3),
    "rubber": (soft.rubber, 0.6),
    "brushed_metal": (metals.brushed_metal, 0.8),
    "polished_metal": (metals.polished_metal, 0.6),
    "hammered_metal": (metals.hammered_metal, 0.5),
    "perforated_metal": (metals.perforated_metal, 0.5),
    "rusty_metal": (metals.rusty_metal, 0.7),
    "painted_metal": (metals.painted_metal, 0.9),
    "corrugated_metal": (metals.corrugated_metal, 0.3),
    "patches": (_plain, 1.0),
    "foam": (soft.foam, 0.0),
    "cardboard": (soft.cardboard, 0.0),
    "skin": (soft.skin, 0.0),
}

# Kinds of which collections of real materials hold few.
RARE = (
    "plastic", "paper", "cardboard", "leather", "skin", "rubber", "foam", "painted_metal",
    "brushed_metal",
)  # fmt: skip


def procedural_material(
    seed: int | np.random.Generator, height: int, width: int, kind: str | None = None
) -> Maps:
    """A procedural material, float32 maps of H × W.

    The same seed (or generator state) and size give the same bits; the same seed at another
    resolution gives the same material with more or less detail. ``kind`` is a key of `PRESETS`;
    without it one is drawn. Diffuse and specular are linear albedos, roughness is perceptual in
    [0.05, 1], normals are unit vectors (OpenGL). Raises `InputError` for an unknown kind or size.
    """
    if height < 1 or width < 1:
        raise InputError(f"a material must be at least 1 × 1 pixels, got {width} × {height}")
    if kind is not None and kind not in PRESETS:
        raise InputError(f"no kind of material '{kind}'; there are {', '.join(PRESETS)}")
    rng = np.random.default_rng(
        seed if not isinstance(seed, np.random.Generator) else seed.integers(0, 2**63)
    )
    weights = np.array([w for _, w in PRESETS.values()])
    drawn = list(PRESETS)[int(rng.choice(len(PRESETS), p=weights / weights.sum()))]
    canvas = Canvas(height, width)
    layers = PRESETS[kind or drawn][0](canvas, rng)
    return _finish(canvas, rng, layers)


def _finish(canvas: Canvas, rng: np.random.Generator, layers: Layers) -> Maps:
    """Scale the relief, add wear, and turn base colour and metalness into albedos."""
    shape = canvas.height, canvas.width
    base: Array = np.broadcast_to(np.asarray(layers.base, np.float32), (*shape, 3))
    rough: Array = np.broadcast_to(np.asarray(layers.roughness, np.float32), shape)
    metallic: Array = np.broadcast_to(np.asarray(layers.metallic, np.float32), shape)
    low, high = layers.relief
    tilt = np.tan(np.radians(min(1.25 * low * (high / low) ** (rng.random() ** 0.75), 68)))
    x, y = slopes(layers.height, canvas.pixel)
    steep = np.hypot(x, y)
    # At a fixed spacing, so that finer images of one material get the same relief.
    step = max(1, canvas.scale // 128)
    top = np.sort(_coarse(layers.height, step), axis=None)
    scale = np.float32(tilt / max(float(top[-max(1, top.size // 10) :].mean()), 1e-9))
    x, y, steep = x * scale, y * scale, steep * scale

    if layers.worn:
        base, rough = _hollows(canvas, rng, base, rough, layers.height * scale)
        base, rough, metallic, dx, dy = _wear(canvas, rng, base, rough, metallic)
        x, y = x + dx, y + dy
        steep = np.hypot(x, y)
    limit: Array = np.tanh(steep / np.float32(RELIEF_LIMIT)) * np.float32(RELIEF_LIMIT)
    limit = limit / np.maximum(steep, np.float32(1e-9))
    normal: Array = np.stack([-x * limit, -y * limit, np.ones_like(x)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)

    base = np.clip(base, 0.003, 0.97)
    metallic = np.clip(metallic, 0, 1)[..., None]
    f0 = layers.f0
    if f0 is None:
        f0 = 0.04 if chance(rng, 0.6) else uniform(rng, 0.02, 0.08)
    return Maps(
        (np.minimum(base, 0.9) * (1 - metallic)).astype(np.float32),
        (np.float32(f0) * (1 - metallic) + base * metallic).astype(np.float32),
        np.clip(rough, ROUGHNESS_FLOOR, 1).astype(np.float32),
        normal.astype(np.float32),
    )


def _coarse(height: Array, step: int) -> Array:
    """Size of the slopes measured across ``step`` pixels, in units of 1/128 of the longer side."""
    spacing = step / max(height.shape)
    rows = (height[step:, :] - height[:-step, :]) if height.shape[0] > step else height * 0
    columns = (height[:, step:] - height[:, :-step]) if height.shape[1] > step else height * 0
    h, w = min(rows.shape[0], columns.shape[0]), min(rows.shape[1], columns.shape[1])
    return np.hypot(rows[:h, :w], columns[:h, :w]) / np.float32(spacing)


def _hollows(
    canvas: Canvas, rng: np.random.Generator, base: Array, rough: Array, height: Array
) -> tuple[Array, Array]:
    """Dirt in the hollows and polish on the crests, on most materials: base and roughness."""
    dark, dull = uniform(rng, -0.1, 0.8), uniform(rng, -0.1, 0.2)
    if chance(rng, 0.3):
        return base, rough
    around = uniform_filter(height, max(3, round(canvas.scale / 18)), mode="reflect")
    hollow = (around - height) * np.float32(uniform(rng, 40, 150))
    hollow = np.clip(hollow, -1, 1) if chance(rng, 0.5) else np.clip(hollow, 0, 1)
    return base * np.exp(np.float32(-dark) * hollow)[..., None], rough + np.float32(dull) * hollow


def _wear(
    canvas: Canvas, rng: np.random.Generator, base: Array, rough: Array, metallic: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Scratches, dust, smudges, stains and uneven light tones, each on some materials only.

    Returns base, roughness, metallic and slopes to add.
    """
    dx = dy = np.float32(0) * rough
    if chance(rng, 0.15):
        count = int(rng.integers(4, 30))
        angle = uniform(rng, 0, np.pi) if chance(rng, 0.4) else None
        line = scratches(canvas, rng, count, log_uniform(rng, 0.001, 0.004), angle)
        depth = log_uniform(rng, 0.0002, 0.003)
        dx, dy = slopes(-line * np.float32(depth), canvas.pixel)
        rough = rough + line * np.float32(uniform(rng, -0.05, 0.3))
        base = mixed(base, base * np.float32(uniform(rng, 0.6, 1.5)), line)
    if chance(rng, 0.2):  # smudges, fingers: gloss only
        n = smoothstep(-0.5, 1.2, noise(canvas, rng, log_uniform(rng, 2, 8), 4, 0.6))
        rough = rough + n * np.float32(uniform(rng, -0.1, 0.2))
    if chance(rng, 0.12):  # dust
        n = smoothstep(0.0, 2.5, noise(canvas, rng, log_uniform(rng, 2, 10), 6, 0.65))
        n = n * np.float32(uniform(rng, 0.1, 0.6))
        base, rough, metallic = (
            mixed(base, earth(rng, (0.15, 0.5)), n),
            mixed(rough, 0.9, n),
            metallic * (1 - n),
        )
    if chance(rng, 0.2):  # stains: colour only
        n = smoothstep(0.2, 0.8, noise(canvas, rng, log_uniform(rng, 1.5, 5), 5))
        base = mixed(base, base * dye(rng, (0.3, 1.0)), n * np.float32(uniform(rng, 0.2, 0.8)))
    if chance(rng, 0.35):
        tone = np.exp(np.float32(uniform(rng, 0.02, 0.2)) * noise(canvas, rng, 2, 3))
        base = base * tone[..., None]
    if chance(rng, 0.5):  # fine grain of the surface itself, more on rough ones
        micro = noise(canvas, rng, uniform(rng, 50, 110), 2, 0.8)
        height = log_uniform(rng, 2e-5, 1e-3)
        gx, gy = slopes(micro * rough * np.float32(height), canvas.pixel)
        dx, dy = dx + gx, dy + gy
    grain = noise(canvas, rng, 80, 2, 0.8)
    base = base * np.exp(np.float32(uniform(rng, 0, 0.06)) * grain)[..., None]
    return base, rough + np.float32(uniform(rng, 0, 0.015)) * grain, metallic, dx, dy
