"""Held-out captures as networks see them: the sample's photo and the lights that a ball shows.

Drawn like training captures (`nets.training.dataset`) from materials and rooms that no training
sees, but rendered by the unbiased estimator, and with flash photos for the methods that need them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.baselines.flash import SIZE, flash_photos
from invrender.capture.sample import Sample
from invrender.lights import IDEAL, Device, Lights
from invrender.maps import Maps, resize_maps
from invrender.pattern.default import default_pattern
from invrender.refine.lobes import read_lobes
from invrender.render.fast.estimator import Fast
from invrender.render.mis import Mis
from invrender.render.scene import make_scene, scene_under
from invrender.rig import Rig
from invrender.sampling import resize
from invrender.sphere import scale_environment
from invrender.types import Array
from nets.batch import Batch, batch_of
from nets.clues import light_inputs, white_level
from nets.training.draw import Options, draw_environment, draw_material, draw_rigs
from nets.training.noise import (
    capture_pattern,
    captured_environment,
    display,
    draw_devices,
    fit_gain,
    sensor,
)

FIRST_SEED = 480_000  # no other benchmark's
SPLITS = ("families", "holdout")  # of `nets.training.draw`, in turn
SAMPLES = 256  # a pixel
ROOM = (0.05, 6.0)  # irradiance of the room over the screen's, as in training
FORM_FACTOR = 0.7  # π times the screen's, seen from the sample's centre


@dataclass(frozen=True)
class Setting:
    """The true light of a capture: what is drawn once for all photos of it."""

    maps: Maps
    known: Rig
    true: Rig
    room: Array
    shown: Array  # what the screen really shows of the default pattern
    seed: int


@dataclass(frozen=True)
class HeldOut:
    """A photo (N, N, 3) of ``maps``, the lights as they are believed to be, what the photo would
    have been under these, and flash photos (`SIZE`, `SIZE`, 3)."""

    maps: Maps
    photo: Array
    lights: Lights
    ideal: Array
    flash: Array
    dark: Array  # the room alone, without the flash

    @property
    def sample(self) -> Sample:
        return Sample(self.photo, np.zeros(self.photo.shape[:2], bool), self.lights)

    def at(self, size: int) -> HeldOut:
        """With maps and photos averaged to ``size`` pixels a side."""
        return replace(
            self,
            maps=resize_maps(self.maps, size, size),
            photo=resize(self.photo, size, size),
            ideal=resize(self.ideal, size, size),
        )

    def batch(self) -> Batch:
        """All methods' input at `SIZE`, in units of a white plane."""
        small = self.at(SIZE)
        inputs = light_inputs(
            self.lights.rig, self.lights.pattern, self.lights.gain, self.lights.environment,
            self.lights.pattern_captured, device=self.lights.device,
        )  # fmt: skip
        unit = white_level(inputs)
        photo = small.photo / np.float32(unit)
        lobes = read_lobes(photo, Fast(scene_under(self.lights, 1 / unit)))
        relative = {k: v if k == "rig" else v / np.float32(unit) for k, v in inputs.items()}
        batch = batch_of(photo, relative, lobes)
        images = {"ideal": small.ideal / unit, "flash": self.flash, "room": self.dark}
        for name, image in images.items():
            channels = np.ascontiguousarray(np.moveaxis(image, -1, 0), np.float32)
            batch[name] = torch.from_numpy(channels)[None]
        return batch


def draw(
    k: int, size: int, materials: Path | None, rooms: Path | None, mosaic: bool = True,
    real_device: bool | None = None,
) -> HeldOut:  # fmt: skip
    """The k-th capture; without folders of procedural material and room.

    mosaic: whether the ball shows the pattern as coarse as in a photo. real_device: whether the
    display dims to the sides and mixes colours, and the ball's account of that is off; None for
    half of them, as in training.
    """
    setting, rng = draw_setting(k, size, materials, rooms)
    found, device = draw_devices(rng)
    while real_device is not None and (device is IDEAL) == real_device:
        found, device = draw_devices(rng)
    return photograph(setting, rng, default_pattern(128), mosaic, found, device)


def draw_setting(
    k: int, size: int, materials: Path | None, rooms: Path | None
) -> tuple[Setting, np.random.Generator]:
    """Material, room, rig and display of the k-th capture, and what else is drawn from."""
    rng = np.random.default_rng([FIRST_SEED, k])
    options = Options(
        size=size, split=SPLITS[k % len(SPLITS)],
        materials=str(materials or ""), envs=str(rooms or ""), procedural=0.0,
    )  # fmt: skip
    known, true = draw_rigs(rng)
    shown = display(rng, default_pattern(128))
    ratio = float(np.exp(rng.uniform(*np.log(ROOM))))
    room = draw_environment(rng, options)
    room = scale_environment(room, float(shown.mean()) * FORM_FACTOR * ratio)
    return Setting(draw_material(rng, options), known, true, room, shown, k), rng


def photograph(
    setting: Setting, rng: np.random.Generator, pattern: Array, mosaic: bool = True,
    found: Device = IDEAL, device: Device = IDEAL,
) -> HeldOut:  # fmt: skip
    """A photo of the setting under a pattern (h, w, 3), which the screen shows as it shows the
    default one: with the same gain and curve."""
    scale = setting.shown.mean() / default_pattern(128).mean()
    default = np.array_equal(pattern, default_pattern(128))
    shown = setting.shown if default else (pattern * scale).astype(np.float32)
    mixed, believed = device.shown(shown), found.shown(pattern)
    gain = fit_gain(mixed, believed, rng)
    captured = capture_pattern(rng, mixed) if mosaic else mixed
    seen = captured_environment(rng, setting.room, float(mixed.max()))
    lights = Lights(
        setting.known, believed, seen, gain, pattern_captured=captured,
        device=Device(falloff=found.falloff),
    )  # fmt: skip
    dimming = Device(falloff=device.falloff)
    true = Mis(make_scene(setting.true, mixed, setting.room, device=dimming))
    meant = Mis(make_scene(setting.true, believed, setting.room, gain, device=lights.device))
    photo = sensor(rng, true.render(setting.maps, SAMPLES, setting.seed))
    ideal = meant.render(setting.maps, SAMPLES, setting.seed)
    inputs = light_inputs(setting.known, believed, gain, seen, device=lights.device)
    ball = inputs["ball"] / np.float32(white_level(inputs))
    flash, dark = flash_photos(resize_maps(setting.maps, SIZE, SIZE), ball, rng)
    return HeldOut(setting.maps, photo, lights, ideal, flash, dark)
