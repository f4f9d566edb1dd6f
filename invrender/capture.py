"""A capture folder in; its lights and its sample out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from invrender.clipped import raise_clipped
from invrender.errors import InputError
from invrender.hidden import add_hidden_lamp
from invrender.images import PHOTOS, Photo, read_image, read_photo
from invrender.maps import Maps, read_maps
from invrender.mirror import Ball
from invrender.rig import Rig, read_rig
from invrender.screen import SATURATED, fit_screen
from invrender.unfold import (
    fill_environment,
    lift_veil,
    pixel_grid,
    screen_coordinates,
    trace_ball,
    unfold_environment,
    unfold_pattern,
    window,
)

Array = NDArray[np.floating[Any]]
MIN_PHOTO = 64
MAX_SAMPLES = 8  # of the photo to a pixel of the crop, a side; beyond, the photo is smoothed first

# Residual of the ideal pattern from which the ball shows another pattern, or is none: nine
# hard simulated balls had at most 0.12, nine wrong ones at least 0.29.
NO_PATTERN = 0.22
SURE = 0.75  # confidence from which a ball is one even if its pattern fits as badly
# Shift in sizes of the sample, and tilt in degrees, that an error of the ball's place, a hundredth
# of its radius, cannot explain: a smaller one is taken for such an error.
MOVED = (0.022, 1.0)
TILTED = 1.1  # degrees; a smaller tilt of the camera is taken for an error of the rim's fit


@dataclass(frozen=True)
class Capture:
    """One capture. ``pattern`` (h, w, 3) is the ideal one, relative radiance in [0, 1].

    ``truth`` and ``true_environment`` come with synthetic captures only: to measure errors
    against, never an input.
    """

    photo: Photo
    rig: Rig
    pattern: Array
    truth: Maps | None = None
    true_environment: Array | None = None


@dataclass(frozen=True)
class Lights:
    """The light on the sample, in the photo's radiance units.

    ``environment`` (H, 2H, 3): radiance, filled in behind the screen, nought below the horizon;
    ``coverage`` (H, 2H): the share of each texel that the ball really shows. The screen's radiance
    is ``gain`` (3,) times ``pattern`` (h, w, 3); ``pattern_captured`` is what the ball shows of it,
    rectified. ``fit`` tells how well: ``residual`` of the pattern's fit relative to the gain,
    ``gamma`` the exponent on the pattern that fits best (1: as it should be; the gain is for 1),
    ``blur`` the camera's in pixels, ``pixels`` the number used, ``saturated`` and
    ``room_saturated`` the shares of screen and room in the ball that are saturated,
    ``room_raised`` how many times brighter the saturated lamps were made, ``hidden_lamp`` how many
    times brighter than the filling a part of the room behind the screen was made (1: none),
    ``pattern_residual`` the residual before the screen's pose and curve were fitted,
    ``camera_tilt`` how far the camera is found to look past straight down, in degrees. Where the
    pattern as it should be fits badly, ``pattern`` is as the display really shows it, and ``rig``
    as the screen really hangs; else both are those of the capture, but for the tilt (`level`).
    """

    environment: Array
    coverage: Array
    pattern: Array
    gain: Array
    pattern_captured: Array
    rig: Rig
    fit: dict[str, float] = field(default_factory=dict)


def load_capture(folder: Path) -> Capture:
    """Read a capture folder: ``photo.*``, ``rig.toml``, the pattern, and the truth if there is any.

    Raises `InputError`, one sentence, for anything missing, damaged or out of range.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    names = {"photo" + suffix for suffix in PHOTOS}
    photos = sorted(p for p in folder.iterdir() if p.name.lower() in names and p.is_file())
    if not photos:
        raise InputError(f"{folder} has no photo (photo with one of {', '.join(PHOTOS)})")
    if len(photos) > 1:
        found = ", ".join(p.name for p in photos)
        raise InputError(f"{folder} has more than one photo ({found}); leave one")
    photo = read_photo(photos[0])
    check_photo(photo, str(photos[0]))
    rig, files = read_rig(folder / "rig.toml", fov=photo.fov)
    pattern_path = _inside(folder, files.get("pattern") or _find_pattern(folder))
    pattern = read_image(pattern_path)
    if pattern.min() < 0 or pattern.max() > 1 + 1e-3:
        raise InputError(f"{pattern_path}: the pattern must be relative radiance in [0, 1]")
    if not pattern.max() > 0:
        raise InputError(f"{pattern_path}: the pattern is all black")
    truth = environment = None
    if "sample" in files:
        maps = _inside(folder, files["sample"])
        truth = read_maps(maps)
        if (maps / "environment.exr").is_file():
            environment = read_image(maps / "environment.exr")
    return Capture(photo, rig, np.clip(pattern, 0, 1), truth, environment)


def check_photo(photo: Photo, name: str = "the photo") -> None:
    """Raise `InputError` for a photo that cannot be a capture: too small, or black."""
    if min(photo.height, photo.width) < MIN_PHOTO:
        raise InputError(
            f"{name} is {photo.width} × {photo.height} pixels, too small for a capture"
        )
    if not photo.image.max() > 0:
        raise InputError(f"{name} is all black")


def _inside(folder: Path, name: str) -> Path:
    """A file named in ``rig.toml``; it must lie in the capture's folder."""
    path = folder / name
    try:
        path.exists()  # raises for what is too long, or has a null in it
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError):
        raise InputError(f"{folder}/rig.toml: {name[:40]!r} is no file name") from None
    if not inside:
        raise InputError(f"{folder}/rig.toml: '{name}' leads out of the capture's folder")
    return path


def _find_pattern(folder: Path) -> str:
    for name in ("pattern.exr", "pattern.png"):
        if (folder / name).is_file():
            return name
    raise InputError(f"{folder} has no pattern: set [pattern] image in rig.toml")


def crop_sample(photo: Photo, rig: Rig, size: int = 256) -> Array:
    """The sample's square of the photo as (size, size, 3) radiance, row 0 at +y.

    Each pixel is the mean over its square of the sample when the photo is finer than the crop, and
    interpolated by cubic splines where it is coarser. Raises `InputError` if the sample is not
    whole in the photo.
    """
    if size < 1:
        raise InputError(f"the sample's size must be at least one pixel, got {size}")
    h, w = photo.height, photo.width
    corners = sample_corners(photo, rig)
    low, high = corners.min(0), corners.max(0)
    x0, y0 = np.maximum(np.floor(low).astype(int) - 8, 0)
    x1, y1 = np.minimum(np.ceil(high).astype(int) + 8, [w, h])
    crop = photo.image[y0:y1, x0:x1]
    scale = float((high - low).max()) / size  # photo pixels in one of the crop's
    samples = min(max(1, math.ceil(scale)), MAX_SAMPLES)
    wide = 2 * round((scale / samples - 1) / 2) + 1  # odd, so that nothing moves
    order = 3 if scale < 2 else 1  # the mean over many pixels needs no splines
    pixels = rig.project(rig.sample_points(size * samples, size * samples), h, w)
    at = np.stack([pixels[..., 1] - y0 - 0.5, pixels[..., 0] - x0 - 0.5])
    planes = []
    for c in range(3):
        plane = crop[..., c]
        if wide > 1:
            plane = ndimage.uniform_filter(plane, wide, mode="nearest")
        plane = ndimage.map_coordinates(plane, at, order=order, mode="nearest")
        planes.append(plane.reshape(size, samples, size, samples).mean((1, 3)))
    return np.maximum(np.stack(planes, -1), 0).astype(np.float32)


def crop_mask(photo: Photo, rig: Rig, size: int) -> NDArray[np.bool_]:
    """(size, size): pixels of the sample's crop that a saturated photo pixel touches."""
    corners = sample_corners(photo, rig)
    x0, y0 = np.maximum(np.floor(corners.min(0)).astype(int) - 10, 0)
    x1, y1 = np.ceil(corners.max(0)).astype(int) + 10
    clipped = photo.clipped
    if not clipped[y0:y1, x0:x1].any():
        return np.zeros((size, size), bool)
    mask = np.zeros((*clipped.shape, 3), np.float32)
    mask[y0:y1, x0:x1] = ndimage.maximum_filter(clipped[y0:y1, x0:x1], 3)[..., None]
    return crop_sample(Photo(mask), rig, size)[..., 0] > 0.05


def sample_corners(photo: Photo, rig: Rig) -> Array:
    """The sample's corners in photo pixels, (4, 2), one after another around it.

    Raises `InputError` if the sample is not whole in the photo.
    """
    h, w = photo.height, photo.width
    corners = rig.project(rig.sample_corners, h, w)
    if not (
        np.isfinite(corners).all()
        and (corners >= -0.5).all()
        and (corners <= np.array([w, h]) + 0.5).all()
    ):
        raise InputError("the sample reaches beyond the photo: check the rig's sizes and fov")
    return corners


def not_the_pattern(ball: Ball) -> InputError:
    """What is wrong with a ball whose image of the screen is another's."""
    (x, y), r = ball.centre, ball.radius
    return InputError(
        f"what looks like the mirror ball ({x:.0f}, {y:.0f}, radius {r:.0f} pixels) does not "
        "show the pattern: check that the display shows it the right way round, or give the "
        f"ball by hand, --ball {x:.0f},{y:.0f},{r:.0f} to keep this one"
    )


def level(photo: Photo, rig: Rig, ball: Ball) -> Rig:
    """The rig with its table as it lies in the photo, by the ball's rim (`invrender.rim`).

    A camera that does not look straight down sees the horizon's image off the ball's middle. A
    photo cannot tell a turned camera from a turned table: camera and screen are turned together
    about the ball's centre, so that the ball stays where it is and what the camera sees of the
    screen too. A tilt that the rig tells is kept, and one below `TILTED` not believed; a JPEG's
    rounding hides the horizon too well.
    """
    tilt = ball.camera_tilt
    if tilt is None or any(rig.camera_tilt) or photo.clip_level is not None:
        return rig
    if np.linalg.norm(tilt) < TILTED:
        return rig
    return rig.turned(Rotation.from_rotvec(tilt, degrees=True), np.asarray(ball.position))


def extract_lights(capture: Capture, ball: Ball, height: int = 128) -> Lights:
    """Unfold the ball: the environment (``height`` rows) and the screen's pattern and gain."""
    photo, rig = capture.photo, capture.rig
    if ball.size != (photo.height, photo.width):
        raise InputError("the ball was found in a photo of another size")
    if height < 8 or height % 2:
        raise InputError(f"the environment needs an even height of 8 rows or more, got {height}")
    rig = level(photo, rig, ball)
    tilted = math.degrees(math.acos(min(1.0, float(rig.camera_axes[2, 2]))))
    photo = lift_veil(photo, rig, ball)
    screen = fit_screen(photo, rig, ball, capture.pattern)
    pattern, gain = screen.shown, screen.gain
    shift, tilt = (
        float(np.linalg.norm(np.subtract(getattr(screen.rig, n), getattr(rig, n))))
        for n in ("screen_shift", "screen_tilt")
    )
    if shift > MOVED[0] * rig.sample_size or tilt > MOVED[1]:
        rig = screen.rig
    fit = {
        "residual": screen.residual, "pattern_residual": screen.ideal_residual,
        "gamma": float(np.mean(screen.gamma)), "blur": screen.blur, "pixels": float(screen.pixels),
        "saturated": screen.saturated, "screen_shift": shift, "screen_tilt": tilt,
        "camera_tilt": tilted,
    }  # fmt: skip
    # A display far from its place or with another curve explains a poor ideal fit, if it fits.
    if (
        fit["pattern_residual"] > NO_PATTERN
        and (fit["residual"] > NO_PATTERN or ball.confidence < SURE)
        and ball.confidence < 1
    ):
        raise not_the_pattern(ball)
    fit["room_saturated"] = _room_saturated(photo, rig, ball)
    environment, coverage = unfold_environment(photo, rig, ball, height, blur=screen.blur)
    environment, fit["room_raised"] = raise_clipped(
        photo, rig, ball, pattern, gain, environment, coverage
    )
    environment, fit["hidden_lamp"] = add_hidden_lamp(
        photo, rig, ball, pattern, gain, fill_environment(environment, coverage), coverage
    )
    captured = unfold_pattern(photo, rig, ball, min(256, max(pattern.shape[:2])))
    return Lights(environment, coverage, pattern, gain, captured, rig, fit)


def _room_saturated(photo: Photo, rig: Rig, ball: Ball) -> float:
    """Share of the ball's pixels that show the room, above the horizon, and are saturated."""
    rows, columns = window(ball)
    point, mirrored, seen = trace_ball(rig, ball, pixel_grid(rows, columns))
    room = seen & (mirrored[..., 2] > 0) & ~screen_coordinates(rig, point, mirrored)[2]
    return float(photo.clipped[rows, columns][room].mean()) if room.any() else 0.0


def light_warnings(lights: Lights) -> list[str]:
    """What is doubtful about the lights that a ball shows, a sentence each."""
    warnings = []
    fit = lights.fit
    if fit.get("saturated", 0) > SATURATED:
        warnings.append(
            f"{fit['saturated']:.0%} of the screen is saturated in the ball; its radiance is "
            "guessed from the rest, and likely too low: expose shorter"
        )
    if fit.get("room_saturated", 0) > 0.001:
        warnings.append(
            f"{fit['room_saturated']:.1%} of the room is saturated in the ball; it was made "
            f"{fit.get('room_raised', 1):.1f} times brighter, as the table's shading suggests: "
            "expose shorter, or take a raw photo, to know"
        )
    if fit.get("hidden_lamp", 1) > 1:
        warnings.append(
            "the table's shading tells of a lamp behind the screen, which the ball does not show; "
            "it was made as bright as that suggests: turn the rig, or the lamp off, to know"
        )
    if fit.get("pattern_residual", 0) > NO_PATTERN:
        warnings.append(
            f"the ball shows the pattern only to within {fit['pattern_residual']:.0%}: check "
            "that the display shows this pattern, mirrored and the right way up"
        )
    return warnings
