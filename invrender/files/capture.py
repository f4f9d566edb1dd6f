"""A capture folder: photo, rig and pattern, and the truth of synthetic ones."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from invrender.files.images import PHOTOS, Photo, read_image, read_photo
from invrender.files.maps import read_maps
from invrender.files.rig_toml import RigFile, read_rig
from invrender.lights import IDEAL, NO_PATTERN, Device
from invrender.maps import Maps
from invrender.rig import Rig
from invrender.types import Array, InputError, Notice

MIN_PHOTO = 64
MOST_PHOTOS = 20  # of a sample; they add little beyond eight
PATTERN_FILES = "pattern.exr", "pattern.png"


@dataclass(frozen=True)
class Capture:
    """One capture: a photo of the set-up, linear RGB, with its rig and the pattern that was shown.

    ``pattern`` (h, w, 3) is what the display was given, linear values in [0, 1], row 0 at +y
    (`invrender.lights.NO_PATTERN` where the rig has no screen); where
    rig.toml tells the display's curve, black and mixing, they are in it. ``device`` is the dimming
    to the sides that rig.toml tells, for lights that are given; the ball shows it else. ``name`` is
    that of its folder.

    ``fov_from`` says where the rig's field of view is known from: "rig" (rig.toml), "exif", or
    "unknown"; `invrender.capture.sheet` sets "sheet", and ``tilt_deviation``, the expected error of
    the camera's tilt in degrees. ``unknown``: which of the rig's "ball_reflectance" and
    "ball_shape" nobody states, so that they are found in the photo. ``warnings`` tell what is
    doubtful about the files. ``truth`` and ``true_environment`` come with synthetic captures only:
    to measure errors against, never an input.
    """

    photo: Photo
    rig: Rig
    pattern: Array
    truth: Maps | None = None
    true_environment: Array | None = None
    fov_from: str = "rig"
    warnings: tuple[Notice, ...] = ()
    name: str = "capture"
    unknown: frozenset[str] = frozenset()
    tilt_deviation: float | None = None
    device: Device = IDEAL


def load_capture(folder: str | Path) -> Capture:
    """Read a capture folder: ``photo.*``, ``rig.toml``, the pattern, and the truth if there is any.

    ``photo_1.*``, ``photo_2.*`` are exposures of one set-up, and are merged; without a screen each
    has its own light, and `load_set` reads them.

    Raises `InputError`, one sentence, for anything missing, damaged or out of range.

        capture = load_capture("my-capture")
        print(capture.rig.screen_height, capture.photo.image.shape)
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder")
    paths = find_photos(folder)
    if holds_set(folder):
        raise InputError(
            f"{folder} holds {len(paths)} photos, each under its own light: 'invrender refine' "
            "takes them together"
        )
    photos = [read_photo(path) for path in paths]
    for photo, path in zip(photos, paths, strict=True):
        check_photo(photo, str(path))
    photo = photos[0]
    if len(photos) > 1:
        from invrender.files.bracket import merge_bracket  # OpenCV takes 0.2 s to import

        photo = merge_bracket(photos, [p.name for p in paths])
    given = read_rig(folder / "rig.toml", fov=photo.fov)
    pattern = _read_own_pattern(folder, given)
    return _capture(photo, given, pattern, folder.resolve().name, *_read_truth(folder, given))


def _read_own_pattern(folder: Path, given: RigFile) -> Array:
    """The pattern of a folder of one; a rig without a screen has none."""
    if given.rig.has_screen:
        path = _inside(folder, given.files.get("pattern") or _find_pattern(folder))
        return _read_pattern(path, given.device or IDEAL)
    if any((folder / name).is_file() for name in PATTERN_FILES):
        raise InputError(f"{folder} has a pattern, but its rig.toml no [screen]; add it")
    return NO_PATTERN


def _read_pattern(path: Path, device: Device) -> Array:
    """What a display shows of a pattern's file, its dimming to the sides left out."""
    pattern = read_image(path)
    if pattern.min() < 0 or pattern.max() > 1 + 1e-3:
        raise InputError(f"{path}: the pattern must be relative radiance in [0, 1]")
    if not pattern.max() > 0:
        raise InputError(f"{path}: the pattern is all black")
    return np.clip(device.shown(np.clip(pattern, 0, 1)), 0, 1)


def _read_truth(folder: Path, given: RigFile) -> tuple[Maps | None, Array | None]:
    """Maps and environment that come with a synthetic capture."""
    if "sample" not in given.files:
        return None, None
    maps = _inside(folder, given.files["sample"])
    room = maps / "environment.exr"
    return read_maps(maps), read_image(room) if room.is_file() else None


def _capture(
    photo: Photo, given: RigFile, pattern: Array, name: str, truth: Maps | None, room: Array | None
) -> Capture:
    return Capture(
        photo, given.rig, pattern, truth, room, given.fov_from,
        (*photo.warnings, *given.warnings), name, given.unknown,
        device=Device(falloff=(given.device or IDEAL).falloff),
    )  # fmt: skip


def load_set(folder: str | Path) -> tuple[list[Capture], list[Array]]:
    """Read a folder of photos under a set of patterns, or without a screen, each under its own
    light: the captures, and the patterns of which each shows one.

    Its patterns are ``pattern_1.*``, ``pattern_2.*`` and so on, and its photos ``photo_1.*`` and so
    on, in any order. Every capture has the first pattern until `invrender.capture.which_pattern`
    finds its own. A photo that cannot be read is told of in `InputError`.
    """
    folder = Path(folder)
    names = sorted(set_patterns(folder), key=lambda p: (len(p.stem), p.stem))
    captures, patterns = [], []
    paths = find_photos(folder)
    check_count(len(paths), str(folder))
    truth: tuple[Maps | None, Array | None] | None = None
    for path in paths:
        photo = read_photo(path)
        check_photo(photo, str(path))
        given = read_rig(folder / "rig.toml", fov=photo.fov)
        if truth is None:  # all photos are of one sample, under one display
            truth = _read_truth(folder, given)
            patterns = [_read_pattern(p, given.device or IDEAL) for p in names]
            pattern = patterns[0] if patterns else _read_own_pattern(folder, given)
        name = f"{folder.resolve().name}/{path.stem}"
        captures.append(_capture(photo, given, pattern, name, *truth))
    return captures, patterns


def check_count(count: int, name: str) -> None:
    """Raise `InputError` for more photos than are held in memory and explained together."""
    if count > MOST_PHOTOS:
        raise InputError(
            f"{name} has {count} photos, and at most {MOST_PHOTOS} are taken together: leave out "
            "those that are much alike"
        )


def holds_set(folder: Path) -> bool:
    """Whether a folder's photos show several patterns, or each its own light without a screen."""
    if set_patterns(folder):
        return True
    rig = folder / "rig.toml"
    if len(find_photos(folder)) == 1 or not rig.is_file():
        return False
    return not read_rig(rig).rig.has_screen


def set_patterns(folder: Path) -> list[Path]:
    """The files of a set of patterns in a folder; none where it is of one pattern."""
    files = [p for p in folder.iterdir() if re.fullmatch(r"pattern_\d+\.(png|exr)", p.name.lower())]
    return files if len(files) > 1 else []


def find_photos(folder: Path) -> list[Path]:
    """The photo of a capture's folder, ``photo.*``, or its exposures, ``photo_1.*`` and so on.

    All exposures are of one pattern: a bracket (`invrender.files.bracket`).
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in PHOTOS and p.is_file())
    whole = [p for p in files if p.stem.lower() == "photo"]
    parts = [p for p in files if re.fullmatch(r"photo[_-]?\d+", p.stem.lower())]
    found = whole + parts
    if not found:
        raise InputError(f"{folder} has no photo (photo with one of {', '.join(PHOTOS)})")
    if whole and len(found) > 1:
        names = ", ".join(p.name for p in found)
        raise InputError(
            f"{folder} has more than one photo ({names}); leave one, or name the exposures of one "
            "set-up photo_1, photo_2 and so on"
        )
    if len({p.stem.lower() for p in parts}) < len(parts):
        raise InputError(f"{folder} has one exposure as two files; leave one of each")
    return found


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
    for name in PATTERN_FILES:
        if (folder / name).is_file():
            return name
    raise InputError(f"{folder} has no pattern: set [pattern] image in rig.toml")
