"""Procedural rooms: a box lit by its lamps and windows, seen from its table."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from invrender.data.environments.lamps import add_light, white_balance
from invrender.data.materials.layers import chance, colour, dye, earth, grey, log_uniform, uniform
from invrender.data.materials.noise import Canvas, noise
from invrender.sphere import directions
from invrender.types import Array

Rng = np.random.Generator


def room(rng: Rng, height: int) -> Array:
    """A box seen from its table: walls lit by what lights it, windows, lamps, furniture."""
    size = np.array([uniform(rng, 2.5, 9), uniform(rng, 2.5, 9), uniform(rng, 2.2, 3.8)])
    eye = np.array([uniform(rng, 0.2, 0.8) * size[0], uniform(rng, 0.2, 0.8) * size[1], 0.75])
    d = directions(height, 2 * height)
    # First wall in each direction: axis and side, and the point where it is hit.
    with np.errstate(divide="ignore"):
        t = np.where(d > 0, size - eye, -eye) / np.where(np.abs(d) < 1e-6, 1e-6, d)
    axis = np.argmin(t, -1)
    reach = np.take_along_axis(t, axis[..., None], -1)
    point = (eye + d * reach).astype(np.float32)
    side = np.take_along_axis(d, axis[..., None], -1)[..., 0] > 0

    paint = grey(rng, (0.35, 0.85)) if chance(rng, 0.6) else dye(rng, (0.15, 0.8))
    ceiling, floor = grey(rng, (0.5, 0.9)), earth(rng, (0.05, 0.5))
    albedo = np.where((axis == 2)[..., None], np.where(side[..., None], ceiling, floor), paint)
    if chance(rng, 0.4):
        other = dye(rng, (0.05, 0.8))
        albedo = np.where(((axis == 0) & side)[..., None], other, albedo)
    canvas = Canvas(height, 2 * height)
    at = (point[..., 0] + point[..., 2]) / 10, (point[..., 1] + 0.7 * point[..., 2]) / 10
    albedo = albedo * np.exp(0.1 * noise(canvas, rng, 10, 4, at=at))[..., None]
    albedo = _furnish(rng, albedo, point, axis, side, size)

    # Lamps and windows: place, area, normal, radiance.
    lights: list[tuple[Array, Array, Array, Array, bool, float]] = []
    lamp_colour = white_balance(log_uniform(rng, 2500, 6500))
    mode = rng.random()
    if mode < 0.55 or chance(rng, 0.5):
        lights += _ceiling_lamps(rng, size, lamp_colour)
    if chance(rng, 0.35):  # table and floor lamps
        for _ in range(int(rng.integers(1, 3))):
            place = np.array([*(rng.random(2) * size[:2]), uniform(rng, 0.9, 1.7)])
            if np.linalg.norm(place[:2] - eye[:2]) > 0.5:
                r = uniform(rng, 0.03, 0.15)
                power = log_uniform(rng, 0.05, 0.5) / r**2
                lights.append((place, np.array([r, r]), eye - place, lamp_colour * power, True, 0))
    openings: list[tuple[int, bool]] = []
    if mode > 0.45 or not lights:
        openings = [
            (int(rng.integers(2)), bool(rng.integers(2))) for _ in range(int(rng.integers(1, 3)))
        ]
    env = np.zeros_like(d)
    lit = np.full(d.shape, log_uniform(rng, 0.02, 0.2), np.float32)
    total = np.zeros(3)
    for place, half, normal, radiance, disc, _ in lights:
        area = (np.pi if disc else 4) * half[0] * half[1]
        n = normal / np.linalg.norm(normal)
        lit += _lighting(point, axis, side, place, n, area, radiance)
        total += area * np.pi * radiance
    for wall, far in openings:
        total += _window(rng, env, albedo, lit, point, axis, side, size, wall, far)
    surface = 2 * (size[0] * size[1] + size[0] * size[2] + size[1] * size[2])
    mean = np.clip(albedo.reshape(-1, 3).mean(0), 0, 0.8)
    lit += (total * mean / (surface * (1 - mean))).astype(np.float32)
    corner = np.sort(np.minimum(point, size - point), -1)[..., 1]
    lit *= (0.6 + 0.4 * np.clip(corner / 0.8, 0, 1))[..., None]
    env = np.where(env > 0, env, albedo * lit / np.float32(np.pi)).astype(np.float32)
    for place, half, _normal, radiance, disc, vignette in lights:
        to = place - eye
        distance = np.linalg.norm(to)
        face = 1.0 if to[2] < 0.6 * distance or disc else to[2] / distance
        spread = (float(half[0] / distance), float(half[1] / distance * face))
        add_light(env, to, spread, radiance, disc, 0.0, vignette)
    return env


def _ceiling_lamps(
    rng: Rng, size: Array, tint: Array
) -> list[tuple[Array, Array, Array, Array, bool, float]]:
    """A grid of panels or spots, tubes, or one lamp, at the ceiling or hanging."""
    down = np.array([0.0, 0.0, -1.0])
    style = rng.random()
    nx, ny = (int(rng.integers(1, 4)) for _ in range(2))
    if style < 0.35:  # panels
        half, level, disc = np.array([0.3, 0.3]), log_uniform(rng, 20, 150), False
    elif style < 0.55:  # tubes
        half, level, disc = np.array([0.6, 0.04]), log_uniform(rng, 60, 200), False
    elif style < 0.8:  # spots
        r = uniform(rng, 0.015, 0.05)
        half, level, disc = np.array([r, r]), log_uniform(rng, 1e3, 2e4), True
    else:  # one lamp
        r = log_uniform(rng, 0.03, 0.25)
        nx = ny = 1
        half, level, disc = np.array([r, r]), log_uniform(rng, 0.3, 4) / r**2 * 3, True
    drop = 0.02 if style < 0.8 or chance(rng, 0.5) else uniform(rng, 0.3, 1.2)
    lamps = []
    for i in range(nx):
        for j in range(ny):
            if nx * ny > 1 and chance(rng, 0.1):
                continue  # off
            x, y = (i + 0.5) / nx * size[0], (j + 0.5) / ny * size[1]
            place = np.array([x, y, size[2] - drop])
            lamps.append((place, half, down, tint * level * uniform(rng, 0.8, 1.2), disc, 0.2))
    return lamps


def _lighting(
    point: Array,
    axis: NDArray[np.intp],
    side: NDArray[np.bool_],
    place: Array,
    normal: Array,
    area: float,
    radiance: Array,
) -> Array:
    """Irradiance (H, W, 3) that a small flat lamp gives on the walls."""
    to = (place - point).astype(np.float32)
    d2 = np.maximum((to * to).sum(-1), np.float32(0.05))
    wall = np.take_along_axis(to, axis[..., None], -1)[..., 0] * np.where(side, -1, 1)
    lamp = -(to @ normal.astype(np.float32))
    form = np.maximum(wall, 0) * np.maximum(lamp, 0) / d2**2 * np.float32(area)
    return form[..., None] * np.float32(radiance)


def _furnish(
    rng: Rng,
    albedo: Array,
    point: Array,
    axis: NDArray[np.intp],
    side: NDArray[np.bool_],
    size: Array,
) -> Array:
    """Doors, pictures, shelves and cupboards as rectangles of other colours on the walls."""
    for _ in range(int(rng.integers(4, 22))):
        wall, far = int(rng.integers(2)), bool(rng.integers(2))
        along = point[..., 1 - wall]
        x0, w = rng.random() * size[1 - wall], log_uniform(rng, 0.2, 2.0)
        z0 = 0.0 if chance(rng, 0.6) else uniform(rng, 0.8, 2)
        top = z0 + log_uniform(rng, 0.2, 2.0)
        there = (axis == wall) & (side == far) & (np.abs(along - x0) < w / 2)
        there &= (point[..., 2] > z0) & (point[..., 2] < top)
        albedo = np.where(there[..., None], dye(rng, (0.02, 0.6)), albedo)
    return albedo


def _window(
    rng: Rng,
    env: Array,
    albedo: Array,
    lit: Array,
    point: Array,
    axis: NDArray[np.intp],
    side: NDArray[np.bool_],
    size: Array,
    wall: int,
    far: bool,
) -> Array:
    """Open windows in one wall, add their light to ``lit`` and return their flux (3,).

    The sky outside is one of blue, overcast, low sun, dusk; the lower part shows the ground.
    """
    count = int(rng.integers(1, 4))
    w, sill = uniform(rng, 0.5, 1.8), uniform(rng, 0.4, 1.1)
    top = uniform(rng, 0.7, 0.95) * size[2]
    sky = white_balance(log_uniform(rng, 4500, 13000)) * log_uniform(rng, 4, 90)
    ground = sky * colour(rng, (0.05, 0.35), (0.1, 0.6), (0.1, 0.4))
    along, z = point[..., 1 - wall], point[..., 2]
    flux = np.zeros(3)
    for k in range(count):
        x0 = (k + 0.5) / count * size[1 - wall]
        half = min(w / 2, 0.45 * size[1 - wall] / count)
        here = (axis == wall) & (side == far) & (np.abs(along - x0) < half)
        here &= (z > sill) & (z < top)
        bars = np.minimum(np.abs(along - x0), np.abs(z - (sill + top) / 2)) > 0.025
        horizon = sill + uniform(rng, 0.05, 0.6) * (top - sill)
        view = (
            np.where((z > horizon)[..., None], sky, ground)
            * (0.8 + 0.4 * ((z - sill) / (top - sill)))[..., None]
        )
        env[here & bars] = view[here & bars]
        albedo[here & ~bars] = 0.6
        place = np.array([0.0, 0.0, (sill + top) / 2])
        place[wall], place[1 - wall] = (size[wall] if far else 0.0), x0
        normal = np.zeros(3)
        normal[wall] = -1.0 if far else 1.0
        area = 2 * half * (top - sill)
        mean = 0.6 * sky + 0.4 * ground
        lit += _lighting(point, axis, side, place, normal, area, mean)
        flux += np.pi * area * mean
    return flux
