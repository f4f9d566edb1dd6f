"""Synthetic captures: a whole photograph by path tracing, in a folder, with its ground truth."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from invrender.data.simulate_camera import developed, seen, to_jpeg
from invrender.data.simulate_setup import Setup
from invrender.files.maps import write_maps
from invrender.files.rig_toml import FOUND_IN_PHOTO, write_rig
from invrender.files.write import write_exr
from invrender.lights import IDEAL, Device, Lamp
from invrender.maps import Maps
from invrender.render.height import displaced as relief_of
from invrender.rig import Rig, fov_of
from invrender.types import Array, InputError

SHEET_PIXELS = 4000.0  # a metre of the printed sheet
# Linear values that the photo's parts have when it is exposed for them.
SAMPLE_LEVEL, SCREEN_LEVEL = 0.75, 0.9
BRIGHTEST_PERCENTILES = 99.0, 99.8  # percentiles of sample and ball that these values are for


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
    device: Device = IDEAL,
    lamps: Sequence[Lamp] = (),
    displaced: bool = False,
) -> None:
    """Path-trace a capture of a material and write it as a new folder, whole or not at all.

    maps: the material, any size; environment: (H, 2H, 3) linear RGB radiance; pattern: (h, w, 3)
    values that ``device`` shows; rig: metres and degrees; gain: radiance of the pattern's white;
    width: of the 4:3 photo; noise: of the sensor, relative to a pixel's value at the photo's 99th
    percentile (shot noise). A rig that is shifted or tilted makes the photo, but ``rig.toml`` gives
    the nominal one, as a person would; the true one and the device go to ``truth/rig.toml``. lamps:
    a photo for each, photo_1.exr and so on. displaced: the sample is a surface of its normals'
    heights, which hides and lights itself; the true normals are then that surface's. Raises
    `InputError` for a folder that is not empty. `simulate_real` draws all that real set-ups have.

        invrender.simulate("new", maps, room, default_pattern(), Rig(), gain=2.0, noise=0.005)
        capture = invrender.load_capture("new")
    """
    from invrender.render.path_traced import photograph

    relief, maps = relief_of(maps, rig.sample_size) if displaced else (None, maps)
    with _new_capture(folder) as new:
        rng = np.random.default_rng(seed)
        for k, lamp in enumerate(lamps or [None]):
            photo = photograph(
                rig, maps, pattern, environment, gain, height=width * 3 // 4, width=width, spp=spp,
                seed=seed + k, device=device, lamp=lamp, relief=relief,
            )  # fmt: skip
            if noise > 0:
                level = max(float(np.percentile(photo, 99)), 1e-12)
                sigma = noise * np.sqrt(np.maximum(photo, 0) * level)
                photo = np.maximum(photo + sigma * rng.standard_normal(photo.shape), 0)
            write_exr(new / (f"photo_{k + 1}.exr" if lamps else "photo.exr"), photo, half=True)
        still = (0.0, 0.0, 0.0)
        nominal = replace(
            rig, screen_shift=still, screen_tilt=still, camera_shift=still, camera_tilt=still
        )
        write_rig(new / "rig.toml", nominal, "pattern.exr", "truth/")
        _write_truth(new, maps, pattern, environment, rig, device)


def simulate_real(
    folder: str | Path,
    maps: Maps,
    environment: Array,
    pattern: Array,
    setup: Setup,
    *,
    width: int = 1280,
    spp: int = 64,
    seed: int = 0,
    displaced: bool = False,
) -> None:
    """Path-trace a capture as people make them, and write it as a new folder, whole or not at all.

    As `simulate`, with the display, ball, table, sheet, lens, sensor and exposures of ``setup``
    (`invrender.data.simulate_setup.draw_setup`): photo.exr, photo.jpg, or photo_1.jpg and so on.
    ``truth`` holds rig.toml with the device, the environment in the first photo's unit of radiance,
    and setup.json with everything that was drawn and, in that unit, the display's ``gain``.

        setup = draw_setup(7, "bracket", sheet=True)
        simulate_real("new", maps, room, default_pattern(), setup)
    """
    height = width * 3 // 4
    rng = np.random.default_rng([seed, width, spp])
    camera = setup.camera
    relief, maps = relief_of(maps, setup.rig.sample_size) if displaced else (None, maps)
    with _new_capture(folder) as new:
        units = []
        for k, for_what in enumerate(setup.exposures):
            rig = setup.rig_of(k)
            light = _light(setup, rig, maps, environment, pattern, width, spp, seed, k, relief)
            light = seen(camera, light, height, width)
            exposure = _exposure(light, rig, for_what)
            values = developed(camera, light, exposure, rng, clip=setup.photos != "raw")
            units.append(exposure)
            name = f"photo_{k + 1}" if len(setup.exposures) > 1 else "photo"
            if setup.photos == "raw":
                write_exr(new / f"{name}.exr", values, half=True)
                continue
            blob = to_jpeg(camera, values, setup.nominal.fov, exposure / units[0])
            (new / f"{name}.jpg").write_bytes(blob)
        unit = units[0]
        write_rig(new / "rig.toml", setup.nominal, "pattern.exr", "truth/", leave=FOUND_IN_PHOTO)
        _write_truth(new, maps, pattern, environment * unit, setup.rig, setup.device)
        told = {**setup.to_dict(), "gain": [g * unit for g in setup.gain], "units": units}
        text = json.dumps(told, indent=1, default=float)
        (new / "truth" / "setup.json").write_text(text + "\n", encoding="utf-8")


def _light(
    setup: Setup, rig: Rig, maps: Maps, environment: Array, pattern: Array, width: int, spp: int,
    seed: int, k: int, relief: Array | None,
) -> Array:  # fmt: skip
    """Radiance at photo k's pixels and around them, as `seen` takes it."""
    from invrender.capture.sheet_layout import capture_sheet, draw_sheet
    from invrender.render.path_traced import photograph

    wide = math.ceil(width * setup.camera.wider / 2) * 2
    high = math.ceil(width * 3 // 4 * setup.camera.wider / 2) * 2
    fov = fov_of(math.tan(math.radians(rig.fov) / 2) * wide / width)
    cover = None
    if setup.sheet:
        sheet = capture_sheet(setup.nominal)
        cover = draw_sheet(sheet, SHEET_PIXELS, setup.ink), sheet.page
    return photograph(
        replace(rig, fov=fov), maps, pattern, environment, setup.gain, height=high, width=wide,
        spp=spp, seed=seed + k, device=setup.device, ball=setup.ball, ball_alpha=setup.ball_alpha,
        cover=cover, table=setup.table, lamp=setup.lamps[k] if setup.lamps else None, relief=relief,
    )  # fmt: skip


def _exposure(light: Array, rig: Rig, for_what: str) -> float:
    """Factor that brings what a photo is exposed for to its level."""
    height, width = light.shape[:2]
    corners = rig.project(rig.sample_corners, height, width)
    (x0, y0), (x1, y1) = corners.min(0).astype(int), corners.max(0).astype(int)
    sample = light[max(y0, 0) : y1, max(x0, 0) : x1]
    x, y = rig.project(rig.ball_centre, height, width)
    r = rig.focal(width) * rig.ball_radius / rig.camera[2] * 2  # it may stand beside its place
    ball = light[max(int(y - r), 0) : int(y + r), max(int(x - r), 0) : int(x + r)]
    low, high = (
        level / max(float(np.percentile(part, share)), 1e-9)
        for part, level, share in zip(
            (sample, ball), (SAMPLE_LEVEL, SCREEN_LEVEL), BRIGHTEST_PERCENTILES, strict=True
        )
    )
    return {"sample": low, "screen": high, "middle": math.sqrt(low * high)}[for_what]


@contextmanager
def _new_capture(folder: str | Path) -> Iterator[Path]:
    """A folder to write a capture to, which becomes ``folder`` when all of it is written."""
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder} exists and is not empty; choose another folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".") as name:
        new = Path(name) / "capture"
        (new / "truth").mkdir(parents=True)
        yield new
        if folder.exists():
            folder.rmdir()
        shutil.move(new, folder)


def _write_truth(
    new: Path, maps: Maps, pattern: Array, environment: Array, rig: Rig, device: Any
) -> None:
    if rig.has_screen:
        write_exr(new / "pattern.exr", pattern, half=True)
    write_rig(new / "truth" / "rig.toml", rig, device=device)
    write_maps(new / "truth", maps, half=True, width=rig.sample_size)
    write_exr(new / "truth" / "environment.exr", environment, half=True)
