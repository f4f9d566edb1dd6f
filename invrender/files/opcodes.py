"""Lens corrections in DNG files, which LibRaw leaves out: Adobe's DNG specification 1.6, chapter 6.

Read are GainMap (lens shading), FixVignetteRadial, and WarpRectilinear (distortion).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.types import Array, InputError

_WARP, _VIGNETTE, _GAIN_MAP = 1, 3, 9
_NAMES = {
    2: "WarpFisheye", 7: "MapTable", 8: "MapPolynomial", 10: "DeltaPerRow", 11: "DeltaPerColumn",
    12: "ScalePerRow", 13: "ScalePerColumn", 14: "WarpRectilinear2",
}  # fmt: skip
_HARMLESS = {4: "FixBadPixelsConstant", 5: "FixBadPixelsList", 6: "TrimBounds"}
_OPTIONAL = 1  # bit of an opcode's flags: a reader may leave it out


@dataclass(frozen=True)
class GainMap:
    """Factors (points down, points across, planes) of the sites in an area, every so many."""

    area: tuple[int, int, int, int]  # top, left, bottom, right
    planes: tuple[int, int]  # first and number
    pitch: tuple[int, int]  # down, across
    spacing: tuple[float, float]  # of the points, shares of the image
    origin: tuple[float, float]
    gains: NDArray[np.float32]

    def at(
        self, rows: NDArray[Any], columns: NDArray[Any], shape: tuple[int, int], plane: int
    ) -> Array:
        """Bilinear factors (rows, columns) of pixels of an image of ``shape``."""
        index = [
            ((np.asarray(at) + 0.5) / size - origin) / spacing
            for at, size, origin, spacing in zip(
                (rows, columns), shape, self.origin, self.spacing, strict=True
            )
        ]
        grid = np.meshgrid(*index, indexing="ij")
        gains = self.gains[..., min(plane, self.gains.shape[2] - 1)]
        return ndimage.map_coordinates(gains, grid, np.float32, order=1, mode="nearest")


@dataclass(frozen=True)
class Vignette:
    """gain = 1 + Σ k_i r^(2i), r being 1 in the corner farthest from the centre (x, y shares)."""

    k: tuple[float, ...]
    centre: tuple[float, float]

    def gain(self, shape: tuple[int, int]) -> Array:
        """Factors of an image of ``shape``."""
        square, _, _, _ = _radius(shape, self.centre)
        gain: Array = np.zeros(shape, np.float32)
        for k in reversed(self.k):
            gain = (gain + np.float32(k)) * square
        return gain + np.float32(1)


@dataclass(frozen=True)
class Warp:
    """Radial (4) and tangential (2) coefficients a plane, centre as shares of the image."""

    planes: tuple[tuple[float, ...], ...]
    centre: tuple[float, float]

    def warped(self, image: Array) -> Array:
        """The image as a lens without distortion sees it."""
        shape = image.shape[0], image.shape[1]
        square, x, y, unit = _radius(shape, self.centre)
        out = np.empty_like(image)
        place = None
        for k in range(image.shape[2]):
            plane = self.planes[min(k, len(self.planes) - 1)]
            if place is None or plane != self.planes[min(k - 1, len(self.planes) - 1)]:
                k0, k1, k2, k3, t0, t1 = (np.float32(v) for v in plane)
                factor = k0 + square * (k1 + square * (k2 + square * k3))
                dx = x * factor + t0 * 2 * x * y + t1 * (square + 2 * x * x)
                dy = y * factor + t1 * 2 * x * y + t0 * (square + 2 * y * y)
                place = (
                    dy * unit + (self.centre[1] * shape[0] - 0.5),
                    dx * unit + (self.centre[0] * shape[1] - 0.5),
                )
            out[..., k] = ndimage.map_coordinates(
                image[..., k], place, np.float32, order=1, mode="nearest"
            )
        return out


@dataclass(frozen=True)
class Opcodes:
    """sensor: of the mosaic before it is made colours (list 2); image: after that (list 3); names
    of those left out in ``skipped``."""

    sensor: tuple[GainMap | Vignette, ...] = ()
    image: tuple[GainMap | Vignette | Warp, ...] = ()
    skipped: tuple[str, ...] = ()


def _radius(
    shape: tuple[int, int], centre: tuple[float, float]
) -> tuple[Array, Array, Array, float]:
    """r², x and y from the centre in units of the farthest corner's distance, and that, pixels."""
    height, width = shape
    unit = math.hypot(max(centre[0], 1 - centre[0]) * width, max(centre[1], 1 - centre[1]) * height)
    x = ((np.arange(width) + 0.5 - centre[0] * width) / unit).astype(np.float32)[None]
    y = ((np.arange(height) + 0.5 - centre[1] * height) / unit).astype(np.float32)[:, None]
    return x * x + y * y, x + 0 * y, y + 0 * x, unit


def read_opcodes(path: Path, lists: dict[int, bytes]) -> Opcodes:
    """The corrections in the contents of OpcodeList1, 2 and 3, by that number.

    Raises `InputError` for damaged ones, and for one that is not known and must not be left out.
    """
    found: dict[int, list[Any]] = {1: [], 2: [], 3: []}
    skipped = []
    for number, blob in lists.items():
        try:
            (count,) = struct.unpack_from(">I", blob)
            at = 4
            for _ in range(count):
                kind, _, flags, size = struct.unpack_from(">4I", blob, at)
                body = blob[at + 16 : at + 16 + size]
                at += 16 + size
                if len(body) < size:
                    raise ValueError
                known = _parse(kind, body) if number > 1 else None
                if known is not None and not (number == 2 and isinstance(known, Warp)):
                    found[number].append(known)
                elif kind not in _HARMLESS:
                    name = _NAMES.get(
                        kind,
                        {1: "WarpRectilinear", 3: "FixVignetteRadial", 9: "GainMap"}.get(
                            kind, f"opcode {kind}"
                        ),
                    )
                    if not flags & _OPTIONAL:
                        raise InputError(
                            f"{path} needs the lens correction {name}, which this program does not "
                            "know; develop it to a 16-bit TIFF"
                        )
                    skipped.append(name)
        except InputError:
            raise
        except (ValueError, struct.error):
            raise InputError(f"{path} has damaged lens corrections") from None
    return Opcodes(tuple(found[2]), tuple(found[3]), tuple(skipped))


def _parse(kind: int, body: bytes) -> GainMap | Vignette | Warp | None:
    if kind == _GAIN_MAP:
        top, left, bottom, right, plane, planes, down, across, v, h = struct.unpack_from(
            ">10I", body
        )
        numbers = struct.unpack_from(">4d", body, 40)
        (depth,) = struct.unpack_from(">I", body, 72)
        if not (1 <= v * h * depth <= len(body) // 4 and min(down, across, planes) >= 1):
            raise ValueError
        gains = np.frombuffer(body, ">f4", v * h * depth, 76).reshape(v, h, depth)
        spacing = numbers[0] or 1.0, numbers[1] or 1.0
        if not np.all((gains > 0) & (gains < 1000)) or not np.all(np.isfinite(numbers)):
            raise ValueError
        return GainMap(
            (top, left, bottom, right), (plane, planes), (down, across), spacing, numbers[2:],
            gains.astype(np.float32),
        )  # fmt: skip
    if kind == _VIGNETTE:
        numbers = struct.unpack_from(">7d", body)
        _check_numbers(numbers)
        return Vignette(numbers[:5], numbers[5:])
    if kind == _WARP:
        (planes,) = struct.unpack_from(">I", body)
        if not 1 <= planes <= 4:
            raise ValueError
        numbers = struct.unpack_from(f">{6 * planes + 2}d", body, 4)
        _check_numbers(numbers)
        return Warp(tuple(numbers[6 * k : 6 * k + 6] for k in range(planes)), numbers[-2:])
    return None


def _check_numbers(numbers: tuple[float, ...]) -> None:
    if not all(abs(v) < 100 for v in numbers) or not all(0 <= v <= 1 for v in numbers[-2:]):
        raise ValueError


def sensor_gain(
    opcodes: tuple[GainMap | Vignette, ...], shape: tuple[int, int], plane: int = 0
) -> Array:
    """The product (H, W) of the factors of an image's plane."""
    gain = np.ones(shape, np.float32)
    for opcode in opcodes:
        if isinstance(opcode, Vignette):
            gain *= opcode.gain(shape)
            continue
        first, count = opcode.planes
        if not first <= plane < first + count:
            continue
        top, left, bottom, right = opcode.area
        rows = np.arange(top, min(bottom, shape[0]), opcode.pitch[0])
        columns = np.arange(left, min(right, shape[1]), opcode.pitch[1])
        if len(rows) and len(columns):
            gain[rows[0] :: opcode.pitch[0], columns[0] :: opcode.pitch[1]][
                : len(rows), : len(columns)
            ] *= opcode.at(rows, columns, shape, plane - first)
    return gain
