"""Synthetic captures: a whole photograph by path tracing, in a folder, with its ground truth."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np

from invrender.files.maps import write_maps
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.maps import Maps
from invrender.rig import Rig
from invrender.types import Array, InputError


def simulate(
    folder: str | Path,
    maps: Maps,
    environment: Array,
    pattern: Array,
    rig: Rig,
    *,
    gain: float = 1.0,
    width: int = 1280,
    spp: int = 64,
    noise: float = 0.0,
    seed: int = 0,
) -> None:
    """Path-trace a capture of a material and write it as a new folder, whole or not at all.

    maps: the material, any size; environment: (H, 2H, 3) linear RGB radiance; pattern: (P, P, 3)
    relative radiance; rig: metres and degrees; gain: radiance of the pattern's white;
    width: of the 4:3 photo; noise: of the sensor, relative to a pixel's value at the photo's 99th
    percentile (shot noise). A rig that is shifted or tilted makes the photo, but ``rig.toml`` gives
    the nominal one, as a person would; the true one goes to ``truth/rig.toml``. Raises `InputError`
    for a folder that is not empty.

        invrender.simulate("new", maps, room, default_pattern(), Rig(), gain=2.0, noise=0.005)
        capture = invrender.load_capture("new")
    """
    from invrender.render.path_traced import photograph

    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} exists and is not empty; choose another folder")
    photo = photograph(
        rig,
        maps,
        pattern,
        environment,
        gain,
        height=width * 3 // 4,
        width=width,
        spp=spp,
        seed=seed,
    )
    if noise > 0:
        rng = np.random.default_rng(seed)
        level = max(float(np.percentile(photo, 99)), 1e-12)
        sigma = noise * np.sqrt(np.maximum(photo, 0) * level)
        photo = np.maximum(photo + sigma * rng.standard_normal(photo.shape), 0)
    nominal = Rig(
        rig.screen_size,
        rig.screen_height,
        rig.camera_offset,
        rig.ball_radius,
        rig.fov,
        rig.ball_reflectance,
    )
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".") as name:
        new = Path(name) / "capture"
        (new / "truth").mkdir(parents=True)
        write_exr(new / "photo.exr", photo, half=True)
        write_exr(new / "pattern.exr", pattern, half=True)
        write_rig(new / "rig.toml", nominal, "pattern.exr", "truth/")
        write_rig(new / "truth" / "rig.toml", rig)
        write_maps(new / "truth", maps, half=True, width=rig.sample_size)
        write_exr(new / "truth" / "environment.exr", environment, half=True)
        if folder.exists():
            folder.rmdir()
        shutil.move(new, folder)
