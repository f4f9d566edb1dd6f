"""What a format's reader hands over, and its way to linear Rec. 709: curve, matrix, orientation."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.colour import (
    PRIMARIES,
    bt709_to_linear,
    hlg_to_linear,
    pq_to_linear,
    srgb_to_linear,
    to_rec709,
    xyz_to_rec709,
)  # fmt: skip
from invrender.types import Array, InputError, Notice

GIGABYTE = 2**30
# What one image may take while it is read; a 200-megapixel photo of 16 bits takes 1.8 GB.
MAX_MEMORY = 3 * GIGABYTE
# JPEG rings around a saturated area: its pixels lie a little below white.
SATURATED = 250 / 255

Curve = Callable[[Array], Array]


@dataclass(frozen=True)
class Encoding:
    """How an image's values stand for light.

    name: for people. curve: values in [0, 1] (..., C) to linear ones of the same shape, channel by
    channel, None for what is linear; float images go through it beyond 1 as well. matrix: (3, 3)
    from there to linear Rec. 709, None for what is. convert: instead of both, (N, C) values, codes
    or floats, to (N, 3), where the channels cannot be taken apart (CMYK, Lab, profiles of tables).
    """

    name: str
    curve: Curve | None = None
    matrix: NDArray[np.float64] | None = None
    convert: Callable[[NDArray[Any]], Array] | None = None


SRGB = Encoding("sRGB", srgb_to_linear)
LINEAR = Encoding("linear Rec. 709")


@dataclass(eq=False)
class Raster:
    """An image as a file holds it.

    data: (H, W, C) codes (uint8 or uint16, up to ``white``) or floats; C is 1 or 3, or what
    ``encoding.convert`` takes. saturated: the share of white from which a code is.
    alpha: (H, W) in [0, 1], None where all is opaque; premultiplied: the colours hold it as a
    factor. orientation: EXIF's, 1 to 8. aspect: width of a pixel over its height. partial: the
    file does not fill its picture. tags: EXIF's, by number. notes: what was done; warnings: what
    is doubtful.
    """

    data: NDArray[Any]
    encoding: Encoding = SRGB
    white: int = 255
    saturated: float = SATURATED
    alpha: Array | None = None
    premultiplied: bool = False
    orientation: int = 1
    aspect: float = 1.0
    partial: bool = False
    tags: dict[int, Any] = field(default_factory=dict)
    notes: list[Notice] = field(default_factory=list)
    warnings: list[Notice] = field(default_factory=list)

    def note(self, code: str, text: str) -> None:
        """Add what was done to the image."""
        self.notes.append(Notice(code, text))

    def warn(self, code: str, text: str) -> None:
        """Add what is doubtful about the image."""
        self.warnings.append(Notice(code, text))


def check_size(path: Path, width: int, height: int, bytes_per_pixel: int) -> None:
    """Raise `InputError` for an image without pixels or with more than memory is for."""
    if width < 1 or height < 1:
        raise InputError(f"{path} has no pixels")
    if width * height * bytes_per_pixel > MAX_MEMORY:
        raise InputError(
            f"{path} has {width} × {height} pixels; to read them takes more than the "
            f"{MAX_MEMORY / GIGABYTE:.0f} GB that one image may: scale it down"
        )


def gamma(exponent: float) -> Curve:
    """The curve x^exponent; odd, since float images may hold negative values."""
    return lambda x: np.asarray(np.sign(x) * np.abs(x) ** exponent, np.float32)


def encoding(name: str, curve: Curve | None, chromaticities: tuple[float, ...] | None) -> Encoding:
    """An encoding by its curve and primaries; None for linear and for Rec. 709."""
    matrix = None
    if chromaticities is not None:
        matrix = to_rec709(chromaticities)
        # D65 is written with three to five digits.
        matrix = None if np.allclose(matrix, np.eye(3), atol=2e-3) else matrix
    return Encoding(name, curve, matrix)


def extended_srgb(x: Array) -> Array:
    """`srgb_to_linear` for float images: odd, and going on above 1."""
    size = np.abs(np.asarray(x, np.float32))
    light = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.copysign(light, x), np.float32)


_CURVES: dict[str, Curve | None] = {
    "lin": None, "srgb": extended_srgb, "srgbx": extended_srgb, "pq": pq_to_linear,
    "hlg": hlg_to_linear, **{f"g{k}": gamma(k / 10) for k in (18, 22, 24, 26)},
}  # fmt: skip


def interop_encoding(identifier: str) -> Encoding | None:
    """The encoding of a colour interop ID, such as ``lin_ap1_scene``; None for unknown ones."""
    curve, _, space = identifier.removesuffix("_scene").removesuffix("_display").partition("_")
    if curve not in _CURVES:
        return None
    if space in ("ciexyzd65", "xyzd65"):
        return Encoding(identifier, _CURVES[curve], xyz_to_rec709())
    if space not in PRIMARIES:
        return None
    return encoding(identifier, _CURVES[curve], PRIMARIES[space])


# ITU-T H.273, tables 2 and 3, as the cICP chunk of PNG and the nclx box of HEIC and AVIF use them.
_H273_PRIMARIES = {
    1: "rec709", 2: "rec709", 4: "470m", 5: "470bg", 6: "smpte170m", 7: "smpte170m", 9: "rec2020",
    11: "p3dci", 12: "p3d65",
}  # fmt: skip
_H273_CURVES: dict[int, tuple[str, Curve | None]] = {
    1: ("BT.709 curve", bt709_to_linear), 2: ("sRGB curve", srgb_to_linear),
    4: ("gamma 2.2", gamma(2.2)), 5: ("gamma 2.8", gamma(2.8)),
    6: ("BT.601 curve", bt709_to_linear), 8: ("linear", None), 13: ("sRGB curve", srgb_to_linear),
    14: ("BT.2020 curve", bt709_to_linear), 15: ("BT.2020 curve", bt709_to_linear),
    16: ("PQ", pq_to_linear), 18: ("HLG", hlg_to_linear),
}  # fmt: skip


def h273_encoding(path: Path, primaries: int, transfer: int) -> Encoding:
    """The encoding of ITU-T H.273 code points; raises `InputError` for those it does not know."""
    if primaries not in _H273_PRIMARIES or transfer not in _H273_CURVES:
        raise InputError(
            f"{path} has colours of kind {primaries}/{transfer} (ITU-T H.273), which this program "
            "does not know; save it as sRGB"
        )
    if (primaries, transfer) in ((1, 13), (2, 2), (1, 2), (2, 13)):
        return SRGB
    space = _H273_PRIMARIES[primaries]
    name, curve = _H273_CURVES[transfer]
    return encoding(f"{space}, {name}", curve, PRIMARIES[space])


def oriented(data: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Apply the EXIF orientation 1 to 8; unknown values leave the image alone."""
    if orientation in (5, 6, 7, 8):
        data = data.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        data = data[:, ::-1]
    if orientation in (3, 4, 7, 8):
        data = data[::-1]
    return data


def decode(
    raster: Raster, *, data: bool = False, reduction: int = 1, saturated: float = math.inf
) -> Array:
    """Upright linear Rec. 709 (H, W, 3) float32 of a raster, row by row.

    data: the values stand for themselves (roughness, normals), no curve, no matrix. reduction:
    each pixel is the mean, of light, over so many by so many; what is left over at the right and
    the lower border is dropped. A mean of which a part is at ``saturated`` or above says only that
    there was at least so much light, and is no less than that. Alpha is divided out where it is a
    factor.
    """
    stored = oriented(raster.data, raster.orientation)
    alpha = raster.alpha if raster.premultiplied and not data else None
    if alpha is not None:
        alpha = oriented(alpha, raster.orientation)
    height, width = (n // reduction for n in stored.shape[:2])
    image = np.empty((height, width, 3), np.float32)
    table = _table(raster, data) if raster.data.dtype.kind == "u" else None
    e = raster.encoding
    as_stored = data or (e.curve is None and e.matrix is None and e.convert is None)
    if table is None and as_stored and alpha is None and reduction == 1:
        grey = stored.shape[2] == 1
        return np.ascontiguousarray(stored.repeat(3, -1) if grey else stored[..., :3], np.float32)
    # A few rows stay in the processor's caches; what sets up a transform each time gets many.
    rows = 8 if e.convert is None else 256

    def fill(top: int) -> None:
        target = image[top : top + rows]
        part = slice(top * reduction, (top + len(target)) * reduction)
        light = target
        if reduction > 1:
            light = np.empty((len(target) * reduction, stored.shape[1], 3), np.float32)
        _to_light(raster, table, stored[part], light, data)
        if alpha is not None:
            factor = alpha[part, :, None]
            np.divide(light, factor, out=light, where=factor > 0)
        if reduction > 1:
            # By strides: numpy's mean over two of five axes takes three times as long.
            target[:] = 0
            full = np.zeros(target.shape, bool)
            for k in range(reduction * reduction):
                row, column = divmod(k, reduction)
                part_of = light[row::reduction, column : width * reduction : reduction]
                target += part_of
                full |= part_of >= saturated
            target /= reduction * reduction
            target[full] = np.maximum(target[full], np.float32(saturated))

    # In two threads: most of the time, the system finds memory that is new to the process.
    with ThreadPoolExecutor(1 if e.convert else 2) as both:
        list(both.map(fill, range(0, height, rows)))
    return image


def _table(raster: Raster, data: bool) -> NDArray[np.float32]:
    """Light by code (levels,), or by code and channel (levels, 3); above white it is white's."""
    levels = 256 if raster.data.dtype == np.uint8 else 65536
    ramp = np.minimum(np.arange(levels) / raster.white, 1).astype(np.float32)
    if data or raster.encoding.curve is None:
        return ramp
    light = np.asarray(raster.encoding.curve(ramp[:, None].repeat(3, 1)), np.float32)
    return light[:, 0].copy() if np.ptp(light, axis=1).max() == 0 else light


def _to_light(
    raster: Raster,
    table: NDArray[np.float32] | None,
    values: NDArray[Any],
    out: NDArray[np.float32],
    data: bool,
) -> None:
    """Fill ``out`` (h, w, 3) with the light of stored values (h, w, C)."""
    e = raster.encoding
    if e.convert is not None and not data:
        out[:] = e.convert(np.ascontiguousarray(values).reshape(-1, values.shape[2])).reshape(
            out.shape
        )
        return
    values = values[..., :3]
    if table is not None:
        if table.ndim == 2:
            for k in range(3):
                out[..., k] = table[values[..., min(k, values.shape[2] - 1)], k]
        elif values.shape[2] == 3 and values.dtype == np.uint8:
            import cv2  # a seventh of numpy's time; it takes 0.1 s to import

            cv2.LUT(values, table, out)
        elif values.shape[2] == 3:
            np.take(table, values, out=out, mode="clip")  # the mode saves a copy
        else:
            out[:] = table[values]
    else:
        out[:] = values if data or e.curve is None else e.curve(values)
    if e.matrix is not None and not data:
        out[:] = out @ e.matrix.T.astype(np.float32)


def clip_level(raster: Raster) -> float | None:
    """The light at which a channel is saturated, in the file's primaries; None for float images."""
    if raster.data.dtype.kind != "u":
        return None
    e = raster.encoding
    grey = np.full((1, 3), raster.saturated)
    if e.convert is not None:
        return float(srgb_to_linear(grey).min())
    return float(np.min(grey if e.curve is None else e.curve(grey)))


def aspect(x: Any, y: Any) -> float:
    """Width of a pixel over its height from resolutions along x and y; 1 where they say nothing."""
    try:
        ratio = float(y) / float(x)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 1.0
    return ratio if math.isfinite(ratio) and ratio > 0 else 1.0
