"""What to do better next time, from what was found in a photo."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from invrender.capture.camera import corners
from invrender.capture.lights import FoundLights
from invrender.capture.settings import SCREEN_FIT
from invrender.lights import Lights
from invrender.sampling import resize_pattern
from invrender.sphere import irradiance
from invrender.types import Notice

Said = Iterator[tuple[str, str]]  # a code and its sentence


@dataclass(frozen=True)
class Wanted:
    """From which numbers on a capture is good enough not to be advised on."""

    # Pixels across the sample: twice the maps' own by default.
    sample_pixels: float = 512.0
    # Pixels of the ball's radius; it is fitted at 64, and not below 10
    # (`invrender.capture.settings.BallSearch`).
    ball_pixels: float = 40.0
    # Of saturation, the sample's brightest tenth: in 8 bits and sRGB, 5% is level 63 of 255, from
    # which a step is 3% of the value. And what it should be, and by how many times at most.
    sample_level: float = 0.05
    sample_aim: float = 0.3  # by hand
    most_longer: float = 64.0  # by hand
    # Share of the sample's light that the pattern gives; it was designed for 0.2 or more.
    pattern_share: float = 0.3
    camera_tilt: float = 5.0  # degrees; by hand
    screen_shift: float = 0.1  # of its size; as `invrender.report.notices.FAR_OFF`
    screen_tilt: float = 5.0  # degrees; by hand
    fov_deviation: float = 1.0  # degrees; by hand
    reflectance_deviation: float = 0.03  # of its logarithm, and so of every albedo; by hand
    markers: int = 12  # of the capture sheet's, of about 36; by hand
    coverage: float = 0.5  # share of the sky that the ball shows; by hand


WANTED = Wanted()


def screen_light(lights: Lights) -> float:
    """Irradiance of the middle of the sample by the screen, the mean of the channels."""
    shown = resize_pattern(lights.shown, 32).mean(-1)
    cosines = lights.rig.screen_cosines(np.zeros(3), 32, lights.device.falloff)
    return float(np.mean(lights.gain) * (shown * cosines).sum())


def pattern_share(lights: Lights) -> float:
    """Share of the light on the middle of the sample that comes from the screen, in [0, 1]."""
    screen = screen_light(lights)
    room = float(irradiance(lights.environment).mean())
    return screen / max(screen + room, 1e-30)


def sky_shown(lights: Lights) -> float:
    """Share of the sky's solid angle that the ball shows, in [0, 1]."""
    assert lights.coverage is not None
    sky = lights.coverage[: len(lights.coverage) // 2]
    sine = np.sin((np.arange(len(sky)) + 0.5) * math.pi / len(lights.coverage))
    return float((sky.mean(1) * sine).sum() / sine.sum())


def advice(found: FoundLights) -> list[Notice]:
    """What a person can do better next time; a good capture needs nothing.

    Notices say what is wrong with this photo; advice is about the next one. Thresholds: `Wanted`.
    """
    parts = _exposure, _sizes, _light, _rig, _sheet
    return [Notice(code, text) for part in parts for code, text in part(found)]


def _exposure(found: FoundLights) -> Said:
    photo, rig = found.capture.photo, found.lights.rig
    if photo.clip_level is None:
        return
    at = corners(photo, rig)
    low, high = np.floor(np.clip([at.min(0), at.max(0)], 0, None)).astype(int)
    seen = photo.image[low[1] : high[1] + 1, low[0] : high[0] + 1]
    brightest = np.maximum(np.maximum(seen[..., 0], seen[..., 1]), seen[..., 2])
    level = float(np.quantile(brightest, 0.9)) / photo.clip_level if seen.size else 1.0
    dark = level < WANTED.sample_level
    if dark:
        times = WANTED.sample_aim / max(level, WANTED.sample_aim / WANTED.most_longer)
        yield (
            "expose-longer",
            f"the sample is dark, {level:.1%} of what the photo can hold: expose about {times:.0f} "
            "times longer; that saturates the pattern in the ball, but the capture sheet's paper "
            "shows its brightness too",
        )
    if dark or found.lights.fit.get("saturated", 0) > SCREEN_FIT.saturated:
        yield "take-raw", "take camera raw: it holds the bright pattern and the dark sample"


def _sizes(found: FoundLights) -> Said:
    at = corners(found.capture.photo, found.lights.rig)
    side = float(np.linalg.norm(np.roll(at, -1, 0) - at, axis=-1).mean())
    if side < WANTED.sample_pixels:
        yield (
            "go-closer",
            f"the sample is only {side:.0f} pixels wide, and maps show no finer detail: use the "
            "camera's full resolution, or go closer",
        )
    if found.ball is not None and found.ball.radius < WANTED.ball_pixels:
        yield (
            "larger-ball",
            f"the ball's radius is only {found.ball.radius:.0f} pixels: use the camera's full "
            "resolution, or a larger ball",
        )


def _light(found: FoundLights) -> Said:
    share = pattern_share(found.lights)
    if found.lights.rig.has_screen and share < WANTED.pattern_share:
        yield (
            "darken-room",
            f"the pattern gives {share:.0%} of the light on the sample: full brightness on the "
            "display, and less light in the room, tell more about the material",
        )
    if found.lights.coverage is not None and sky_shown(found.lights) < WANTED.coverage:
        yield (
            "free-the-ball",
            f"the ball shows {sky_shown(found.lights):.0%} of the room: keep phone, hands and head "
            "out of its view, or hang the display higher",
        )
    deviation = found.lights.fit.get("ball_reflectance_deviation", 0.0)
    if deviation > WANTED.reflectance_deviation:
        yield (
            "state-reflectance",
            "measure the ball's reflectance once, and set [ball] reflectance in rig.toml: every "
            f"albedo is uncertain by {deviation:.0%} as it is",
        )


def _rig(found: FoundLights) -> Said:
    rig, fit = found.lights.rig, found.lights.fit
    if rig.off_nadir > WANTED.camera_tilt:
        yield "hold-level", f"the camera is tilted by {rig.off_nadir:.0f}°: look straight down"
    if fit.get("screen_tilt", 0) > WANTED.screen_tilt:
        tilt = fit["screen_tilt"]
        yield "level-display", f"the display hangs {tilt:.0f}° off level: rest it on equal feet"
    shift = fit.get("screen_shift", 0)
    if shift and shift > WANTED.screen_shift * max(rig.screen_sides):
        yield (
            "measure-display",
            f"the display hangs {1000 * shift:.0f} mm from where rig.toml says: "
            "measure its height above the sample and the gap to the lens again",
        )


def _sheet(found: FoundLights) -> Said:
    sheet = found.sheet
    if sheet is None:
        yield (
            "use-sheet",
            "print the capture sheet, page 2 of 'invrender pattern -o guide.pdf': it tells where "
            "the camera was and how bright the light is",
        )
    elif len(sheet.ids) < WANTED.markers:
        yield (
            "show-markers",
            f"only {len(sheet.ids)} of the capture sheet's markers are to be seen: keep its whole "
            "ring in the picture and nothing on it",
        )
    unsure = sheet is not None and sheet.fov_deviation > WANTED.fov_deviation
    if unsure or found.capture.fov_from == "unknown":
        yield "state-fov", "set [camera] fov in rig.toml, or leave the photo its EXIF data"
