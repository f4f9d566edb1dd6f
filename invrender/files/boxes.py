"""What the boxes of a HEIC or AVIF file say of its primary picture (ISO/IEC 14496-12, 23008-12)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from invrender.files.raster import aspect

_MAX_META = 2**24  # bytes of boxes before the pixels


@dataclass
class Picture:
    """size: (width, height) as stored; bits: of a channel; subsampled: the chroma is; colour:
    primaries and transfer of ITU-T H.273, None where there is none; aspect: of a pixel."""

    size: tuple[int, int] | None = None
    bits: int = 8
    subsampled: bool = False
    colour: tuple[int, int] | None = None
    aspect: float = 1.0


def read_boxes(path: Path) -> Picture:
    """Properties of the primary item; raises `ValueError` or `struct.error` where damaged."""
    found = Picture()
    with open(path, "rb") as f:
        blob = f.read(_MAX_META)
    meta = next((body for name, body in _boxes(blob) if name == b"meta"), None)
    if meta is None:  # an image sequence
        return found
    inside = dict(_boxes(meta[4:]))
    (primary,) = struct.unpack_from(">H" if inside[b"pitm"][0] == 0 else ">I", inside[b"pitm"], 4)
    parts = dict(_boxes(inside[b"iprp"]))
    properties = list(_boxes(parts[b"ipco"]))
    for index in _associated(parts[b"ipma"], primary):
        if 1 <= index <= len(properties):
            _apply(found, *properties[index - 1])
    return found


def _boxes(blob: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at + 8 <= len(blob):
        size, name = struct.unpack_from(">I4s", blob, at)
        head = 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", blob, at + 8)
            head = 16
        size = size or len(blob) - at
        if size < head:
            raise ValueError
        yield name, blob[at + head : at + size]
        at += size


def _associated(ipma: bytes, item: int) -> list[int]:
    """Numbers, from 1, of the properties of an item."""
    version, wide = ipma[0], ipma[3] & 1
    (count,) = struct.unpack_from(">I", ipma, 4)
    at = 8
    for _ in range(min(count, 65536)):
        (number,) = struct.unpack_from(">I" if version else ">H", ipma, at)
        at += 4 if version else 2
        entries = ipma[at]
        at += 1
        values = struct.unpack_from(f">{entries}{'H' if wide else 'B'}", ipma, at)
        at += entries * (2 if wide else 1)
        if number == item:
            return [v & (0x7FFF if wide else 0x7F) for v in values]
    return []


def _apply(found: Picture, name: bytes, body: bytes) -> None:
    if name == b"ispe":
        found.size = struct.unpack_from(">II", body, 4)
    elif name == b"colr" and body[:4] == b"nclx":
        found.colour = struct.unpack_from(">HH", body, 4)
    elif name == b"pasp":
        # hSpacing : vSpacing is the width of a pixel to its height.
        across, down = struct.unpack_from(">II", body)
        found.aspect = aspect(down, across)
    elif name == b"av1C":
        high, twelve, grey = body[2] >> 6 & 1, body[2] >> 5 & 1, body[2] >> 4 & 1
        found.bits = 8 + 2 * high + 2 * (high and twelve)
        found.subsampled = not grey and bool(body[2] >> 2 & 3)
    elif name == b"hvcC":
        found.bits = 8 + (body[17] & 7)
        found.subsampled = body[16] & 3 in (1, 2)
