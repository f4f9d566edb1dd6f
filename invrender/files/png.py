"""PNG, 1 to 16 bits, by libpng (the package ``imagecodecs``), and what its chunks say of colours.

Chunks by precedence as in the W3C's PNG, 3rd edition: cICP, iCCP, sRGB, then gAMA and cHRM.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from invrender.files.exif import exif_tags, orientation
from invrender.files.icc import icc_encoding
from invrender.files.raster import (
    SRGB,
    Encoding,
    Raster,
    aspect,
    check_size,
    encoding,
    gamma,
    h273_encoding,
)  # fmt: skip
from invrender.types import InputError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_MAX_PROFILE = 2**24  # bytes, unpacked


def read_png(path: Path) -> Raster:
    """A PNG's codes, and the encoding that its chunks name; sRGB where they name none."""
    import imagecodecs

    blob = path.read_bytes()
    try:
        chunks = dict(_chunks(blob))
        width, height, depth, kind = struct.unpack_from(">IIBB", chunks[b"IHDR"])
        channels = {0: 1, 2: 3, 3: 3, 4: 2}.get(kind, 4) + (b"tRNS" in chunks)
        check_size(path, width, height, channels * (2 if depth == 16 else 1))
        if b"acTL" in chunks and struct.unpack_from(">I", chunks[b"acTL"])[0] > 1:
            raise InputError(f"{path} is an animation; save the one picture")
        codes = np.asarray(imagecodecs.png_decode(blob))
    except InputError:
        raise
    except Exception:  # damaged files raise many kinds
        raise InputError(f"{path} is not a readable PNG image, or not complete") from None
    codes = codes[..., None] if codes.ndim == 2 else codes
    channels = codes.shape[2] - (codes.shape[2] in (2, 4))
    white = 65535 if codes.dtype == np.uint16 else 255
    raster = Raster(codes[..., :channels], white=white)
    if codes.shape[2] > channels and codes[..., -1].min() < white:
        raster.alpha = codes[..., -1].astype(np.float32) / white
    if b"cICP" in chunks and len(chunks[b"cICP"]) == 4 and chunks[b"cICP"][3] == 0:
        raster.data, raster.white = _full_range(raster.data, depth)
    raster.encoding = _encoding(path, chunks, channels, white + 1)
    if b"eXIf" in chunks:
        raster.tags = exif_tags(chunks[b"eXIf"])
        raster.orientation = orientation(raster.tags)
    if len(chunks.get(b"pHYs", b"")) == 9:
        raster.aspect = aspect(*struct.unpack_from(">II", chunks[b"pHYs"]))
    return raster


def _chunks(blob: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Name and content of each chunk but the pixels'; the first of a name that comes twice."""
    if not blob.startswith(SIGNATURE):
        raise ValueError
    at, seen = len(SIGNATURE), set()
    while at + 8 <= len(blob):
        size, name = struct.unpack_from(">I4s", blob, at)
        if name not in seen and name not in (b"IDAT", b"fdAT"):
            seen.add(name)
            yield name, blob[at + 8 : at + 8 + size]
        at += size + 12


def _encoding(path: Path, chunks: dict[bytes, bytes], channels: int, levels: int) -> Encoding:
    if b"cICP" in chunks:
        values = chunks[b"cICP"]
        if len(values) != 4 or values[2] != 0:
            raise InputError(f"{path} has a damaged cICP chunk; save it as sRGB")
        return h273_encoding(path, values[0], values[1])
    if b"iCCP" in chunks:
        packed = chunks[b"iCCP"].partition(b"\0")[2][1:]
        try:
            profile = zlib.decompressobj().decompress(packed, _MAX_PROFILE)
        except zlib.error:
            profile = b""
        return icc_encoding(path, profile, channels, levels)
    if b"sRGB" in chunks:
        return SRGB
    curve, name = SRGB.curve, "sRGB curve"
    if len(chunks.get(b"gAMA", b"")) == 4:
        exponent = struct.unpack(">I", chunks[b"gAMA"])[0] / 100_000
        if not 0.1 <= exponent <= 10:
            raise InputError(f"{path} has a gamma of {exponent:g} in its header; save it as sRGB")
        linear = abs(exponent - 1) < 1e-3
        curve, name = (None, "linear") if linear else (gamma(1 / exponent), f"gamma {exponent:g}")
    chromaticities = None
    if len(chunks.get(b"cHRM", b"")) == 32:
        xy = [v / 100_000 for v in struct.unpack(">8I", chunks[b"cHRM"])]
        chromaticities = (*xy[2:], *xy[:2])
        name += ", primaries of its own"
    elif name == "sRGB curve":
        return SRGB
    try:
        return encoding(name, curve, chromaticities)
    except ValueError:
        raise InputError(f"{path} has chromaticities that span no colours") from None


def _full_range(codes: np.ndarray, depth: int) -> tuple[np.ndarray, int]:
    """Codes of narrow ("video") range, ITU-T H.273: 16 to 235 of 8 bits, spread over 16 bits."""
    step = 2 ** (max(depth, 8) - 8)
    spread = (codes.astype(np.float32) - 16 * step) / (219 * step)
    return (np.clip(spread, 0, 1) * 65535 + 0.5).astype(np.uint16), 65535
