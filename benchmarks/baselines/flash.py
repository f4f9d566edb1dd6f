"""Flash photos of the captures that the other methods learn from, for those that need a flash.

    python -m benchmarks.baselines.flash --data DIR --out DIR --count 12

copies shards of `nets.training.dataset`, shrunk to `SIZE`, and adds two photos of each capture's
material in its room, taken from straight above without a tablet's light: ``room`` by the room's
light alone, as far as the mirror ball shows it (so the dark tablet hides a part), ``flash`` with a
point light at the camera too. Their unit of radiance is that of a white plane below the flash at
the sample's centre, so the flash's strength is known; that of the room is what the capture has.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import load_file, save_file
from torch import Tensor

from invrender.maps import Maps
from invrender.render.fast.estimator import Fast
from invrender.render.point_lights import relight
from invrender.render.scene import make_scene
from invrender.rig import Rig
from invrender.sphere import directions
from invrender.types import Array
from nets.batch import PIXELS
from nets.training.loader import shards
from nets.training.noise import sensor

# Photos from above the sample's centre, with a flash at the lens.
ABOVE = Rig(camera_shift=(-Rig().camera[0], 0.0, 0.0))
HEIGHT = 2 * ABOVE.screen_height / ABOVE.sample_size  # of camera and flash, in half samples
ROOM_ROWS = 32  # of the equirectangular image of the room, as fine as the ball's
SAMPLES = 32
SIZE = 64  # pixels a side that the methods are trained and compared at
LEAST_ALPHA_SQUARED = 1e-6


def room_of(ball: Array) -> Array:
    """The room (`ROOM_ROWS`, 2·`ROOM_ROWS`, 3) that a ball (3, S, S) of `nets.clues` shows."""
    d = directions(ROOM_ROWS, 2 * ROOM_ROWS)
    half = d + np.array(
        [0, 0, 1], np.float32
    )  # between the direction and the zenith, from where the ball is seen
    half = half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-9)
    size = ball.shape[-1]
    column = np.clip(((half[..., 0] + 1) / 2 * size).astype(int), 0, size - 1)
    row = np.clip(((1 - half[..., 1]) / 2 * size).astype(int), 0, size - 1)
    room = np.moveaxis(ball, 0, -1)[row, column]
    return np.where(d[..., 2:] > 0, room, 0).astype(np.float32)


def flash_photos(maps: Maps, ball: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """(flash, room), each (H, W, 3): see above. ball: in the unit of a white plane."""
    room = Fast(make_scene(ABOVE, None, room_of(ball))).render(maps, SAMPLES)
    flash = relight(maps, ABOVE, np.array([ABOVE.camera]))[0]
    return sensor(rng, room + flash), sensor(rng, room)


def flash_render(theta: Tensor, position: Tensor) -> Tensor:
    """What `relight` makes of a flash at the camera, in torch: radiance (B, 3, H, W).

    theta (B, 9, H, W): diffuse, specular, roughness and slopes; position (B, 2, H, W) as in a
    batch. Light, viewer and half vector are one, so Fresnel's term is k_s and Smith's height-
    correlated one is c/√(c² + α²(1 - c²)) with c = n·v.
    """
    to_camera = torch.cat([-position, torch.full_like(position[:, :1], HEIGHT)], 1)
    square = (to_camera**2).sum(1, keepdim=True)
    normal = torch.cat([theta[:, 7:], torch.ones_like(theta[:, :1])], 1)
    c = (normal * to_camera).sum(1, keepdim=True)
    c = (c * torch.rsqrt((normal**2).sum(1, keepdim=True) * square)).clamp(1e-3, 1)
    a2 = (theta[:, 6:7] ** 4).clamp(min=LEAST_ALPHA_SQUARED)
    d = a2 / (torch.pi * ((a2 - 1) * c * c + 1) ** 2)
    lobe = d / (4 * torch.sqrt(c * c + a2 * (1 - c * c)))
    falloff = torch.pi * HEIGHT**2 / square
    return (theta[:, :3] * (c / torch.pi) + theta[:, 3:6] * lobe) * falloff


def maps_of(stored: Array) -> Maps:
    """A shard's maps (9, H, W), bytes, as `Maps`."""
    values = np.moveaxis(stored.astype(np.float32) / 255, 0, -1)
    xy = values[..., :2] * 2 - 1
    z = np.sqrt(np.maximum(1 - (xy**2).sum(-1, keepdims=True), 1e-4))
    normal = np.concatenate([xy, z], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Maps(values[..., 2:5], values[..., 6:9], values[..., 5], normal)


def shrunk(images: Array) -> Array:
    """Images (..., H, W) averaged down to `SIZE`, of the same type; smaller ones as they are."""
    size = images.shape[-1]
    if size <= SIZE or size % SIZE:
        return images
    k = size // SIZE
    means = images.astype(np.float32).reshape(*images.shape[:-2], SIZE, k, SIZE, k).mean((-3, -1))
    return (np.round(means) if images.dtype == np.uint8 else means).astype(images.dtype)


def add_flash(source: Path, target: Path) -> None:
    """Copy a shard and add the two photos; the same whenever it is done."""
    stored = load_file(source)
    stored = {k: shrunk(v) if k in PIXELS else v for k, v in stored.items()}
    rng = np.random.default_rng(int(source.stem.removeprefix("shard_")))
    pairs = [
        flash_photos(maps_of(m), b.astype(np.float32), rng)
        for m, b in zip(stored["maps"], stored["ball"], strict=True)
    ]
    for i, name in enumerate(("flash", "room")):
        images = np.array([np.moveaxis(p[i], -1, 0) for p in pairs])
        stored[name] = np.ascontiguousarray(np.clip(images, 0, 6e4), np.float16)
    part = target.with_suffix(".part")
    save_file(stored, part)
    part.replace(target)


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(prog="python -m benchmarks.baselines.flash", description=__doc__)
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--count", type=int, default=8, help="shards")
    return p


def main() -> None:
    args = parser().parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for source in shards(args.data)[: args.count]:
        target = args.out / source.name
        if not target.exists():
            add_flash(source, target)
            print(target, flush=True)


if __name__ == "__main__":
    main()
