"""`rig.toml`: the rig of a capture folder, read and written."""

from __future__ import annotations

import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

from invrender.rig import Rig, Vec3
from invrender.types import InputError

# Section and key of rig.toml for each field of Rig.
_KEYS: dict[tuple[str, str], str] = {
    ("screen", "size"): "screen_size",
    ("screen", "height"): "screen_height",
    ("screen", "shift"): "screen_shift",
    ("screen", "tilt"): "screen_tilt",
    ("camera", "offset"): "camera_offset",
    ("camera", "fov"): "fov",
    ("camera", "shift"): "camera_shift",
    ("camera", "tilt"): "camera_tilt",
    ("ball", "radius"): "ball_radius",
    ("ball", "reflectance"): "ball_reflectance",
}
_FILES = {("pattern", "image"), ("sample", "maps")}
_REQUIRED = [("screen", "size"), ("screen", "height"), ("camera", "offset"), ("ball", "radius")]
_VECTORS = {f.name for f in fields(Rig) if f.type == "Vec3"}


def read_rig(path: Path, *, fov: float | None = None) -> tuple[Rig, dict[str, str]]:
    """Read ``rig.toml``. ``fov`` (from EXIF, say) is taken where the file gives none.

    Returns the rig and the file names it gives: ``{"pattern": ..., "sample": ...}``, where present.
    Raises `InputError` for a missing file, bad TOML, unknown or missing keys, wrong types or sizes.
    """
    try:
        with open(path, "rb") as f:
            table = tomllib.load(f)
    except OSError:
        raise InputError(f"{path} is missing or unreadable; a capture folder needs it") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise InputError(f"{path} is not valid TOML: {e}") from None

    values: dict[str, Any] = {}
    files: dict[str, str] = {}
    for section, entries in table.items():
        if not isinstance(entries, dict):
            raise InputError(f"{path}: {section!r} must be a [section]")
        for key, value in entries.items():
            if (section, key) in _FILES:
                if not isinstance(value, str) or not value:
                    raise InputError(f"{path}: [{section}] {key} must be a file name")
                files[section] = value
            elif (section, key) in _KEYS:
                name = _KEYS[section, key]
                values[name] = _number(path, f"[{section}] {key}", value, name in _VECTORS)
            else:
                known = sorted({k for s, k in [*_KEYS, *_FILES] if s == section})
                hint = f"known keys: {', '.join(known)}" if known else "no such section"
                raise InputError(f"{path}: unknown key {key!r} in section {section!r} ({hint})")
    for section, key in _REQUIRED:
        if _KEYS[section, key] not in values:
            raise InputError(f"{path}: [{section}] {key} is missing")
    if fov is not None:
        values.setdefault("fov", fov)
    return Rig(**values), files


def _number(path: Path, what: str, value: Any, vector: bool) -> float | Vec3:
    def real(v: Any) -> bool:
        return isinstance(v, (int, float)) and not isinstance(v, bool)

    if vector:
        if real(value):
            return (float(value),) * 3
        if isinstance(value, list) and len(value) == 3 and all(map(real, value)):
            return (float(value[0]), float(value[1]), float(value[2]))
        raise InputError(f"{path}: {what} must be a number or a list of three")
    if not real(value):
        raise InputError(f"{path}: {what} must be a number")
    return float(value)


def write_rig(path: Path, rig: Rig, pattern: str = "", sample: str = "") -> None:
    """Write ``rig.toml``; fields at their default are left out, except the four required ones."""
    default = Rig()
    lines: list[str] = []
    section_now = ""
    entries: list[tuple[str, str, str]] = []
    for (section, key), name in _KEYS.items():
        value = getattr(rig, name)
        if (section, key) in _REQUIRED or value != getattr(default, name) or name == "fov":
            text = str(list(value)) if isinstance(value, tuple) else repr(float(value))
            entries.append((section, key, text))
    entries += [("pattern", "image", f'"{pattern}"')] if pattern else []
    entries += [("sample", "maps", f'"{sample}"')] if sample else []
    for section, key, text in entries:
        if section != section_now:
            lines.append(f"[{section}]")
            section_now = section
        lines.append(f"{key} = {text}")
    path.write_text("\n".join(lines) + "\n")
