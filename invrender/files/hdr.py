"""Radiance pictures (.hdr, .pic): RGBE and XYZE, flat or run-length encoded, any way up.

Greg Ward, "The RADIANCE Picture File Format" (radsite.lbl.gov/radiance/refer/filefmts.pdf).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from invrender.colour import to_rec709, xyz_to_rec709
from invrender.files.raster import LINEAR, Encoding, Raster, check_size
from invrender.types import InputError

SIGNATURES = (b"#?RADIANCE", b"#?RGBE", b"#?AUTOPANO")


def read_hdr(path: Path) -> Raster:
    """A Radiance picture's radiance: EXPOSURE and COLORCORR divided out, all of each multiplied.

    Raises `InputError` for a damaged file.
    """
    try:
        data = path.read_bytes()
        lines = []
        at = 0
        while True:  # header lines end at an empty one; of the numbers' line see below
            end = data.index(b"\n", at)
            line = data[at:end].rstrip(b"\r")
            at = end + 1
            if not line:
                break
            lines.append(line.decode("latin-1"))
        stop = data.index(b"\n", at)
        words = data[at:stop].split()
        first, second = words[0].decode("ascii"), words[2].decode("ascii")
        counts = int(words[1]), int(words[3])
        if len(words) != 4 or {first[1:], second[1:]} != {"X", "Y"} or min(counts) < 1:
            raise ValueError
        if first[0] not in "+-" or second[0] not in "+-":
            raise ValueError
        check_size(path, *counts, 24)
        scanlines, length = counts
        rgbe = _decode(np.frombuffer(data, np.uint8, offset=stop + 1), scanlines, length)
        raster = _header(path, lines)
    except InputError:
        raise
    except (ValueError, IndexError, OverflowError):
        raise InputError(f"{path} is not a readable Radiance HDR file, or not complete") from None
    exponent = rgbe[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(np.float32(1), exponent - 136), 0).astype(np.float32)
    image = (rgbe[..., :3] + np.float32(0.5)) * scale[..., None]
    # Scan lines run along the second axis named: "-Y h +X w" is the usual one.
    if first[1] == "X":
        image = image.swapaxes(0, 1)
    sign = {first[1]: first[0], second[1]: second[0]}
    image = image[::-1] if sign["Y"] == "+" else image
    image = image[:, ::-1] if sign["X"] == "-" else image
    raster.data = np.ascontiguousarray(image * _divisor(path, lines))
    return raster


def _values(path: Path, lines: list[str], key: str, count: int) -> list[list[float]]:
    found = []
    for line in lines:
        name, equals, text = line.partition("=")
        if equals and name.strip().upper() == key:
            try:
                numbers = [float(v) for v in text.split()]
            except ValueError:
                numbers = []
            if len(numbers) != count or not np.all(np.isfinite(numbers)):
                raise InputError(f"{path} has a damaged {key} in its header")
            found.append(numbers)
    return found


def _divisor(path: Path, lines: list[str]) -> NDArray[np.float32]:
    """What stored values are multiplied with to be radiance again."""
    factor = np.ones(3)
    for numbers in (*_values(path, lines, "EXPOSURE", 1), *_values(path, lines, "COLORCORR", 3)):
        factor = factor * numbers
    if not np.all((factor > 1e-20) & (factor < 1e20)):
        raise InputError(f"{path} has a damaged EXPOSURE or COLORCORR in its header")
    return (1 / factor).astype(np.float32)


def _header(path: Path, lines: list[str]) -> Raster:
    if not lines or not lines[0].startswith("#?"):
        raise ValueError
    xyz = False
    for line in lines:
        name, equals, value = line.partition("=")
        if equals and name.strip().upper() == "FORMAT":
            if value.strip() not in ("32-bit_rle_rgbe", "32-bit_rle_xyze"):
                raise InputError(f"{path} is a Radiance file of the format {value.strip()[:40]}")
            xyz = value.strip() == "32-bit_rle_xyze"
    raster = Raster(np.empty((0, 0, 3), np.float32), LINEAR)
    primaries = _values(path, lines, "PRIMARIES", 8)
    if xyz:
        raster.encoding = Encoding("CIE XYZ", None, xyz_to_rec709())
    elif primaries:
        try:
            raster.encoding = Encoding("the file's primaries", None, to_rec709(primaries[-1]))
        except ValueError:
            raise InputError(f"{path} has primaries that span no colours") from None
    gammas = _values(path, lines, "GAMMA", 1)
    if gammas and gammas[-1] != [1.0]:
        raise InputError(f"{path} has a gamma of {gammas[-1][0]:g} in its header; save it linear")
    for (ratio,) in _values(path, lines, "PIXASPECT", 1):
        # Radiance: height of a pixel over its width.
        raster.aspect /= ratio if ratio > 0 else 1.0
    factor = _divisor(path, lines)
    if not np.all(factor == 1):
        text = " × ".join(f"{v:.3g}" for v in (factor if np.ptp(factor) else factor[:1]))
        raster.note("photo-exposure", f"the header's exposure was divided out (times {text})")
    return raster


def _decode(data: NDArray[np.uint8], scanlines: int, length: int) -> NDArray[np.uint8]:
    """(scanlines, length, 4) of mantissas and exponent."""
    out = np.empty((scanlines, length, 4), np.uint8)
    at = 0
    for row in out:
        head = data[at : at + 4]
        if len(head) == 4 and 8 <= length < 32768 and tuple(head[:2]) == (2, 2) and head[2] < 128:
            if int(head[2]) << 8 | int(head[3]) != length:
                raise ValueError
            at = _decode_channels(data, at + 4, row)
        else:
            at = _decode_pixels(data, at, row)
    return out


def _decode_channels(data: NDArray[np.uint8], at: int, row: NDArray[np.uint8]) -> int:
    """One scan line, channel after channel in runs; returns where the next one begins."""
    length = len(row)
    for channel in range(4):
        x = 0
        while x < length:
            n = int(data[at])
            if n > 128:
                n -= 128
                run = data[at + 1 : at + 2]
                at += 2
            else:
                run = data[at + 1 : at + 1 + n]
                at += 1 + n
            if n == 0 or x + n > length or len(run) not in (1, n):
                raise ValueError
            row[x : x + n, channel] = run
            x += n
    return at


def _decode_pixels(data: NDArray[np.uint8], at: int, row: NDArray[np.uint8]) -> int:
    """One scan line of whole pixels, in which 1, 1, 1, n repeats the last one (the old runs)."""
    length = len(row)
    plain = data[at : at + 4 * length].reshape(-1, 4) if len(data) >= at + 4 * length else None
    if plain is not None and not np.any(np.all(plain[:, :3] == 1, -1)):
        row[:] = plain
        return at + 4 * length
    x, shift = 0, 0
    while x < length:
        pixel = data[at : at + 4]
        at += 4
        if len(pixel) < 4:
            raise ValueError
        if tuple(pixel[:3]) == (1, 1, 1):
            n = int(pixel[3]) << shift
            if x == 0 or x + n > length or shift > 24:
                raise ValueError
            row[x : x + n] = row[x - 1]
            x, shift = x + n, shift + 8
        else:
            row[x] = pixel
            x, shift = x + 1, 0
    return at
