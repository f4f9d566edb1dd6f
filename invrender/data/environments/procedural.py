"""Procedural environments: rooms, skies, studios and nights with lamps as bright as real ones.

Radiances are in units of about 100 cd/m², a white wall in a lit room: a clear sky is about 40, an
LED panel 30 to 150, a bare bulb or a spot 10³ to 10⁵, the sun 10⁷ on its half degree.
"""

from __future__ import annotations

import numpy as np

from invrender.data.environments.lamps import add_light, white_balance
from invrender.data.environments.rooms import room
from invrender.data.materials.layers import chance, colour, dye, earth, grey, log_uniform, uniform
from invrender.data.materials.noise import Canvas, noise
from invrender.data.materials.patterns import smoothstep
from invrender.sphere import directions, solid_angles
from invrender.types import Array, InputError

Rng = np.random.Generator

KINDS = {"room": 0.5, "sky": 0.22, "studio": 0.18, "night": 0.1}
SUN_RADIUS = np.radians(0.2666)


def procedural_environment(
    seed: int | np.random.Generator, height: int = 128, kind: str | None = None
) -> Array:
    """A made-up environment (height, 2·height, 3), float32 linear radiance.

    The same seed and height give the same bits. ``kind`` is a key of `KINDS`; without it one is
    drawn. Lamps keep their flux at every resolution. Raises `InputError` for an unknown kind.
    """
    if kind is not None and kind not in KINDS:
        raise InputError(f"no kind of environment '{kind}'; there are {', '.join(KINDS)}")
    if height < 4:
        raise InputError(f"an environment must be at least 4 pixels high, got {height}")
    rng = np.random.default_rng(
        seed if not isinstance(seed, np.random.Generator) else seed.integers(0, 2**63)
    )
    weights = np.array(list(KINDS.values()))
    drawn = list(KINDS)[int(rng.choice(len(KINDS), p=weights / weights.sum()))]
    make = {"room": room, "sky": _sky, "studio": _studio, "night": _night}[kind or drawn]
    env = np.maximum(make(rng, height), 1e-5)
    # Cameras take most of the cast out.
    light = np.einsum(
        "hwc,h->c", env[: height // 2], solid_angles(height, 2 * height)[: height // 2]
    )
    cast = (light / light.mean()) ** -uniform(rng, 0.3, 1)
    return (env * cast).astype(np.float32)


# --- skies ----------------------------------------------------------------------------------------


def _sky(rng: Rng, height: int) -> Array:
    """Clear to overcast, sun high to below the horizon, with a skyline and lit ground."""
    d = directions(height, 2 * height)
    canvas = Canvas(height, 2 * height)
    z = np.maximum(d[..., 2], 0)
    elevation = np.radians(uniform(rng, -4, 75))
    azimuth = uniform(rng, 0, 2 * np.pi)
    sun = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    day = float(np.clip((np.degrees(elevation) + 6) / 20, 0.03, 1))
    zenith = white_balance(uniform(rng, 9000, 20000)) * 25 * day
    horizon = white_balance(uniform(rng, 4200, 8000) if day < 1 else uniform(rng, 6000, 9000))
    horizon = horizon * (60 * day * uniform(rng, 0.5, 1.2))
    haze = np.exp(-z * uniform(rng, 2, 8))[..., None]
    sky = zenith * (1 - haze) + horizon * haze
    angle = np.arccos(np.clip(d @ sun.astype(np.float32), -1, 1))
    warm = white_balance(float(np.clip(2000 + 4500 * np.sin(max(elevation, 0)) ** 0.5, 2000, 6000)))
    glow = np.exp(-angle / 0.12) * 6 + np.exp(-angle / 0.5)
    sky = sky + (glow * 25 * day * uniform(rng, 0.3, 1.5))[..., None] * warm

    cover = uniform(rng, -1.8, 2.0)
    at = (d[..., 0] / (z + 0.25)) / 6, (d[..., 1] / (z + 0.25)) / 6
    field = noise(canvas, rng, log_uniform(rng, 4, 14), 6, 0.55, at=at)
    soft = uniform(rng, 0.2, 1)
    cloud = smoothstep(-soft, soft, field + cover)
    white = horizon.mean() * white_balance(uniform(rng, 5500, 7500)) * uniform(rng, 0.5, 2.5)
    shade = np.exp(-0.4 * np.clip(field + cover, -1, 2)) + np.exp(-angle / 0.4) * 1.5
    sky = sky + cloud[..., None] * (white * shade[..., None] - sky)
    env = sky.astype(np.float32)

    through = np.exp(-4 * max(cover, 0) - 2 * max(0.0, cover + 0.8)) if elevation > 0 else 0.0
    # 133,000 lux above the air; air mass dims and reddens what comes through.
    mass = 1 / (max(np.sin(elevation), 0) + 0.05)
    beam = 1330 * np.exp(-0.21 * mass) * through  # irradiance, units of 100 lux
    up = irradiance_of(env, d) + beam * max(np.sin(elevation), 0) * warm
    base = (
        earth(rng, (0.05, 0.4))
        if chance(rng, 0.6)
        else colour(rng, (0.2, 0.3), (0.4, 0.7), (0.05, 0.2))
    )
    ground = base * up / np.pi
    below = d[..., 2] < 0
    phi = np.arctan2(d[..., 1], d[..., 0])
    line = _skyline(rng, phi, height)
    silhouette = (np.arcsin(np.clip(d[..., 2], -1, 1)) < line) & ~below
    facing = 0.35 + 0.4 * np.clip(-(d[..., :2] @ sun[:2].astype(np.float32)), 0, 1)
    texture = np.exp(0.4 * noise(canvas, rng, 30, 4))[..., None]
    env = np.where(below[..., None], ground * texture, env)
    things = colour(rng, (0.05, 0.35), (0.1, 0.6), (0.05, 0.35)) * up / np.pi
    env = np.where(silhouette[..., None], things * facing[..., None] * texture, env)
    env = np.ascontiguousarray(env, np.float32)
    if beam > 0 and np.arcsin(sun[2]) > _skyline(rng, np.array([azimuth]), height, line, phi):
        add_light(env, sun, (SUN_RADIUS, SUN_RADIUS), beam / (np.pi * SUN_RADIUS**2) * warm, True)
    return env


def irradiance_of(env: Array, d: Array) -> Array:
    """Irradiance (3,) on the table, by the midpoint rule (cheap, for shading the ground)."""
    height, width = env.shape[:2]
    weight = np.maximum(d[..., 2], 0) * solid_angles(height, width)[:, None]
    return np.einsum("hw,hwc->c", weight, env)


def _skyline(
    rng: Rng, phi: Array, height: int, line: Array | None = None, known: Array | None = None
) -> Array:
    """Elevation of the skyline, in radians, at azimuths: hills, trees or buildings, or nothing.

    With a known line it is only looked up at ``phi``.
    """
    if line is not None and known is not None:
        row = height // 2
        where = int(np.argmin(np.abs(np.angle(np.exp(1j * (known[row] - phi[0]))))))
        return line[row, where]
    level = uniform(rng, 0, 0.35) if chance(rng, 0.7) else 0.0
    if chance(rng, 0.4):  # buildings
        n = int(rng.integers(6, 40))
        heights = rng.random(n) * 2 * level
        return heights[np.minimum(((phi / (2 * np.pi)) % 1 * n).astype(np.intp), n - 1)]
    waves = np.zeros_like(phi)
    for k in range(1, 40):
        waves = waves + np.cos(k * phi + uniform(rng, 0, 6.3)) * rng.standard_normal() / k**0.8
    return level * np.maximum(0.5 + 0.3 * waves, 0)


# --- studios and nights ---------------------------------------------------------------------------


def _studio(rng: Rng, height: int) -> Array:
    """A dim or white surround with soft boxes, strips, umbrellas and ring lights."""
    d = directions(height, 2 * height)
    canvas = Canvas(height, 2 * height)
    wall = grey(rng, (0.01, 0.6)) * log_uniform(rng, 0.1, 3)
    floor = grey(rng, (0.02, 0.8)) * log_uniform(rng, 0.1, 2)
    env = np.where((d[..., 2] > uniform(rng, -0.1, 0.1))[..., None], wall, floor)
    fade = 0.4 + 0.6 * smoothstep(-0.5, 1.0, d @ _direction(rng, -0.2, 0.9).astype(np.float32))
    at = (d[..., 0] + d[..., 2]) / 4, (d[..., 1] - 0.6 * d[..., 2]) / 4
    env = env * (fade * np.exp(0.3 * noise(canvas, rng, 8, 4, at=at)))[..., None]
    env = np.ascontiguousarray(env, np.float32)
    for _ in range(int(rng.integers(2, 9))):  # stands, cloths, cameras
        size = log_uniform(rng, 0.03, 0.4), log_uniform(rng, 0.05, 0.6)
        patch = np.zeros_like(env)
        add_light(patch, _direction(rng, -0.3, 0.6), size, 1.0, roll=uniform(rng, -0.3, 0.3))
        cover = np.clip(patch[..., :1], 0, 1)
        env = env * (1 - cover) + cover * dye(rng, (0.01, 0.5)) * wall.mean() * 2
    for _ in range(int(rng.integers(1, 6))):
        tint = white_balance(log_uniform(rng, 3000, 9000))
        if chance(rng, 0.1):
            tint = colour(rng, (0, 1), (0.3, 0.95), (1, 2))
        centre = _direction(rng, 0.05, 1.0)
        big = log_uniform(rng, 0.06, 0.6)
        level = log_uniform(rng, 8, 200) * (0.3 / big) ** 0.7
        style = rng.random()
        if style < 0.5:
            add_light(
                env,
                centre,
                (big, big * uniform(rng, 0.4, 1)),
                tint * level,
                roll=uniform(rng, -0.6, 0.6),
                vignette=uniform(rng, 0, 0.4),
            )
        elif style < 0.7:
            add_light(env, centre, (big, big * 0.15), tint * level, roll=uniform(rng, 0, np.pi))
        elif style < 0.9:
            add_light(env, centre, (big, big), tint * level, True, vignette=uniform(rng, 0, 0.8))
        else:  # a bare head
            r = log_uniform(rng, 0.01, 0.05)
            add_light(env, centre, (r, r), tint * log_uniform(rng, 5e2, 2e4), True)
    return env


def _night(rng: Rng, height: int) -> Array:
    """A dark street or room with few small lamps, lit windows, perhaps a moon or candles."""
    d = directions(height, 2 * height)
    canvas = Canvas(height, 2 * height)
    up = np.clip(d[..., 2], -1, 1)
    level = log_uniform(rng, 0.003, 0.3)
    sky = white_balance(log_uniform(rng, 3000, 15000)) * level
    env = sky * (0.4 + np.exp(-4 * np.abs(up)))[..., None]
    at = (d[..., 0] + up) / 4, (d[..., 1] - 0.6 * up) / 4
    env = env * np.exp(0.5 * noise(canvas, rng, 10, 5, at=at))[..., None]
    line = _skyline(rng, np.arctan2(d[..., 1], d[..., 0]), height)
    dark = (np.arcsin(up) < line)[..., None]
    env = np.ascontiguousarray(np.where(dark, env * 0.4, env), np.float32)
    for _ in range(int(rng.integers(0, 30))):  # windows, signs, screens
        size = log_uniform(rng, 0.01, 0.06), log_uniform(rng, 0.01, 0.06)
        tint = (
            white_balance(log_uniform(rng, 2200, 6500))
            if chance(rng, 0.8)
            else colour(rng, (0, 1), (0.5, 0.95), (1, 2))
        )
        add_light(env, _direction(rng, 0.0, 0.35), size, tint * log_uniform(rng, 0.05, 2))
    for _ in range(int(rng.integers(1, 8))):  # lamps
        r = log_uniform(rng, 0.004, 0.04)
        tint = white_balance(log_uniform(rng, 1900, 5000))
        add_light(env, _direction(rng, 0.05, 0.95), (r, r), tint * log_uniform(rng, 20, 3e3), True)
    return env


def _direction(rng: Rng, low: float, high: float) -> Array:
    """A direction, even over the sphere between two heights z."""
    z, phi = uniform(rng, low, high), uniform(rng, 0, 2 * np.pi)
    r = np.sqrt(1 - z * z)
    return np.array([r * np.cos(phi), r * np.sin(phi), z])
