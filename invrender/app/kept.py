"""What was found in a photo as a file that holds numbers and words alone: safetensors."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save_file

from invrender.capture.ball import Ball
from invrender.capture.lights import FoundLights
from invrender.capture.sheet import FoundSheet
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.lights import Device, Lights
from invrender.maps import Maps
from invrender.rig import Rig
from invrender.types import Array, Notice

TYPES = {
    t.__name__: t
    for t in (FoundLights, Capture, Photo, Rig, Lights, Device, Ball, FoundSheet, Notice, Maps)
}
SEQUENCES = {"tuple": tuple, "set": set, "frozenset": frozenset}


def write_found(path: Path, sources: Any, found: Any) -> None:
    """Write ``found``, `FoundLights` of one photo, with the JSON values that it depends on."""
    arrays: dict[str, Array] = {}
    data = json.dumps({"sources": sources, "found": _packed(found, arrays)})
    save_file(arrays, path, {"json": data})


def read_found(path: Path, sources: Any) -> Any:
    """What `write_found` wrote; None where that was for other ``sources``. Raises `OSError` or
    `ValueError` for other files."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, "numpy") as file:
            data = json.loads(file.metadata()["json"])
        if data["sources"] != json.loads(json.dumps(sources)):
            return None
        return _unpacked(data["found"], load_file(path))
    except (SafetensorError, KeyError, TypeError) as error:
        raise ValueError(f"{path} does not hold what was found in a photo") from error


def _packed(value: Any, arrays: dict[str, Array]) -> Any:
    if isinstance(value, np.ndarray):
        name = str(len(arrays))
        arrays[name] = np.ascontiguousarray(value)
        return {"array": name}
    if isinstance(value, np.generic):
        return value.item()
    if is_dataclass(value):
        parts = {f.name: _packed(getattr(value, f.name), arrays) for f in fields(value)}
        return {"type": type(value).__name__, "fields": parts}
    if isinstance(value, dict):
        return {"items": [[_packed(k, arrays), _packed(v, arrays)] for k, v in value.items()]}
    if isinstance(value, Path):
        return {"path": str(value)}
    for name, kind in SEQUENCES.items():
        if isinstance(value, kind):
            return {"sequence": name, "of": [_packed(v, arrays) for v in value]}
    if isinstance(value, list):
        return [_packed(v, arrays) for v in value]
    return value


def _unpacked(value: Any, arrays: dict[str, Array]) -> Any:
    if isinstance(value, list):
        return [_unpacked(v, arrays) for v in value]
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    if "type" in value:
        parts = {k: _unpacked(v, arrays) for k, v in value["fields"].items()}
        return TYPES[value["type"]](**parts)
    if "path" in value:
        return Path(value["path"])
    if "sequence" in value:
        return SEQUENCES[value["sequence"]](_unpacked(v, arrays) for v in value["of"])
    return {_unpacked(k, arrays): _unpacked(v, arrays) for k, v in value["items"]}
