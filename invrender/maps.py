"""The four material maps of a Cook–Torrance SVBRDF, their files and their errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from invrender.sampling import resize
from invrender.types import Array, InputError


def unit_normals(normal: Array) -> Array:
    """Unit vectors, none below the surface."""
    normal = normal.copy()
    normal[..., 2] = np.maximum(normal[..., 2], 1e-3)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)


def resize_maps(maps: Maps, height: int, width: int) -> Maps:
    """Resize by area averages; normals are averaged and made unit again."""
    if maps.shape == (height, width):
        return maps
    return Maps(
        resize(maps.diffuse, height, width),
        resize(maps.specular, height, width),
        resize(maps.roughness, height, width),
        unit_normals(resize(maps.normal, height, width)),
    )


def crop_maps(maps: Maps, top: int, left: int, height: int, width: int) -> Maps:
    """A rectangle of pixels, copied. Raises `InputError` when it does not lie inside."""
    h, w = maps.shape
    if min(top, left) < 0 or top + height > h or left + width > w or min(height, width) < 1:
        raise InputError(f"a crop of {width} × {height} at ({left}, {top}) is not inside {w} × {h}")
    at = slice(top, top + height), slice(left, left + width)
    return Maps(*(m[at].copy() for m in (maps.diffuse, maps.specular, maps.roughness, maps.normal)))


def turn_maps(maps: Maps, quarters: int = 0, mirror: bool = False) -> Maps:
    """Turn counter-clockwise by quarters, after mirroring left to right; normals turn along."""
    normal = maps.normal
    images = [maps.diffuse, maps.specular, maps.roughness]
    if mirror:
        images = [i[:, ::-1] for i in images]
        normal = normal[:, ::-1] * np.array([-1, 1, 1], np.float32)
    images = [np.rot90(i, quarters) for i in images]
    normal = np.rot90(normal, quarters)
    for _ in range(quarters % 4):
        normal = np.stack([-normal[..., 1], normal[..., 0], normal[..., 2]], -1)
    d, s, r = (np.ascontiguousarray(i, np.float32) for i in images)
    return Maps(d, s, r, np.ascontiguousarray(normal, np.float32))


def rotate_maps(maps: Maps, angle: float, size: int) -> Maps:
    """Turn counter-clockwise by any angle in radians and keep the central size × size pixels.

    Raises `InputError` if the turned square does not fit inside the maps.
    """
    h, w = maps.shape
    c, s = np.cos(angle), np.sin(angle)
    if size < 1 or size * (abs(c) + abs(s)) > min(h, w) + 1e-6:
        raise InputError(f"a square of {size} pixels does not fit into {w} × {h} turned so far")
    x = np.arange(size) - (size - 1) / 2
    px, py = np.meshgrid(x, -x)  # right and up, from the centre
    columns = (w - 1) / 2 + c * px + s * py
    rows = (h - 1) / 2 - (c * py - s * px)

    def sample(image: Array) -> Array:
        if image.ndim == 3:
            return np.stack([sample(image[..., i]) for i in range(image.shape[2])], -1)
        return map_coordinates(image, [rows, columns], order=1, mode="nearest").astype(np.float32)

    n = sample(maps.normal)
    n = np.stack([c * n[..., 0] - s * n[..., 1], s * n[..., 0] + c * n[..., 1], n[..., 2]], -1)
    return Maps(
        sample(maps.diffuse), sample(maps.specular), sample(maps.roughness), unit_normals(n)
    )


NAMES = ("normal", "diffuse", "roughness", "specular")


@dataclass
class Maps:
    """Material maps of one sample, row 0 at +y.

    diffuse, specular: (H, W, 3) linear albedo in [0, 1]; specular is the Fresnel reflectance f0.
    roughness: (H, W) perceptual, alpha = roughness². normal: (H, W, 3) unit vectors. Raises
    `InputError` where the sizes differ.

        maps = Maps(diffuse, specular, roughness, normal)
        height, width = maps.shape
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


@dataclass(frozen=True)
class Estimate:
    """Maps, and how sure they are.

    sigma: for each map, by its name, the standard deviation that its error is expected to have, as
    the map is encoded (normals as n/2 + 1/2): (H, W), or (H, W, 3) for each channel of an albedo.
    """

    maps: Maps
    sigma: dict[str, Array]


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


def map_errors(maps: Maps, truth: Maps) -> dict[str, float]:
    """RMSE of each map over pixels and channels, and their ``average``.

    Albedos and roughness linear in [0, 1], normals encoded to [0, 1], as in the literature.
    """
    a, b = maps.encoded(), truth.encoded()
    errors = {n: float(np.sqrt(np.mean(np.square(a[n] - b[n]), dtype=np.float64))) for n in NAMES}
    errors["average"] = sum(errors.values()) / len(NAMES)
    return errors
