"""Texture files of an export: 8- or 16-bit PNG, JPEG or EXR, and what a reader sees in them."""

from __future__ import annotations

import io
import os
import re
import struct
import tempfile
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from invrender.colour import linear_to_srgb, srgb_to_linear
from invrender.files.write import atomic_path, write_exr
from invrender.types import Array

SUFFIXES = {"png8": ".png", "png16": ".png", "exr": ".exr", "jpeg": ".jpg"}
JPEG_QUALITY = 95


@dataclass(frozen=True)
class Texture:
    """An image to write: (H, W), (H, W, 3) or (H, W, 4) in [0, 1], linear.

    colour: the first three channels are a colour, which integer formats store as sRGB. All else
    (roughness, metalness, normals, alpha) is stored as it is.
    """

    image: Array
    colour: bool = False


def integers(texture: Texture, levels: int) -> NDArray[np.uint16]:
    """The codes 0 … levels that an integer file holds."""
    values = np.clip(texture.image, 0, 1).astype(np.float32)
    if texture.colour:
        coded = linear_to_srgb(values[..., :3])
        values = np.concatenate([coded, values[..., 3:]], -1) if values.shape[-1] == 4 else coded
    return (values * levels + 0.5).astype(np.uint16)


def reals(codes: NDArray[Any], levels: int, colour: bool) -> Array:
    """Linear values of codes: the inverse of `integers`."""
    table = (np.arange(levels + 1) / levels).astype(np.float32)
    if not colour:
        return table[codes]
    linear = srgb_to_linear(table)[codes[..., :3]]
    return np.concatenate([linear, table[codes[..., 3:]]], -1) if codes.shape[-1] == 4 else linear


def encoded(texture: Texture, format: str) -> tuple[bytes, Array]:
    """The bytes of a PNG or JPEG file, and the linear image that a reader gets from it."""
    if format == "png16":
        codes = integers(texture, 65535)
        return _png16(codes), reals(codes, 65535, texture.colour)
    codes = integers(texture, 255)
    stream = io.BytesIO()
    picture = Image.fromarray(codes.astype(np.uint8))
    if format == "png8":
        picture.save(stream, format="PNG", compress_level=1)
        return stream.getvalue(), reals(codes, 255, texture.colour)
    picture.save(stream, format="JPEG", quality=JPEG_QUALITY, subsampling=0)
    with Image.open(stream) as back:
        seen = np.asarray(back)
    return stream.getvalue(), reals(seen, 255, texture.colour)


def write_texture(path: Path, texture: Texture, format: str) -> Array:
    """Write one file, whole or not at all; returns the linear image that a reader gets from it."""
    if not np.all(np.isfinite(texture.image)):
        raise ValueError(f"refusing to write non-finite values to {path}")
    if format == "exr":
        write_exr(path, texture.image)
        return np.asarray(texture.image, np.float32)
    data, seen = encoded(texture, format)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return seen


def write_textures(folder: Path, textures: dict[str, Texture], format: str) -> dict[str, Array]:
    """Write ``KEY.suffix`` for each texture, in threads; returns what readers get, by key."""
    suffix = SUFFIXES[format]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = {
            key: pool.submit(write_texture, folder / f"{key}{suffix}", texture, format)
            for key, texture in textures.items()
        }
        return {key: job.result() for key, job in jobs.items()}


@contextmanager
def whole_folder(out: Path) -> Iterator[Path]:
    """A temporary folder whose files move to ``out`` when the block ends without an error."""
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".") as name:
        yield Path(name)
        out.mkdir(exist_ok=True)
        for file in sorted(Path(name).iterdir()):
            os.replace(file, out / file.name)


def safe_name(text: str) -> str:
    """A name for files and materials of letters, digits, - and _: it cannot leave a folder."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text).strip("_")[:64] or "material"


def _png16(codes: NDArray[np.uint16]) -> bytes:
    """A 16-bit PNG (Pillow writes colour with 8 bits only). W3C PNG 3rd ed.; filter 2, "Up"."""
    height, width = codes.shape[:2]
    kind = {1: 0, 3: 2, 4: 6}[codes.shape[2] if codes.ndim == 3 else 1]
    rows = np.ascontiguousarray(codes.astype(">u2")).view(np.uint8).reshape(height, -1)
    lines = np.full((height, rows.shape[1] + 1), 2, np.uint8)
    lines[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=lines[1:, 1:])

    def chunk(name: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 16, kind, 0, 0, 0)
    parts = (
        chunk(b"IHDR", header),
        chunk(b"IDAT", zlib.compress(lines.tobytes(), 1)),
        chunk(b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
