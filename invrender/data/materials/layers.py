"""What a kind of procedural material returns, and the colours it is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from invrender.data.materials.noise import Canvas, Points, noise
from invrender.types import Array

Range = tuple[float, float]


@dataclass
class Layers:
    """A material before its normals are known: base colour, metalness, roughness and height.

    base: linear colour, (3,) or (H, W, 3); roughness, metallic, f0: a number or (H, W); height:
    (H, W) in any unit. ``relief`` is the range, in degrees, of the mean tilt of the steepest
    tenth of the surface; the height is scaled to one such tilt, drawn from that range.
    ``worn``: whether scratches, dust, smudges and the like may be added.
    """

    base: Array
    height: Array
    roughness: Any
    metallic: Any = 0.0
    f0: Any = None
    relief: Range = (2.0, 20.0)
    worn: bool = True


def uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A uniform number."""
    return float(low + (high - low) * rng.random())


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(low * (high / low) ** rng.random())


def chance(rng: np.random.Generator, probability: float) -> bool:
    """True with that probability."""
    return bool(rng.random() < probability)


def colour(
    rng: np.random.Generator,
    hue: Range = (0.0, 1.0),
    saturation: Range = (0.0, 0.9),
    light: Range = (0.03, 0.7),
) -> Array:
    """A linear colour (3,): hue 0 red, 1/3 green, 2/3 blue; ``light`` is the largest channel."""
    h = uniform(rng, *hue) % 1.0 * 6
    pure = np.clip(np.abs((h + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    s = uniform(rng, *saturation)
    return (log_uniform(rng, *light) * (1 - s * (1 - pure))).astype(np.float32)


def earth(rng: np.random.Generator, light: Range = (0.06, 0.5)) -> Array:
    """Browns, ochres and warm greys of stone, clay and soil."""
    return colour(rng, (0.03, 0.13), (0.1, 0.8), light)


def grey(rng: np.random.Generator, light: Range = (0.03, 0.7)) -> Array:
    """Nearly neutral."""
    return colour(rng, (0.0, 1.0), (0.0, 0.15), light)


def dye(rng: np.random.Generator, light: Range = (0.02, 0.75)) -> Array:
    """Any colour that people give things: a third neutral, the rest of all hues."""
    if chance(rng, 0.35):
        return grey(rng, light)
    return colour(rng, (0.0, 1.0), (0.35, 0.98), light)


def varied(rng: np.random.Generator, base: Array, amount: float = 0.3) -> Array:
    """A relative of a colour: lighter or darker by up to ``amount``, slightly of another hue."""
    factor = np.exp(rng.uniform(-amount, amount) + rng.uniform(-amount / 4, amount / 4, 3))
    return np.clip(base * factor, 0.003, 0.95).astype(np.float32)


METALS: dict[str, tuple[float, float, float]] = {
    "aluminium": (0.91, 0.92, 0.92),
    "steel": (0.56, 0.57, 0.58),
    "stainless": (0.66, 0.64, 0.60),
    "chrome": (0.55, 0.56, 0.56),
    "silver": (0.96, 0.95, 0.91),
    "nickel": (0.66, 0.61, 0.53),
    "titanium": (0.54, 0.50, 0.45),
    "zinc": (0.66, 0.68, 0.71),
    "gold": (0.98, 0.77, 0.34),
    "copper": (0.95, 0.64, 0.54),
    "brass": (0.89, 0.75, 0.40),
    "bronze": (0.71, 0.52, 0.31),
}


def metal(rng: np.random.Generator) -> Array:
    """Reflectance (3,) of a metal: clean, tarnished (darker), or anodised (any hue)."""
    names = list(METALS)
    base = np.array(METALS[names[int(rng.integers(len(names)))]], np.float32)
    if chance(rng, 0.12):
        base = colour(rng, (0.0, 1.0), (0.3, 0.9), (0.2, 0.8))
    return (base * (log_uniform(rng, 0.15, 1.0) if chance(rng, 0.6) else 1.0)).astype(np.float32)


def bumps(
    canvas: Canvas,
    rng: np.random.Generator,
    frequency: float | tuple[float, float],
    slope: float,
    octaves: int = 4,
    gain: float = 0.5,
    ridged: bool = False,
    at: Points | None = None,
) -> Array:
    """A height of fractal noise whose first octave has about that rms slope."""
    f = max(frequency) if isinstance(frequency, tuple) else frequency
    return noise(canvas, rng, frequency, octaves, gain, ridged, at) * np.float32(slope / 1.22 / f)
