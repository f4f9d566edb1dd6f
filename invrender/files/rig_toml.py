"""`rig.toml`: the rig of a capture folder and what is known of its display, read and written."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from invrender.files.write import atomic_path
from invrender.lights import IDEAL, Device
from invrender.rig import BALL_SHAPES, Rig
from invrender.types import InputError, Notice, Vec3

# Section and key of rig.toml for each field of Rig.
_KEYS: dict[tuple[str, str], str] = {
    ("screen", "size"): "screen_size",
    ("screen", "height"): "screen_height",
    ("screen", "shift"): "screen_shift",
    ("screen", "tilt"): "screen_tilt",
    ("screen", "bezel"): "screen_bezel",
    ("camera", "offset"): "camera_offset",
    ("camera", "fov"): "fov",
    ("camera", "shift"): "camera_shift",
    ("camera", "tilt"): "camera_tilt",
    ("camera", "height"): "camera_height",
    ("ball", "radius"): "ball_radius",
    ("ball", "reflectance"): "ball_reflectance",
    ("ball", "shape"): "ball_shape",
    ("sample", "size"): "sample_side",
}
# Keys of the section [device], by which a display that was measured is told.
_DEVICE_FIELDS = tuple(f.name for f in fields(Device))
# Fields of the rig that are measured in the photo where the file does not state them.
FOUND_IN_PHOTO = frozenset({"ball_reflectance", "ball_shape"})
_FILES = {("pattern", "image"), ("sample", "maps")}
_REQUIRED = [("screen", "size"), ("screen", "height"), ("camera", "offset"), ("ball", "radius")]
# And of a rig without a screen: what its size and height stand for else.
_REQUIRED_ALONE = [*_REQUIRED[2:], ("sample", "size"), ("camera", "height")]
# Metres; the largest displays that are sold are 2.6 m wide.
LARGEST_SCREEN = 3.0
_VECTORS = {f.name for f in fields(Rig) if f.type == "Vec3"}


@dataclass(frozen=True)
class RigFile:
    """What ``rig.toml`` says.

    files: the names of the pattern and of the sample's true maps, where given. fov_from: where the
    field of view is known from, "rig" (this file), "exif" or "unknown" (`Rig`'s default stands in).
    warnings: what is doubtful about the numbers. device: the display, where the file tells it.
    unknown: of "ball_reflectance" and "ball_shape"
    what the file does not give, so that it is found in the photo.
    """

    rig: Rig
    files: dict[str, str]
    fov_from: str = "rig"
    warnings: tuple[Notice, ...] = ()
    unknown: frozenset[str] = frozenset()
    device: Device | None = None


def read_rig(path: Path, *, fov: float | None = None) -> RigFile:
    """Read ``rig.toml``. ``fov`` (from EXIF) is taken where the file gives none. A file without the
    sections [screen] and [pattern] is of a rig without a screen.

    Raises `InputError` for a missing file, bad TOML, unknown or missing keys, wrong types or sizes.
    """
    table = _table(path)
    if not table:
        raise InputError(f"{path} is empty: `invrender pattern --device TABLET` writes one")

    values: dict[str, Any] = {}
    files: dict[str, str] = {}
    device: dict[str, Any] = {}
    for section, entries in table.items():
        if not isinstance(entries, dict):
            raise InputError(f"{path}: {section!r} must be a [section]")
        for key, value in entries.items():
            if (section, key) in _FILES:
                if not isinstance(value, str) or not value:
                    raise InputError(f"{path}: [{section}] {key} must be a file name")
                files[section] = value
            elif section == "device" and key in _DEVICE_FIELDS:
                device[key] = _device_value(path, key, value)
            elif (section, key) in _KEYS:
                name, what = _KEYS[section, key], f"[{section}] {key}"
                if name == "ball_shape":
                    if value not in BALL_SHAPES:
                        raise InputError(f"{path}: {what} must be one of {', '.join(BALL_SHAPES)}")
                    values[name] = value
                elif name == "screen_size" and isinstance(value, list):
                    if len(value) != 2 or not all(map(_is_real, value)):
                        raise InputError(f"{path}: {what} must be a number or [width, depth]")
                    values[name] = (float(value[0]), float(value[1]))
                else:
                    values[name] = _number(path, what, value, name in _VECTORS)
            else:
                names = [*_KEYS, *_FILES, *(("device", d) for d in _DEVICE_FIELDS)]
                known = sorted({k for s, k in names if s == section})
                sections = ", ".join(sorted({s for s, _ in names}))
                hint = f"no such section; known are {sections}"
                hint = f"known keys: {', '.join(known)}" if known else hint
                raise InputError(f"{path}: unknown key {key!r} in section {section!r} ({hint})")
    alone = not {"screen", "pattern", "device"} & table.keys()
    for section, key in _REQUIRED_ALONE if alone else _REQUIRED:
        if _KEYS[section, key] not in values:
            needed = ", which a rig without a [screen] needs" if alone else ""
            raise InputError(f"{path}: [{section}] {key} is missing{needed}")
    if alone:
        values |= {"screen_size": None, "screen_height": values["camera_height"]}
    fov_from = "rig" if "fov" in values else "unknown" if fov is None else "exif"
    if fov_from == "exif":
        values["fov"] = fov
    rig = Rig(**values)
    warnings: tuple[Notice, ...] = ()
    width = max(rig.screen_sides) if rig.has_screen else 0.0
    if width > LARGEST_SCREEN:
        warnings = (
            Notice(
                "rig-units",
                f"rig.toml makes the screen {width:g} m wide; its lengths are metres: if "
                "these are millimetres, divide them by 1000",
            ),
        )
    known_display = Device(**device) if device else None
    return RigFile(
        rig, files, fov_from, warnings, FOUND_IN_PHOTO - values.keys(), known_display
    )  # fmt: skip


def _table(path: Path) -> dict[str, Any]:
    """The file's tables; a byte order mark and UTF-16, as Windows writes them, are fine."""
    try:
        blob = Path(path).read_bytes()
    except OSError:
        raise InputError(f"{path} is missing or unreadable; a capture folder needs it") from None
    wide = blob.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = blob.decode("utf-16" if wide else "utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text in UTF-8; save it as that") from None
    text = text.replace("\r", "\n")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        for number, line in enumerate(text.split("\n"), 1):
            comma = re.match(r"[^#\"'\[]*=\s*[^#\"'\[]*?(-?\d+),(\d+)\s*(#.*)?$", line)
            if comma:
                raise InputError(
                    f"{path}, line {number}: write {comma[1]}.{comma[2]} with a point, not "
                    f"{comma[1]},{comma[2]}"
                ) from None
        raise InputError(f"{path} is not valid TOML: {e}") from None


def _is_real(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _device_value(path: Path, key: str, value: Any) -> Any:
    what = f"[device] {key}"
    if key != "mixing":
        return _number(path, what, value, key == "gamma")
    if not isinstance(value, list) or len(value) != 3 or any(map(_is_real, value)):
        raise InputError(f"{path}: {what} must be three lists of three numbers")
    return tuple(_number(path, what, row, True) for row in value)


def _number(path: Path, what: str, value: Any, vector: bool) -> float | Vec3:
    if vector:
        if _is_real(value):
            return (float(value),) * 3
        if isinstance(value, list) and len(value) == 3 and all(map(_is_real, value)):
            return (float(value[0]), float(value[1]), float(value[2]))
        raise InputError(f"{path}: {what} must be a number or a list of three")
    if not _is_real(value):
        quoted = " without quotes, with a point" if isinstance(value, str) else ""
        raise InputError(f"{path}: {what} must be a number{quoted}")
    return float(value)


def write_rig(
    path: Path,
    rig: Rig,
    pattern: str = "",
    sample: str = "",
    device: Device | None = None,
    leave: frozenset[str] = frozenset(),
) -> None:
    """Write `rig_text` as ``rig.toml``."""
    with atomic_path(path) as temporary:
        temporary.write_text(rig_text(rig, pattern, sample, device, leave), encoding="utf-8")


def rig_text(
    rig: Rig,
    pattern: str = "",
    sample: str = "",
    device: Device | None = None,
    leave: frozenset[str] = frozenset(),
) -> str:
    """What ``rig.toml`` says of a rig. Fields at their default are left out where reading takes the
    default, and those of ``leave``, which are to be found in the photo."""
    default = Rig()
    sections: dict[str, list[str]] = {}

    def state(section: str, key: str, value: Any) -> None:
        sections.setdefault(section, []).append(f"{key} = {_text(value)}")

    required = _REQUIRED if rig.has_screen else _REQUIRED_ALONE
    for (section, key), name in _KEYS.items():
        value = getattr(rig, name)
        if section == "screen" and not rig.has_screen:
            continue
        # What would else be looked for in the photo is always stated.
        if name not in leave and (
            (section, key) in required
            or name in FOUND_IN_PHOTO
            or name == "fov"
            or value != getattr(default, name)
        ):
            state(section, key, value)
    for key in _DEVICE_FIELDS if device and rig.has_screen else ():
        if getattr(device, key) != getattr(IDEAL, key):
            state("device", key, getattr(device, key))
    if pattern and rig.has_screen:
        state("pattern", "image", pattern)
    if sample:
        state("sample", "maps", sample)
    return "".join(f"[{name}]\n" + "".join(f"{x}\n" for x in sections[name]) for name in sections)


def _text(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    return repr(float(value))
