"""Simulated photographs of the whole rig in seconds each, with everything a hand does wrong.

Rays are cast in numpy against table, sample, mirror hemisphere, screen and room; only the sample's
own shading comes from the package's forward model. The mirror is traced here on its own, so that
an error in the package's unfolding shows.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from benchmarks.common.jpeg import jpeg
from benchmarks.common.results import benchmark_parser
from invrender.capture.table import room_irradiance
from invrender.colour import srgb_to_linear
from invrender.data.environments import find_environments, procedural_environment, read_environment
from invrender.data.materials import procedural_material
from invrender.files.images import Photo
from invrender.lights import Device
from invrender.maps import Maps, resize_maps
from invrender.pattern.default import default_pattern
from invrender.render import Fast, make_scene
from invrender.rig import Rig
from invrender.sampling import resize
from invrender.sphere import resample_environment, rotate_environment, scale_environment

Array = NDArray[np.floating[Any]]
Rng = np.random.Generator
TABLES = ("plain", "planks", "cloth", "tiles", "speckle", "procedural")
CLUTTER = ("none", "coins", "rings", "paper", "shadow", "pens")


@dataclass(frozen=True)
class Shot:
    """A photograph and all that is true of it.

    ``rig`` is the true one, ``nominal`` what a person would write down; ``ball`` the centre (3,) of
    the ball in the world, None if there is none; ``shown`` the pattern as the display emits it.
    """

    name: str
    photo: Photo
    nominal: Rig
    rig: Rig
    ball: Array | None
    pattern: Array
    shown: Array
    gain: Array
    environment: Array
    maps: Maps
    sensor: str
    device: Device


def arguments(doc: str | None, count: int, what: str) -> argparse.ArgumentParser:
    """The command line of a benchmark on such photographs, ``count`` of them unless it says so."""
    parser = benchmark_parser(doc, "a few photos")
    parser.add_argument("--count", type=int, default=count, help=f"{what} ({count})")
    parser.add_argument("--rooms", type=Path, help="folder of equirectangular files, for half")
    return parser


# --- what lies on the table ---------------------------------------------------------------------


def table_albedo(rng: Rng, kind: str) -> Array:
    """Albedo (1024, 1024, 3) of the table's 0.8 m around the sample's centre."""
    n = 1024
    y, x = np.mgrid[:n, :n] / n
    base, other = rng.uniform(0.05, 0.7, (2, 3)) ** np.array([1.0, 1.0, 1.2])
    if kind == "plain":
        mix = 0.1 * ndimage.gaussian_filter(rng.standard_normal((n, n)), 60) * 60
    elif kind == "planks":
        wave = ndimage.gaussian_filter(rng.standard_normal((n, n)), (1, 40)) * 20
        mix = 0.5 + 0.5 * np.sin(2 * np.pi * 30 * (y + 0.004 * wave)) + 0.6 * (y * 9 % 1 < 0.04)
    elif kind == "cloth":
        mix = 0.5 + 0.25 * np.sin(x * n * 0.9) + 0.25 * np.sin(y * n * 0.9)
    elif kind == "tiles":
        k = rng.integers(8, 25)
        mix = ((x * k % 1 < 0.06) | (y * k % 1 < 0.06)) * 1.0
        mix = mix + 0.2 * rng.uniform(size=(64, 64))[(y * k).astype(int), (x * k).astype(int)]
    elif kind == "speckle":
        mix = ndimage.gaussian_filter(rng.standard_normal((n, n)), rng.uniform(0.7, 4))
        mix = 0.5 + 0.5 * mix / mix.std()
    else:
        maps = procedural_material(int(rng.integers(1 << 30)), 512, 512)
        return np.tile(np.clip(maps.diffuse + 0.5 * maps.specular, 0.01, 0.9), (2, 2, 1))
    mix = np.clip(mix, 0, 1)[..., None]
    return np.asarray(base * (1 - mix) + other * mix)


def add_clutter(rng: Rng, albedo: Array, kind: str, rig: Rig, spots: int = 5) -> None:
    """Things of about the ball's size, near it, painted into the table's albedo."""
    n = len(albedo)
    y, x = np.mgrid[:n, :n]
    metre = n / 0.8
    centre = np.array([n / 2 + rig.optical_axis_x * metre, n / 2])
    for _ in range(spots if kind in ("coins", "rings", "pens") else 1):
        angle = rng.uniform(0, 2 * np.pi)
        far = rng.uniform(2.3, 6.0) * rig.ball_radius * metre
        cx, cy = centre + far * np.array([np.cos(angle), np.sin(angle)])
        r = rng.uniform(0.7, 1.3) * rig.ball_radius * metre
        d = np.hypot(x - cx, y - cy)
        colour = rng.uniform(0.02, 0.8, 3)
        if kind == "coins":
            albedo[d < r] = colour
            albedo[(d < 0.85 * r) & (d > 0.8 * r)] *= 0.6
        elif kind == "rings":
            albedo[(d < r) & (d > r * rng.uniform(0.6, 0.95))] = colour
        elif kind == "pens":
            t = rng.uniform(0, np.pi)
            across = (x - cx) * np.sin(t) - (y - cy) * np.cos(t)
            albedo[(abs(across) < 0.15 * r) & (d < 8 * r)] = colour
        elif kind == "paper":
            albedo[(x - cx > 0) & (y - cy > 0)] = rng.uniform(0.6, 0.85)
            lines = (x - cx > 5) & (y - cy > 5) & ((y - cy) // 4 % 3 == 0) & (x // 7 % 4 > 0)
            albedo[lines] *= 0.2


# --- light --------------------------------------------------------------------------------------


def _lookup(image: Array, u: Array, v: Array, wrap: bool = False) -> Array:
    """Bilinear look-ups at (column u, row v) in pixels, centres at half."""
    h, w = image.shape[:2]
    u, v = u - 0.5, np.clip(v - 0.5, 0, h - 1.001)
    u = u % w if wrap else np.clip(u, 0, w - 1.001)
    i, j = v.astype(int), u.astype(int)
    fv, fu = (v - i)[..., None], (u - j)[..., None]
    k = (j + 1) % w
    i2 = np.minimum(i + 1, h - 1)
    top = image[i, j] * (1 - fu) + image[i, k] * fu
    return np.asarray(top * (1 - fv) + (image[i2, j] * (1 - fu) + image[i2, k] * fu) * fv)


def incoming(
    rig: Rig, origin: Array, d: Array, environment: Array, screen: Array, falloff: float = 0.0
) -> Array:
    """Radiance (n, 3) along upward rays: the screen where they hit it, else the room."""
    h, w = environment.shape[:2]
    u = np.arctan2(d[:, 1], d[:, 0]) / (2 * np.pi) * w % w
    out = _lookup(environment, u, np.arccos(np.clip(d[:, 2], -1, 1)) / np.pi * h, wrap=True)
    e_x, e_y = rig.screen_edges
    normal = np.cross(e_x, e_y)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((rig.screen_corner - origin) @ normal) / (d @ normal)
        q = origin + t[:, None] * d - rig.screen_corner
        a, b = q @ e_x / (e_x @ e_x), q @ e_y / (e_y @ e_y)
        hit = (t > 0) & (a >= 0) & (a < 1) & (b >= 0) & (b < 1)
    n = len(screen)
    out[hit] = _lookup(screen, a[hit] * n, (1 - b[hit]) * n)
    if falloff:
        cosine = np.abs(d[hit] @ normal) / np.linalg.norm(normal)
        out[hit] *= (cosine**falloff)[:, None]
    return out


def table_irradiance(
    rig: Rig, environment: Array, screen: Array, falloff: float = 0.0, cells: int = 48
) -> Array:
    """Irradiance (cells, cells, 3) over the table's 0.8 m: the screen, and the room past it."""
    x = ((np.arange(cells) + 0.5) / cells - 0.5) * 0.8
    p = np.stack(np.broadcast_arrays(x[None, :], -x[:, None], 0.0), -1)
    k = 12
    light = np.einsum("ijkl,klc->ijc", rig.screen_cosines(p, k, falloff), resize(screen, k, k))
    room = resample_environment(environment, 64)
    return np.asarray(light + room_irradiance(rig, p.reshape(-1, 3), room).reshape(light.shape))


# --- the photograph -----------------------------------------------------------------------------


def cast(
    rig: Rig, ball: Array | None, size: tuple[int, int], table: Array, sample: Array,
    environment: Array, screen: Array, samples: int = 4, falloff: float = 0.0,
) -> Array:  # fmt: skip
    """Linear photo (H, W, 3). ``table``: radiance of its 0.8 m, ``sample``: of the sample."""
    height, width = size
    half = rig.sample_size / 2

    def ground(p: Array) -> Array:
        """Radiance of the table or the sample at points (n, 3) of z = 0."""
        n = len(table)
        out = _lookup(table, (p[:, 0] / 0.8 + 0.5) * n, (0.5 - p[:, 1] / 0.8) * n)
        inside = (np.abs(p[:, :2]) < half).all(-1)
        m = len(sample)
        u, v = p[inside, 0] / (2 * half) + 0.5, 0.5 - p[inside, 1] / (2 * half)
        out[inside] = _lookup(sample, u * m, v * m)
        if ball is not None:  # contact shadow
            d2 = ((p[:, :2] - ball[:2]) ** 2).sum(-1) / rig.ball_radius**2
            out *= (1 - 0.45 / np.maximum(d2, 1) ** 1.5)[:, None]
        return out

    def shade(pixels: Array) -> Array:
        ray = rig.rays(pixels.reshape(-1, 2), height, width)
        out = ground(rig.camera - ray * (rig.camera[2] / ray[:, 2:]))
        if ball is None:
            return out.reshape(*pixels.shape[:-1], 3)
        oc = rig.camera - ball
        b = ray @ oc
        disc = b * b - oc @ oc + rig.ball_radius**2
        point = rig.camera + (-b - np.sqrt(np.maximum(disc, 0)))[:, None] * ray
        hit = np.flatnonzero((disc > 0) & (point[:, 2] > 0))
        p, r = point[hit], ray[hit]
        n = (p - ball) / rig.ball_radius
        m = r - 2 * (r * n).sum(-1, keepdims=True) * n
        up = m[:, 2] > 0
        seen = np.empty_like(p)
        seen[up] = incoming(rig, p[up], m[up], environment, screen, falloff)
        seen[~up] = ground(p[~up] - m[~up] * (p[~up, 2:] / np.minimum(m[~up, 2:], -1e-9)))
        out[hit] = seen * np.asarray(rig.ball_reflectance)
        return out.reshape(*pixels.shape[:-1], 3)

    def block(y0: int, y1: int, x0: int, x1: int, k: int) -> Array:
        ys = y0 + (np.arange((y1 - y0) * k) + 0.5) / k
        xs = x0 + (np.arange((x1 - x0) * k) + 0.5) / k
        image = shade(np.stack(np.broadcast_arrays(xs[None, :], ys[:, None]), -1))
        return np.asarray(image.reshape(y1 - y0, k, x1 - x0, k, 3).mean((1, 3)))

    image = np.empty((height, width, 3), np.float32)
    for y in range(0, height, 128):
        image[y : y + 128] = block(y, min(y + 128, height), 0, width, 1)
    if ball is not None:
        x, y = rig.project(ball, height, width)
        r = rig.focal(width) * rig.ball_radius / rig.camera[2] * 1.4 + 3
        y0, y1 = max(0, int(y - r)), min(height, int(y + r))
        x0, x1 = max(0, int(x - r)), min(width, int(x + r))
        if y1 > y0 and x1 > x0:
            image[y0:y1, x0:x1] = block(y0, y1, x0, x1, samples)
    return image


def filmic(x: Array, shoulder: float) -> Array:
    """A phone's tone curve of linear values: contrast about middle grey, and a shoulder towards
    white (`shoulder` of 0.6 brings white to two thirds)."""
    middle, steep = 0.14, 1.25
    y = middle * np.maximum(x / middle, 0) ** (1 + (steep - 1) * shoulder)
    return np.asarray(y * (1 + shoulder * middle) / (1 + shoulder * y))


def sensor(
    rng: Rng, linear: Array, kind: str, hard: bool, shoulder: float = 0.0
) -> tuple[Photo, str]:
    """Blur, noise and file format. kind: "hdr" (float) or "jpeg" (8 bits, clipped)."""
    blur = float(rng.uniform(0, 1.4 if hard else 0.4)) * linear.shape[1] / 1280
    noise = float(rng.uniform(0.002, 0.02 if hard else 0.005))
    image = ndimage.gaussian_filter(linear, (blur, blur, 0)) if blur > 0.1 else linear.copy()
    level = float(np.percentile(image, 99))
    image += (
        noise * np.sqrt(np.maximum(image, 0) * level) * rng.standard_normal(image.shape, np.float32)
    )
    image = np.maximum(image, 0)
    text = f"blur {blur:.1f}, noise {noise:.3f}"
    if kind == "hdr":
        return Photo(image), text
    quality = int(rng.integers(75, 96))
    if shoulder:
        image = filmic(image, shoulder)
    with Image.open(io.BytesIO(jpeg(image, quality))) as decoded:
        data = np.asarray(decoded)
    table = srgb_to_linear(np.arange(256, dtype=np.float32) / 255)
    return Photo(table[data], float(table[250])), f"{text}, JPEG {quality}"


@cache
def _rooms(folder: Path | None) -> tuple[Path, ...]:
    return tuple(find_environments(folder)) if folder else ()


def hand_held(rng: Rng, rig: Rig, camera: bool, screen: float) -> Rig:
    """The rig as a hand builds it: the camera a few degrees and millimetres off, the screen up to
    ``screen`` of the sample's size and of ten degrees."""
    values = {f: getattr(rig, f) for f in rig.__dataclass_fields__}
    if camera:
        values["camera_tilt"] = tuple(np.clip(rng.normal(0, 1.2, 3), -3, 3))
        values["camera_shift"] = tuple(np.clip(rng.normal(0, 2e-3, 3), -5e-3, 5e-3))
    if screen:
        values["screen_shift"] = tuple(rng.uniform(-1, 1, 3) * screen * 0.1 * rig.sample_size)
        axis = rng.standard_normal(3)
        values["screen_tilt"] = tuple(axis / np.linalg.norm(axis) * rng.uniform(0, 10) * screen)
    return Rig(**values)


def make_shot(
    seed: int, *, kind: str = "hdr", hard: bool = True, camera: bool = True, screen: float = 0.5,
    ball: bool = True, display: bool = True, exposure: float = 1.0, width: int = 1280,
    rooms: Path | None = None, device: Device | None = None, shoulder: float = 0.0,
) -> Shot:  # fmt: skip
    """One photograph; the same seed gives the same one.

    exposure: of a JPEG; at 1 the screen just fits. device: of the display, in place of a gamma.
    shoulder: of a JPEG's tone curve (`filmic`).
    """
    rng = np.random.default_rng(50_000 + seed)
    nominal = Rig(fov=float(rng.uniform(73.7, 80)))
    rig = hand_held(rng, nominal, camera, screen)
    files = _rooms(rooms)
    if files:
        environment = read_environment(files[int(rng.integers(len(files)))], 256)
        environment = rotate_environment(environment, float(rng.uniform(0, 2 * np.pi)))
    else:
        environment = procedural_environment(50_000 + seed, 256)
    gain = rng.uniform(1.5, 3.0) * rng.uniform(0.8, 1.25, 3)
    pattern = default_pattern(256)
    gamma = float(np.exp(rng.uniform(-1, 1) * np.log(2.2))) if display else 1.0
    device = device or Device(gamma=(gamma,) * 3)
    shown = device.shown(pattern)
    screen_light = np.asarray(shown * gain, np.float32)
    environment = scale_environment(environment, float(rng.uniform(0.1, 1.0) * gain.mean() * 0.3))
    table_kind = TABLES[seed % len(TABLES)]
    clutter = CLUTTER[seed // len(TABLES) % len(CLUTTER)] if hard else "none"
    albedo = table_albedo(rng, table_kind)
    add_clutter(rng, albedo, clutter, nominal)
    light = table_irradiance(rig, environment, screen_light, device.falloff)
    wide = ndimage.zoom(light, (len(albedo) / len(light),) * 2 + (1,), order=1)
    if clutter == "shadow":
        y, x = np.mgrid[: len(wide), : len(wide)] / len(wide) - 0.5
        a, c = rng.uniform(0, 2 * np.pi), rng.uniform(-0.03, 0.1)
        wide *= np.where(x * np.cos(a) + y * np.sin(a) > c, 0.45, 1)[..., None]
    maps = resize_maps(procedural_material(70_000 + seed, 256, 256), 256, 256)
    sample = Fast(make_scene(rig, pattern, environment, gain, device=device)).render(maps, 32)
    centre = None
    if ball:
        shift = np.clip(rng.normal(0, 2e-3, 2), -5e-3, 5e-3) if camera else np.zeros(2)
        centre = rig.ball_centre + np.array([*shift, 0.0])
    size = (width * 3 // 4, width)
    linear = cast(
        rig, centre, size, albedo * wide / np.pi, sample, environment, screen_light,
        samples=4 if width < 2500 else 2, falloff=device.falloff,
    )  # fmt: skip
    if (
        centre is not None and hard and rng.uniform() < 0.25
    ):  # glare: a veil over one side of the ball
        x, y = rig.project(centre, *size)
        r = rig.focal(width) * rig.ball_radius / rig.camera[2]
        a = rng.uniform(0, 2 * np.pi)
        x, y = x + r * np.cos(a), y + r * np.sin(a)
        v, u = np.mgrid[: size[0], : size[1]]
        veil = np.exp(-((u - x) ** 2 + (v - y) ** 2) / (0.4 * r) ** 2)
        linear += (veil * np.percentile(linear, 95) * 2)[..., None].astype(np.float32)
    if kind == "jpeg":  # exposed for the screen: what is brighter in the room clips
        scale = np.float32(exposure * rng.uniform(0.7, 0.95) / (0.9 * gain.max()))
        linear, gain, environment = linear * scale, gain * scale, environment * scale
    photo, how = sensor(rng, linear, kind, hard, shoulder)
    return Shot(
        f"{seed:03d} {table_kind}, {clutter}", photo, nominal, rig, centre, pattern, shown, gain,
        environment, maps, how, device,
    )  # fmt: skip
