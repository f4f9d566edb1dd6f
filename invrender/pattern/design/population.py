"""Pixels that stand for what people photograph, and what they reflect of each cell of a pattern.

Radiance I = k_d·E/π + k_s·B + A is linear in the pattern, channel by channel, and so are the
derivatives of E, B and A along roughness and the normal. So the responses of a population of pixels
to each cell of a coarse pattern are rendered once; any pattern's Jacobians are matrix products.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.data.environments import procedural_environment
from invrender.render.backend import Float, UInt, dr, vector
from invrender.render.fast.estimator import Fast
from invrender.render.scene import View, hash_bits, make_scene
from invrender.rig import Rig
from invrender.sphere import scale_environment
from invrender.types import Array

PATTERN_CELLS = 16  # of the pattern a side, bilinear between: about what the ball's image resolves
GROUP_PIXELS = 8  # pixels that share a material
ROOM_HEIGHT = 64  # rows of the environments


@dataclass
class Population:
    """Pixels in groups of `GROUP_PIXELS` that share a material and a room; M in all.

    x (M, 3) metres, normal (M, 3), roughness, diffuse, specular (M, ·): as each pixel has them.
    metal (groups,): whether the material is one. env_index, env_level (groups,): the room's number
    and its irradiance relative to a white screen's.
    """

    x: Array
    normal: Array
    roughness: Array
    diffuse: Array
    specular: Array
    metal: NDArray[np.bool_]
    env_index: NDArray[np.intp]
    env_level: Array


def draw_population(rig: Rig, groups: int, seed: int, rooms: int = 12) -> Population:
    """A population: three dielectrics to a metal, mostly shallow relief, rooms of all levels."""
    rng = np.random.default_rng(seed)
    half = rig.sample_size / 2
    metal = rng.random(groups) < 0.25
    grey = rng.beta(1.2, 2.5, groups)[:, None]
    colour = np.exp(0.35 * rng.standard_normal((groups, 3)))
    k_d = np.where(
        metal[:, None], 0.02 * rng.random((groups, 1)), np.clip(grey * colour, 0.01, 0.9)
    )
    tint = np.exp(0.15 * rng.standard_normal((groups, 3)))
    dielectric = 0.04 * np.exp(0.3 * rng.standard_normal((groups, 1)))
    k_s = np.where(
        metal[:, None], np.clip(rng.uniform(0.3, 0.9, (groups, 1)) * tint, 0.1, 0.98), dielectric
    )
    rho = rng.uniform(0.1, 0.9, groups)

    # Where a material's pixels are: from next to each other to all over the sample.
    spread = np.exp(rng.uniform(np.log(0.03), np.log(1), (groups, 1, 1))) * half
    centre = rng.uniform(-half, half, (groups, 1, 2))
    xy = centre + spread * rng.standard_normal((groups, GROUP_PIXELS, 2))
    xy = half - np.abs((xy + half) % (4 * half) - 2 * half)  # reflected at the border
    relief = np.exp(rng.uniform(np.log(0.03), np.log(0.4), (groups, 1, 1)))
    slope = relief * rng.standard_normal((groups, GROUP_PIXELS, 2))
    slope /= np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1)  # up to 45°
    normal = np.concatenate([slope, np.ones((groups, GROUP_PIXELS, 1))], -1).reshape(-1, 3)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    each = lambda v: np.repeat(v, GROUP_PIXELS, axis=0)  # noqa: E731
    return Population(
        np.concatenate([xy, np.zeros((groups, GROUP_PIXELS, 1))], -1).reshape(-1, 3),
        normal,
        each(rho),
        each(k_d),
        each(k_s),
        metal,
        rng.integers(rooms, size=groups) + rooms * seed,
        np.exp(rng.uniform(np.log(0.1), np.log(1.5), groups)),
    )


@dataclass
class Responses:
    """What each pixel reflects, per cell of the pattern and from the room.

    screen (M, 4, 3, K) grey: for value, ∂ρ, ∂s, ∂t the terms E, B, A of each of the K = cells²
    cells lit alone. room (M, 4, 3, 3): the same for the environment, RGB.
    """

    population: Population
    cells: int
    screen: Array
    room: Array


def measure_responses(
    rig: Rig,
    population: Population,
    cells: int = PATTERN_CELLS,
    samples: int = 192,
    progress: Callable[[float], None] | None = None,
) -> Responses:
    """Render the `Responses` with the fast estimator, three cells at a time (one a channel)."""
    m, k = len(population.x), cells * cells
    screen = np.empty((m, 4, 3, k), np.float32)
    all_pixels = np.arange(m)
    for start in range(0, k, 3):
        pattern = np.zeros((cells, cells, 3))
        n = min(3, k - start)
        for c in range(n):
            pattern.reshape(k, 3)[start + c, c] = 1
        screen[..., start : start + n] = _shade(
            rig, population, all_pixels, pattern, None, samples
        )[..., :n]
        if progress:
            progress(start / k)

    white = _screen_irradiance(screen, population)
    room = np.zeros((m, 4, 3, 3), np.float32)
    black = np.zeros((cells, cells, 3))  # it still hides what is behind it
    group = np.repeat(np.arange(len(population.env_index)), GROUP_PIXELS)
    for index in np.unique(population.env_index):
        env = scale_environment(procedural_environment(int(index), ROOM_HEIGHT), 1.0)
        pixels = np.flatnonzero(population.env_index[group] == index)
        level = white * population.env_level[group[pixels]]
        room[pixels] = (
            _shade(rig, population, pixels, black, env, samples) * level[:, None, None, None]
        )
    return Responses(population, cells, screen, room)


def _screen_irradiance(screen: Array, population: Population) -> float:
    """Mean irradiance of a white screen on shallow pixels."""
    shallow = population.normal[:, 2] > 0.98
    return float(screen[shallow, 0, 0].sum(-1).mean())


def _shade(
    rig: Rig, p: Population, pixels: NDArray[np.intp], pattern: Array, env: Any, samples: int
) -> Array:
    """E, B, A and their derivatives, (pixels, 4, 3, RGB)."""
    renderer = Fast(make_scene(rig, pattern, env))
    vec3 = vector(Float, 3)
    x = vec3(p.x[pixels].T.astype(np.float32))
    bits = hash_bits(UInt(pixels.astype(np.uint32)), dr.opaque(UInt, 0))
    view = View(x, dr.normalize(renderer.scene.camera - x), bits)
    rho = Float(p.roughness[pixels].astype(np.float32))
    shading = renderer.shade(
        view, rho, vec3(p.normal[pixels].T.astype(np.float32)), samples, jacobian=True
    )
    rows = [(shading.irradiance, shading.b, shading.a), *shading.tangents]
    dr.eval(rows)
    out = np.empty((len(pixels), 4, 3, 3), np.float32)
    for i, row in enumerate(rows):
        for j, term in enumerate(row):
            out[:, i, j] = np.broadcast_to(np.asarray(term).T, (len(pixels), 3))
    return out
