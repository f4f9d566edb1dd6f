"""The four material maps of a Cook–Torrance SVBRDF, their files and their errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.errors import InputError
from invrender.images import read_image, write_exr

Array = NDArray[np.floating[Any]]
NAMES = ("normal", "diffuse", "roughness", "specular")


@dataclass
class Maps:
    """Material maps of one sample, row 0 at +y.

    diffuse, specular: (H, W, 3) linear albedo in [0, 1]; specular is the Fresnel reflectance f0.
    roughness: (H, W) perceptual, alpha = roughness². normal: (H, W, 3) unit vectors.
    """

    diffuse: Array
    specular: Array
    roughness: Array
    normal: Array

    def __post_init__(self) -> None:
        shape = self.roughness.shape
        if len(shape) != 2 or any(
            m.shape != (*shape, 3) for m in (self.diffuse, self.specular, self.normal)
        ):
            raise InputError(
                "material maps must have one size, got "
                + ", ".join(f"{n} {getattr(self, n).shape}" for n in NAMES)
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.roughness.shape[0], self.roughness.shape[1]

    def encoded(self) -> dict[str, Array]:
        """The maps as files hold them and as errors are measured: normals as n/2 + 1/2."""
        return {
            "normal": self.normal / 2 + 0.5,
            "diffuse": self.diffuse,
            "roughness": self.roughness,
            "specular": self.specular,
        }


def constant_maps(
    height: int,
    width: int,
    diffuse: Any = 0.5,
    specular: Any = 0.04,
    roughness: float = 0.5,
    normal: Any = (0.0, 0.0, 1.0),
) -> Maps:
    """Maps of one material all over."""
    rgb = (height, width, 3)
    return Maps(
        np.broadcast_to(np.float32(diffuse), rgb).copy(),
        np.broadcast_to(np.float32(specular), rgb).copy(),
        np.full((height, width), roughness, np.float32),
        np.broadcast_to(np.float32(normal), rgb).copy(),
    )


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


def write_maps(folder: Path, maps: Maps, *, half: bool = False) -> None:
    """Write the four EXR files into a folder."""
    for name, image in maps.encoded().items():
        write_exr(Path(folder) / f"{name}.exr", image, half=half)


def map_errors(maps: Maps, truth: Maps) -> dict[str, float]:
    """RMSE of each map over pixels and channels, and their ``average``.

    Albedos and roughness linear in [0, 1], normals encoded to [0, 1], as in the literature.
    """
    a, b = maps.encoded(), truth.encoded()
    errors = {n: float(np.sqrt(np.mean((a[n] - b[n]).astype(np.float64) ** 2))) for n in NAMES}
    errors["average"] = sum(errors.values()) / len(NAMES)
    return errors
