"""Texture files of an export: 8- or 16-bit PNG, JPEG or EXR, and what a reader sees in them."""

from __future__ import annotations

import io
import os
import re
import struct
import tempfile
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms
from PIL.PngImagePlugin import putchunk

from invrender.colour import linear_to_srgb, srgb_to_linear
from invrender.files.write import INCH, atomic_path, png_tags, write_exr
from invrender.types import Array, InputError

FORMAT_SUFFIXES = {"png8": ".png", "png16": ".png", "exr": ".exr", "jpeg": ".jpg"}
JPEG_QUALITY = 95
BLOCK = 65536  # pixels that are coded at once, so that what is between stays in a processor's cache


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
    codes = np.empty(texture.image.shape, np.uint16)
    rows, columns = texture.image.shape[:2]
    step = max(1, BLOCK // columns)
    for top in range(0, rows, step):
        values = np.clip(texture.image[top : top + step], 0, 1).astype(np.float32)
        if texture.colour:
            values[..., :3] = linear_to_srgb(values[..., :3])
        codes[top : top + step] = values * levels + 0.5
    return codes


def reals(codes: NDArray[Any], levels: int, colour: bool) -> Array:
    """Linear values of codes: the inverse of `integers`."""
    table = (np.arange(levels + 1) / levels).astype(np.float32)
    if not colour:
        return table[codes]
    linear = srgb_to_linear(table)[codes[..., :3]]
    return np.concatenate([linear, table[codes[..., 3:]]], -1) if codes.shape[-1] == 4 else linear


def encoded(texture: Texture, format: str, width: float | None = None) -> tuple[bytes, Array]:
    """The bytes of a PNG or JPEG file, and the linear image that a reader gets from it.

    The file says whether it is sRGB or data, and, with its ``width`` in metres, how large a pixel
    is (PNG: sRGB or gAMA, pHYs; JPEG: an ICC profile where it is a colour, JFIF's density).
    """
    columns = texture.image.shape[1]
    if format == "png16":
        codes = integers(texture, 65535)
        return _png16(codes, texture.colour, width), reals(codes, 65535, texture.colour)
    codes = integers(texture, 255)
    stream = io.BytesIO()
    picture = Image.fromarray(codes.astype(np.uint8))
    inch: dict[str, Any] = {} if width is None else {"dpi": (columns * INCH / width,) * 2}
    if format == "png8":
        picture.save(
            stream, format="PNG", compress_level=1, compress_type=zlib.Z_RLE,
            pnginfo=png_tags(texture.colour), **inch,
        )  # fmt: skip
        return stream.getvalue(), reals(codes, 255, texture.colour)
    if texture.colour:
        inch["icc_profile"] = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    picture.save(stream, format="JPEG", quality=JPEG_QUALITY, subsampling=0, **inch)
    with Image.open(stream) as back:
        seen = np.asarray(back)
    return stream.getvalue(), reals(seen, 255, texture.colour)


def as_read(texture: Texture, format: str) -> Array:
    """The linear image that a reader gets from a PNG or JPEG file, made only where it is lossy."""
    if format == "jpeg":
        return encoded(texture, format)[1]
    levels = 65535 if format == "png16" else 255
    return reals(integers(texture, levels), levels, texture.colour)


def write_texture(path: Path, texture: Texture, format: str, width: float | None = None) -> Array:
    """Write one file, whole or not at all; returns the linear image that a reader gets from it."""
    if not np.all(np.isfinite(texture.image)):
        raise ValueError(f"refusing to write non-finite values to {path}")
    if format == "exr":
        write_exr(path, texture.image, data=not texture.colour, width=width)
        return np.asarray(texture.image, np.float32)
    data, seen = encoded(texture, format, width)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
    return seen


def write_textures(
    folder: Path, textures: dict[str, Texture], format: str, width: float | None = None
) -> dict[str, Array]:
    """Write ``KEY.suffix`` for each texture, in threads; returns what readers get, by key.

    width: of what the textures show, metres.
    """
    suffix = FORMAT_SUFFIXES[format]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = {
            key: pool.submit(write_texture, folder / f"{key}{suffix}", texture, format, width)
            for key, texture in textures.items()
        }
        return {key: job.result() for key, job in jobs.items()}


@contextmanager
def whole_folder(out: Path, pack: Callable[[Path, Path], None] | None = None) -> Iterator[Path]:
    """A temporary folder whose files move to ``out`` when the block ends without an error.

    pack: makes the one file ``out`` of the folder instead. Raises `InputError` where the system
    does not let them be written.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".") as name:
            yield Path(name)
            if pack is not None:
                with atomic_path(out) as temporary:
                    pack(Path(name), temporary)
                return
            out.mkdir(exist_ok=True)
            for file in sorted(Path(name).iterdir()):
                os.replace(file, out / file.name)
    except OSError as error:
        raise InputError(
            f"{out} cannot be written: {error.strerror or 'the system refuses it'}"
        ) from None


def write_zip(folder: Path, out: Path) -> None:
    """Pack the files of a folder into a ``.zip``; images are compressed already."""
    with zipfile.ZipFile(out, "w") as archive:
        for file in sorted(folder.iterdir()):
            image = file.suffix in FORMAT_SUFFIXES.values()
            kind = zipfile.ZIP_STORED if image else zipfile.ZIP_DEFLATED
            archive.write(file, file.name, kind)


def safe_name(text: str) -> str:
    """A name for files and materials of any script's letters, digits, - and _: it cannot leave a
    folder, and is none that Windows keeps for devices. Where that changes the text, a checksum of
    it follows, so that two names stay two."""
    text = unicodedata.normalize("NFC", text)
    name = re.sub(r"[^\w-]+", "_", text).strip("_")[:64] or "material"
    if name == text and not re.fullmatch(r"(?i)con|prn|aux|nul|com\d|lpt\d", name):
        return name
    return f"{name}-{zlib.crc32(text.encode('utf-8', 'backslashreplace')):08x}"


def _png16(codes: NDArray[np.uint16], colour: bool, width: float | None) -> bytes:
    """A 16-bit PNG (Pillow writes colour with 8 bits only). W3C PNG 3rd ed.; filter 2, "Up"."""
    rows, columns = codes.shape[:2]
    kind = {1: 0, 3: 2, 4: 6}[codes.shape[2] if codes.ndim == 3 else 1]
    values = np.ascontiguousarray(codes.astype(">u2")).view(np.uint8).reshape(rows, -1)
    lines = np.full((rows, values.shape[1] + 1), 2, np.uint8)
    lines[0, 1:] = values[0]
    np.subtract(values[1:], values[:-1], out=lines[1:, 1:])
    out = io.BytesIO(b"\x89PNG\r\n\x1a\n")
    out.seek(0, io.SEEK_END)
    putchunk(out, b"IHDR", struct.pack(">IIBBBBB", columns, rows, 16, kind, 0, 0, 0))
    for name, data, *_ in png_tags(colour).chunks:
        putchunk(out, name, data)
    if width is not None:
        density = round(columns / width)  # pixels a metre
        putchunk(out, b"pHYs", struct.pack(">IIB", density, density, 1))
    putchunk(out, b"IDAT", zlib.compress(lines.tobytes(), 1))
    putchunk(out, b"IEND", b"")
    return out.getvalue()
