"""The four maps as EXR files in a folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from invrender.files.images import read_image
from invrender.files.write import write_exr
from invrender.maps import NAMES, Maps
from invrender.types import InputError


def read_maps(folder: Path) -> Maps:
    """Read ``diffuse.exr specular.exr roughness.exr normal.exr`` from a folder."""
    maps = {n: read_image(Path(folder) / f"{n}.exr") for n in NAMES}
    normal = maps["normal"] * 2 - 1
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    if not np.all(length > 1e-3):
        raise InputError(f"{folder}/normal.exr has normals of length zero")
    return Maps(
        np.clip(maps["diffuse"], 0, 1),
        np.clip(maps["specular"], 0, 1),
        np.clip(maps["roughness"].mean(-1), 0, 1),
        (normal / length).astype(np.float32),
    )


def write_maps(folder: Path, maps: Maps, *, half: bool = False, width: float | None = None) -> None:
    """Write the four EXR files into a folder; width: of the sample, metres, for their headers."""
    for name, image in maps.encoded().items():
        path = Path(folder) / f"{name}.exr"
        write_exr(path, image, half=half, data=name == "normal", width=width)
