"""Image files for tests, written tag by tag, by the letter of their standards."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import tifffile
from PIL import Image

# Linear RGB to XYZ by the standards' own tables (IEC 61966-2-1, SMPTE EG 432-1, Adobe RGB 1998).
SRGB_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip
P3_TO_XYZ = np.array(
    [[0.4865709, 0.2656677, 0.1982173], [0.2289746, 0.6917385, 0.0792869],
     [0.0, 0.0451134, 1.0439444]]
)  # fmt: skip
ADOBE_TO_XYZ = np.array(
    [[0.5767309, 0.1855540, 0.1881852], [0.2973769, 0.6273491, 0.0752741],
     [0.0270343, 0.0706872, 0.9911085]]
)  # fmt: skip
D65_TO_D50 = np.array(
    [[1.0478112, 0.0228866, -0.0501270], [0.0295424, 0.9904844, -0.0170491],
     [-0.0092345, 0.0150436, 0.7521316]]
)  # fmt: skip
P3_XY = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)


def scene(height: int = 48, width: int = 64) -> np.ndarray:
    """Smooth linear Rec. 709 colours (H, W, 3) in (0, 1), inside every gamut."""
    y, x = np.mgrid[:height, :width]
    u, v = x / width, y / height
    return np.stack([0.15 + 0.6 * u, 0.12 + 0.3 * v, 0.3 - 0.15 * u * v], -1).astype(np.float32)


def in_space(linear: np.ndarray, to_xyz: np.ndarray) -> np.ndarray:
    """Linear Rec. 709 in the primaries of ``to_xyz``, both under D65."""
    return np.clip(linear @ (np.linalg.inv(to_xyz) @ SRGB_TO_XYZ).T, 0, None)


def codes(values: np.ndarray, levels: int = 255) -> np.ndarray:
    """Codes 0 … levels of values in [0, 1]."""
    return (np.clip(values, 0, 1) * levels + 0.5).astype(np.uint8 if levels == 255 else np.uint16)


def srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, in double precision."""
    x = np.asarray(linear, np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def profile(to_xyz: np.ndarray, gamma: float | None = None, grey: bool = False) -> bytes:
    """An ICC v4 profile of curves and a matrix; the sRGB curve where no gamma is given."""

    def s15(*values: float) -> bytes:
        return b"".join(struct.pack(">i", round(x * 65536)) for x in values)

    def text(words: str) -> bytes:
        wide = words.encode("utf-16-be")
        return b"mluc" + bytes(4) + struct.pack(">II", 1, 12) + b"enUS" + struct.pack(
            ">II", len(wide), 28
        ) + wide  # fmt: skip

    matrix = D65_TO_D50 @ to_xyz
    curve = (
        b"para"
        + bytes(4)
        + (
            struct.pack(">HH", 0, 0) + s15(gamma)
            if gamma
            else struct.pack(">HH", 3, 0) + s15(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
        )
    )
    tags = {
        b"desc": text("a test"), b"cprt": text("none"),
        b"wtpt": b"XYZ " + bytes(4) + s15(0.9642, 1, 0.8249),
        b"chad": b"sf32" + bytes(4) + s15(*D65_TO_D50.ravel()),
    }  # fmt: skip
    if grey:
        tags[b"kTRC"] = curve
    else:
        for k, c in enumerate(b"rgb"):
            tags[bytes([c]) + b"XYZ"] = b"XYZ " + bytes(4) + s15(*matrix[:, k])
            tags[bytes([c]) + b"TRC"] = curve
    at, table, data = 128 + 4 + 12 * len(tags), b"", b""
    for key, value in tags.items():
        value += bytes(-len(value) % 4)
        table += key + struct.pack(">II", at + len(data), len(value))
        data += value
    head = (
        struct.pack(">I", at + len(data)) + bytes(4) + struct.pack(">I", 0x04300000)
        + b"mntr" + (b"GRAY" if grey else b"RGB ") + b"XYZ "
        + struct.pack(">6H", 2026, 1, 1, 0, 0, 0)
        + b"acsp" + bytes(28) + s15(0.9642, 1, 0.8249) + bytes(48)
    )  # fmt: skip
    return head + struct.pack(">I", len(tags)) + table + data


def write_exr(path: Path, channels: dict[str, np.ndarray], **header: Any) -> None:
    """A scan-line EXR of any channels and attributes."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    data = {k: np.ascontiguousarray(v, np.float32) for k, v in channels.items()}
    with OpenEXR.File(header, data) as f:
        f.write(str(path))


def planes(image: np.ndarray, prefix: str = "") -> dict[str, np.ndarray]:
    """R, G and B of an image as channels of a layer."""
    return {prefix + c: image[..., k] for k, c in enumerate("RGB")}


def window(x0: int, y0: int, x1: int, y1: int) -> tuple[np.ndarray, np.ndarray]:
    """A data or display window by its first and last pixel."""
    return np.array([x0, y0], np.int32), np.array([x1, y1], np.int32)


def subsampled_exr(path: Path, channels: dict[str, tuple[np.ndarray, int]]) -> None:
    """An uncompressed float EXR whose channels (array, step) may be subsampled."""
    height, width = next(a.shape for a, step in channels.values() if step == 1)

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        size = struct.pack("<i", len(value))
        return name.encode() + b"\0" + kind.encode() + b"\0" + size + value

    names = sorted(channels)
    listed = b"".join(
        n.encode() + b"\0" + struct.pack("<iiii", 2, 0, channels[n][1], channels[n][1])
        for n in names
    )
    box = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    head = b"\x76\x2f\x31\x01" + struct.pack("<i", 2) + b"".join(
        [
            attribute("channels", "chlist", listed + b"\0"),
            attribute("compression", "compression", b"\0"), attribute("dataWindow", "box2i", box),
            attribute("displayWindow", "box2i", box), attribute("lineOrder", "lineOrder", b"\0"),
            attribute("pixelAspectRatio", "float", struct.pack("<f", 1)),
            attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0, 0)),
            attribute("screenWindowWidth", "float", struct.pack("<f", 1)), b"\0",
        ]
    )  # fmt: skip
    rows = []
    for y in range(height):
        body = b"".join(
            channels[n][0][y // channels[n][1]].astype("<f4").tobytes()
            for n in names
            if y % channels[n][1] == 0
        )
        rows.append(struct.pack("<ii", y, len(body)) + body)
    at, offsets = len(head) + 8 * height, b""
    for row in rows:
        offsets += struct.pack("<Q", at)
        at += len(row)
    path.write_bytes(head + offsets + b"".join(rows))


def png_chunk(name: bytes, body: bytes) -> bytes:
    """A PNG chunk with its length and checksum."""
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def write_png(path: Path, image: np.ndarray, *chunks: tuple[bytes, bytes]) -> None:
    """A PNG of uint8 or uint16 codes (H, W) or (H, W, 1 … 4) with chunks of its own."""
    image = image[..., None] if image.ndim == 2 else image
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[image.shape[2]]
    head = struct.pack(
        ">IIBBBBB", image.shape[1], image.shape[0], 8 * image.dtype.itemsize, kind, 0, 0, 0
    )
    big = image.astype(image.dtype.newbyteorder(">"))
    raw = b"".join(b"\0" + row.tobytes() for row in big)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + png_chunk(b"IHDR", head)
        + b"".join(png_chunk(*c) for c in chunks)
        + png_chunk(b"IDAT", zlib.compress(raw))
        + png_chunk(b"IEND", b"")
    )


def iccp(blob: bytes) -> tuple[bytes, bytes]:
    """The chunk of a PNG that holds an ICC profile."""
    return b"iCCP", b"a\0\0" + zlib.compress(blob)


def write_hdr(
    path: Path, image: np.ndarray, header: bytes = b"", axes: bytes = b"-Y +X", old: bool = False
) -> None:
    """A flat Radiance file, its scan lines lying as ``axes`` say; old: with old-style runs."""
    first, second = axes.split()
    if first[1:] == b"X":
        image = image.swapaxes(0, 1)
    along = {0: first, 1: second}
    for axis, name in along.items():
        if name in (b"+Y", b"-X"):
            image = np.flip(image, axis)
    mantissa, exponent = np.frexp(image.max(-1))
    scale = np.where(image.max(-1) > 0, mantissa * 256 / np.maximum(image.max(-1), 1e-30), 0)
    body = np.concatenate([image * scale[..., None], (exponent + 128)[..., None]], -1)
    body = np.minimum(body, 255).astype(np.uint8)
    if old:
        runs = b""
        for row in body:
            runs += row[0].tobytes()
            rest = len(row) - 1
            assert np.all(row == row[0])
            while rest:
                n = min(rest, 255)
                runs += bytes([1, 1, 1, n]) + (b"" if n < 255 or rest == n else row[0].tobytes())
                rest -= n + (n == 255 and rest > n)
        data = runs
    else:
        data = body.tobytes()
    size = f"{first.decode()} {image.shape[0]} {second.decode()} {image.shape[1]}\n".encode()
    path.write_bytes(b"#?RADIANCE\n" + header + b"FORMAT=32-bit_rle_rgbe\n\n" + size + data)


def fractions(values: Any) -> tuple[int, ...]:
    """Numbers as the numerators and denominators of a TIFF tag."""
    return tuple(int(k) for v in np.ravel(values) for k in (round(v * 100_000), 100_000))


NEUTRAL = np.array([0.5, 1.0, 0.6])  # what the camera of `write_dng` sees of white


def write_dng(
    path: Path,
    image: np.ndarray,
    orientation: int = 1,
    white: int = 16383,
    black: int = 0,
    more: list[tuple[Any, ...]] | None = None,
    neutral: np.ndarray = NEUTRAL,
) -> None:
    """A linear image (H, W, 3) as a camera with an RGGB mosaic and sRGB's primaries records it."""
    camera = image * neutral
    mosaic = camera[..., 1].copy()
    mosaic[0::2, 0::2] = camera[0::2, 0::2, 0]
    mosaic[1::2, 1::2] = camera[1::2, 1::2, 2]
    data = np.clip(mosaic * (white - black) + black + 0.5, 0, white).astype(np.uint16)
    matrix = NEUTRAL[:, None] * np.linalg.inv(SRGB_TO_XYZ)
    tags = [
        (274, 3, 1, orientation, True), (271, 2, 0, "invrender", True), (272, 2, 0, "test", True),
        (33421, 3, 2, (2, 2), True), (33422, 1, 4, bytes([0, 1, 1, 2]), True),
        (50706, 1, 4, bytes([1, 4, 0, 0]), True), (50707, 1, 4, bytes([1, 1, 0, 0]), True),
        (50708, 2, 0, "invrender test", True), (50714, 3, 1, black, True),
        (50717, 4, 1, white, True), (50721, 10, 9, fractions(matrix), True),
        (50728, 5, 3, fractions(neutral), True), (50778, 3, 1, 21, True), *(more or []),
    ]  # fmt: skip
    tifffile.imwrite(path, data, photometric=32803, metadata=None, extratags=tags)


def opcode_list(*opcodes: tuple[int, int, bytes]) -> bytes:
    """The content of a DNG's OpcodeList from (number, flags, parameters)."""
    parts = [struct.pack(">4I", k, 0x01030000, flags, len(b)) + b for k, flags, b in opcodes]
    return struct.pack(">I", len(opcodes)) + b"".join(parts)


def gain_map(gains: np.ndarray, shape: tuple[int, int], top: int, left: int) -> bytes:
    """Parameters of a DNG GainMap for one site of a 2 × 2 mosaic; gains (V, H)."""
    v, h = gains.shape
    return (
        struct.pack(">10I", top, left, *shape, 0, 1, 2, 2, v, h)
        + struct.pack(">4d", 1 / (v - 1), 1 / (h - 1), 0.0, 0.0)
        + struct.pack(">I", 1)
        + gains.astype(">f4").tobytes()
    )


def jpeg(image: np.ndarray, **options: Any) -> bytes:
    """A JPEG of uint8 codes, best quality, without chroma subsampling."""
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "JPEG", **{"quality": 100, "subsampling": 0} | options)
    return stream.getvalue()
