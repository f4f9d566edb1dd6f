"""Simulated captures to judge refinement by: whole path-traced photographs of held-out materials.

Half of the photos are linear EXR, half JPEG of 8 bits, exposed for the screen. The screen hangs a
few millimetres and degrees from where ``rig.toml`` says; the camera stands where it says.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.jpeg import jpeg
from benchmarks.common.results import benchmark_parser
from invrender.data.environments import find_environments, procedural_environment, read_environment
from invrender.data.materials import find_materials, procedural_material, read_material
from invrender.data.simulate import simulate
from invrender.files.capture import Capture
from invrender.files.images import read_image
from invrender.files.rig_toml import read_rig
from invrender.files.write import write_exr
from invrender.lights import Lights
from invrender.maps import Maps, crop_maps, resize_maps, turn_maps
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.sphere import rotate_environment, scale_environment
from nets.training.draw import belongs

Array = NDArray[np.floating[Any]]
GAIN = 2.0  # radiance of the screen's white
SHIFT, TILT = 3e-3, 3.0  # standard deviations, metres and degrees, of the screen's pose


@dataclass(frozen=True)
class CaptureSet:
    """What captures are drawn from.

    split: of `nets.training.draw`, whose real materials and rooms are used, every ``every``-th
    material. first_seed: of all that is drawn, capture k's is k higher; no two benchmarks share
    one. noise: of the sensor, relative, logarithmically uniform between the two. later: by how many
    places further on materials and rooms are drawn: other parts of them, in other pairs.
    """

    split: str
    first_seed: int
    noise: tuple[float, float] = (0.005, 0.005)
    every: int = 1
    later: int = 0

    def noise_of(self, k: int) -> float:
        """The k-th capture's noise, of a pixel at the photo's 99th percentile."""
        low, high = self.noise
        share = np.random.default_rng((self.first_seed, k)).uniform()
        return float(low * (high / low) ** share)

    def choose(self, materials: Path | None, rooms: Path | None) -> tuple[list[Path], list[Path]]:
        """Folders of materials and files of rooms that belong to the split."""
        samples = find_materials(materials) if materials else []
        lights = find_environments(rooms) if rooms else []
        samples = [p for p in samples if belongs(p.name, self.split)][:: self.every]
        return samples, [p for p in lights if belongs(p.stem, self.split)]


PHOTOGRAPHS = CaptureSet("holdout", 90_000)
OTHERS = CaptureSet("families", 1_730_000, noise=(0.002, 0.02), later=261)


def make_captures(
    out: Path, drawn: CaptureSet, count: int, size: int, width: int, spp: int,
    materials: Path | None = None, rooms: Path | None = None,
) -> list[Path]:  # fmt: skip
    """Capture folders ``out``/000 and so on; simulates those that are not there yet.

    size: pixels a side of the maps; width: of the photos; spp: path tracer's samples. Without
    folders, materials and rooms are procedural. Capture k depends on k and these alone.
    """
    folders = [out / f"{k:03d}" for k in range(count)]
    for k, folder in enumerate(folders):
        if folder.exists():
            continue
        maps, room, rng = sample_and_room(k, drawn, size, materials, rooms)
        shift = np.clip(rng.normal(0, SHIFT, 3), -2 * SHIFT, 2 * SHIFT)
        tilt = np.clip(rng.normal(0, TILT, 3), -2 * TILT, 2 * TILT)
        rig = Rig(screen_shift=tuple(shift.tolist()), screen_tilt=tuple(tilt.tolist()))
        quality = int(rng.integers(85, 97)) if k % 2 else None
        make_capture(
            folder, maps, room, rig, default_pattern(), width, spp, k, quality, drawn.noise_of(k)
        )
    return folders


def arguments(doc: str | None, quick: str, count: int) -> argparse.ArgumentParser:
    """The command line of a benchmark on such captures, ``count`` of them unless it says so."""
    parser = benchmark_parser(doc, quick)
    parser.add_argument("--materials", type=Path, help="folder of materials; the held-out are used")
    parser.add_argument("--envs", type=Path, help="folder of environments; the held-out are used")
    parser.add_argument("--count", type=int, default=count)
    return parser


def sample_and_room(
    k: int, drawn: CaptureSet, size: int, materials: Path | None, rooms: Path | None
) -> tuple[Maps, Array, np.random.Generator]:
    """The k-th material and room, and the random numbers of what else is drawn for them."""
    found, found_rooms = drawn.choose(materials, rooms)
    seed = drawn.first_seed + k
    rng = np.random.default_rng(seed)
    k += drawn.later
    maps = _material(found, k, size) if found else procedural_material(seed, size, size)
    if found_rooms:
        n = len(found_rooms)
        room = read_environment(found_rooms[(k + k // n) % n], 256)
        room = rotate_environment(room, float(rng.uniform(0, 2 * np.pi)))
    else:
        room = procedural_environment(seed, 256)
    return maps, scale_environment(room, float(rng.uniform(0.1, 1.0))), rng


def make_capture(
    folder: Path, maps: Maps, room: Array, rig: Rig, shown: Array, width: int, spp: int, seed: int,
    quality: int | None = None, noise: float = 0.005,
) -> None:  # fmt: skip
    """Simulate a capture whose screen shows ``shown``, times `GAIN`, where it should show the
    default pattern; quality: of a JPEG, exposed for the screen; None for linear EXR."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".") as name:
        new = Path(name) / "capture"
        simulate(
            new, maps, room, shown, rig,
            gain=GAIN, width=width, spp=spp, noise=noise, seed=seed,
        )  # fmt: skip
        write_exr(new / "pattern.exr", default_pattern(), half=True)
        if quality:
            to_jpeg(new, quality, GAIN * float(shown.max()))
        os.replace(new, folder)


def true_lights(folder: Path, capture: Capture) -> Lights:
    """The lights that such a capture was simulated with, in its photo's unit."""
    assert capture.true_environment is not None
    room = np.asarray(capture.true_environment, np.float32)
    gain = GAIN if capture.photo.clip_level is None else 1 / float(capture.pattern.max())
    rig = read_rig(folder / "truth" / "rig.toml").rig
    return Lights(rig, capture.pattern, room, gain)


def _material(folders: list[Path], k: int, size: int) -> Maps:
    """The k-th material, whole; another part of it, turned, when its turn comes again."""
    maps = read_material(folders[k % len(folders)])
    again = k // len(folders)
    if again:
        h, w = maps.shape
        maps = crop_maps(maps, h // 4 * (again % 2), w // 4 * (again % 2), h * 3 // 4, w * 3 // 4)
        maps = turn_maps(maps, again)
    return resize_maps(maps, size, size)


def to_jpeg(folder: Path, quality: int, white: float) -> None:
    """Turn a capture's photo into a JPEG in which the screen's image in the ball just fits.

    white: the screen's greatest radiance.
    """
    photo = read_image(folder / "photo.exr")
    scale = np.float32(1 / white)
    (folder / "photo.jpg").write_bytes(jpeg(photo * scale, quality))
    (folder / "photo.exr").unlink()
    room = folder / "truth" / "environment.exr"
    write_exr(room, read_image(room) * scale, half=True)
