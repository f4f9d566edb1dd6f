"""A result: maps, how sure they are, their light and the photo; kept in a folder."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from invrender.files.images import read_image
from invrender.files.maps import read_maps, write_maps
from invrender.files.rig_toml import read_rig, write_rig
from invrender.files.write import write_exr, write_png
from invrender.lights import IDEAL, NO_PATTERN, Device, Lights, NearLamp
from invrender.maps import NAMES, Estimate, Maps
from invrender.report.report import Report
from invrender.types import Array, InputError

SAMPLES = 256  # of the specular lobe in the rendering that is kept
# What is a number in `Report.capture_fit` but of the ball, not of the lights' fit.
_BALL = ("ball_radius", "ball_confidence")
PATTERNS = "shown", "captured"
LAMP_FILES = "near_lamp.exr", "near_lamp.json"  # its share of the environment; where it is
MAY_LACK = ("coverage.exr", *LAMP_FILES, *(f"pattern_{k}.exr" for k in PATTERNS))


@dataclass(frozen=True)
class Result:
    """What `invrender.reconstruct` finds of a sample.

    estimate: the maps and how sure they are. lights: what they were found under, in the photo's
    unit of radiance. photo: the sample as the photo shows it, (N, N, 3) linear RGB. rendering: the
    maps under these lights, likewise, where that is at hand. report: what the run measured.

        result = invrender.Result.load("out")
        relit = result.render(replace(result.lights, environment=room))
    """

    estimate: Estimate
    lights: Lights
    photo: Array
    report: Report
    rendering: Array | None = None

    @property
    def maps(self) -> Maps:
        """The maps of the estimate."""
        return self.estimate.maps

    def render(
        self, lights: Lights | None = None, *, samples: int = SAMPLES, seed: int = 0
    ) -> Array:
        """Image (N, N, 3) of the maps, linear RGB radiance, under these lights or others."""
        from invrender.render.image import render

        return render(self.maps, lights or self.lights, samples=samples, seed=seed)

    def mitsuba_scene(self) -> dict[str, Any]:
        """The sample under its lights, a description for `mitsuba.load_dict`; see
        `invrender.render.path_traced.scene_dict`.

            scene = mitsuba.load_dict(result.mitsuba_scene())
        """
        from invrender.render.path_traced import scene_dict

        return scene_dict(self.maps, self.lights)

    def save(self, folder: str | Path) -> None:
        """Write all of it to a folder (docs: "A result's files"), whole or not at all.

        What else is in the folder stays; a result that is there is replaced, its report last.
        Raises `InputError` where the folder cannot be written.
        """
        out = Path(folder)
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            place = out if out.exists() else out.parent
            with tempfile.TemporaryDirectory(dir=place, prefix=".") as name:
                new = Path(name) / "result"
                new.mkdir()
                self._write(new)
                if not out.exists():
                    new.rename(out)
                    return
                # Without its report a folder is no result: neither the old one nor the new.
                (out / "report.json").unlink(missing_ok=True)
                # What a result may lack: an older result's would be read as its own.
                for lacking in MAY_LACK:
                    if not (new / lacking).exists():
                        (out / lacking).unlink(missing_ok=True)
                order = {"sample.exr": 0, "report.json": 2}  # the first tells it from a capture
                for file in sorted(new.iterdir(), key=lambda f: order.get(f.name, 1)):
                    os.replace(file, out / file.name)
        except OSError as error:
            raise InputError(f"{out} cannot be written: {error.strerror or error}") from None

    def _write(self, folder: Path) -> None:
        from invrender.report.page import report_html, white_level

        maps, sigma, lights, photo = self.maps, self.estimate.sigma, self.lights, self.photo
        rendering = self.render() if self.rendering is None else self.rendering
        screen: Array | None = lights.pattern_captured
        if not lights.rig.has_screen:
            screen = None
        elif screen is None:
            screen = lights.shown * np.asarray(lights.gain, np.float32)
        width = lights.rig.sample_size
        white = white_level(photo)
        # Grey where they agree; a tenth of white away from black or white.
        difference = np.clip(0.5 + (rendering - photo) * np.float32(5 / white), 0, 1)

        def page() -> None:
            shown = (lights.environment, screen, photo, rendering)
            html = report_html(self.report, maps, sigma, *shown)
            (folder / "report.html").write_text(html, encoding="utf-8")

        def exr(name: str, image: Array, **how: Any) -> Callable[[], object]:
            return partial(write_exr, folder / f"{name}.exr", image, **how)

        def png(name: str, image: Array, **how: Any) -> Callable[[], object]:
            return partial(write_png, folder / f"{name}.png", image, **how)

        calls: list[Callable[[], object]] = [
            page,
            partial(write_maps, folder, maps, width=width),
            *(exr(f"sigma_{k}", image, data=True, width=width) for k, image in sigma.items()),
            *(png(k, image, linear=k in ("normal", "roughness"))
              for k, image in maps.encoded().items()),
            exr("sample", photo, width=width),
            png("photo", photo, white=white),
            png("render", rendering, white=white),
            png("difference", difference, coded=True),
            exr("environment", lights.environment),
        ]  # fmt: skip
        if screen is not None:
            calls += [exr("pattern_shown", lights.shown), exr("pattern_captured", screen)]
        if lights.coverage is not None:
            calls.append(exr("coverage", lights.coverage))
        with ThreadPoolExecutor(2) as both:  # encoding leaves the interpreter's lock
            for call in [both.submit(c) for c in calls]:
                call.result()
        # The pattern is saved as it is shown: only the dimming to the sides is left to tell.
        falloff = Device(falloff=lights.device.falloff)
        write_rig(folder / "rig.toml", lights.rig, device=falloff)
        if lights.near is not None:
            write_exr(folder / LAMP_FILES[0], lights.near.share, data=True)
            where = {k: list(getattr(lights.near, k)) for k in ("place", "seen_from")}
            (folder / LAMP_FILES[1]).write_text(json.dumps(where) + "\n", encoding="utf-8")
        (folder / "report.json").write_text(
            json.dumps(self.report.to_dict(), indent=2) + "\n", encoding="utf-8"
        )

    @classmethod
    def load(cls, folder: str | Path) -> Result:
        """Read a result that `save` or ``invrender refine`` wrote.

        Raises `InputError` for a folder that holds no whole result, or a damaged one.
        """
        folder = Path(folder)
        report = Report.read(folder)
        maps = read_maps(folder)
        sigma = {name: read_image(folder / f"sigma_{name}.exr") for name in NAMES}
        sigma |= {name: sigma[name][..., 0] for name in ("normal", "roughness")}
        coverage = folder / "coverage.exr"
        fit = dict(report.capture_fit)
        gain = np.asarray(fit.pop("gain"), np.float32)
        told = read_rig(folder / "rig.toml")
        shown = captured = None
        if told.rig.has_screen:
            shown, captured = (read_image(folder / f"pattern_{k}.exr") for k in PATTERNS)
        lights = Lights(
            told.rig,
            NO_PATTERN if shown is None else shown,
            read_image(folder / "environment.exr"),
            gain,
            read_image(coverage)[..., 0] if coverage.exists() else None,
            captured,
            {k: v for k, v in fit.items() if k not in _BALL and isinstance(v, float)},
            told.device or IDEAL,
            near=_read_near_lamp(folder),
        )
        return cls(Estimate(maps, sigma), lights, read_image(folder / "sample.exr"), report)


def _read_near_lamp(folder: Path) -> NearLamp | None:
    image, where = (folder / name for name in LAMP_FILES)
    if not image.exists():
        return None
    try:
        told = json.loads(where.read_text(encoding="utf-8"))
        place, seen = (np.array(told[k], float) for k in ("place", "seen_from"))
        if place.shape != (3,) or seen.shape != (3,) or not np.isfinite([place, seen]).all():
            raise ValueError
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{where} is missing or damaged; run 'invrender refine' again") from None
    return NearLamp(tuple(place.tolist()), tuple(seen.tolist()), read_image(image)[..., 0])
