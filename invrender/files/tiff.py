"""TIFF, classic and Big, by the package ``tifffile`` and the codecs of ``imagecodecs``."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from invrender.colour import adaptation, white_xyz, xyz_to_rec709
from invrender.files.exif import EXIF_IFD, ORIENTATION_TAG, exif_encoding
from invrender.files.icc import icc_encoding
from invrender.files.raster import (
    LINEAR,
    SRGB,
    Encoding,
    Raster,
    aspect,
    check_size,
    encoding,
    extended_srgb,
)  # fmt: skip
from invrender.types import Array, InputError

_X_RESOLUTION, _Y_RESOLUTION, _PROFILE, _DNG = 282, 283, 34675, 50706
_TRANSFER, _WHITE_POINT, _PRIMARIES, _YCBCR, _REFERENCE = 301, 318, 319, 529, 532
_SUBSAMPLING, _EXTRA = 530, 338
_REDUCED, _MASK = 1, 4  # bits of NewSubfileType
_D50 = white_xyz(0.34567, 0.35850)
# tifffile tells of damage in its log, and goes on.
logging.getLogger("tifffile").setLevel(logging.CRITICAL)


def is_dng(path: Path) -> bool:
    """Whether a TIFF is a DNG, whatever its name."""
    try:
        with tifffile.TiffFile(path) as f:
            return _DNG in f.pages[0].tags  # type: ignore[union-attr]
    except Exception:
        return False


def read_tiff(path: Path) -> Raster:
    """The one full-size picture of a TIFF; thumbnails and masks are passed over.

    Integers of 1 to 32 bits and floats; grey, RGB, palette, CMYK with a profile, YCbCr, CIE Lab.
    Raises `InputError` for several pictures, and for kinds of pixels that it names.
    """
    try:
        with tifffile.TiffFile(path) as f:
            page = _picture(path, f)
            return _read_page(path, page, tiff_exif(f.pages[0]))
    except InputError:
        raise
    except Exception:  # damaged files raise many kinds
        raise InputError(f"{path} is not a readable TIFF image, or not complete") from None


def _picture(path: Path, f: tifffile.TiffFile) -> tifffile.TiffPage:
    pages: list[tifffile.TiffPage] = []
    for index in range(min(len(f.pages), 100)):
        page = f.pages[index]
        assert isinstance(page, tifffile.TiffPage) or hasattr(page, "aspage")
        page = page if isinstance(page, tifffile.TiffPage) else page.aspage()
        below = [p for p in (page.pages or ()) if isinstance(p, tifffile.TiffPage)][:100]
        pages += [p for p in [page, *below] if not int(p.subfiletype) & (_REDUCED | _MASK)]
    if not pages:  # nothing else than what calls itself reduced
        first = f.pages[0]
        assert isinstance(first, tifffile.TiffPage)
        return first
    if len(pages) > 1:
        sizes = ", ".join(f"{p.imagewidth} × {p.imagelength}" for p in pages[:6])
        raise InputError(f"{path} holds {len(pages)} pictures ({sizes}); save the one picture")
    return pages[0]


def _read_page(path: Path, page: tifffile.TiffPage, tags: dict[int, Any]) -> Raster:
    kind = page.photometric
    check_size(
        path,
        page.imagewidth,
        page.imagelength,
        max(1, int(np.prod(page.shape)) // max(page.imagewidth * page.imagelength, 1))
        * (page.dtype.itemsize if page.dtype is not None else 8),
    )
    name = getattr(kind, "name", str(kind))
    allowed = (
        "MINISWHITE", "MINISBLACK", "RGB", "PALETTE", "SEPARATED", "YCBCR", "CIELAB", "ICCLAB",
    )  # fmt: skip
    if name == "CFA":
        raise InputError(f"{path} is a camera raw file; give it the ending that it had")
    if name not in allowed or page.imagedepth > 1:
        raise InputError(f"{path} is a TIFF of {name} pixels; save it as RGB")
    if name == "SEPARATED" and _PROFILE not in page.tags:
        raise InputError(f"{path} is CMYK without a colour profile; save it as RGB")
    if len(page.dataoffsets) < math.prod(page.chunked):
        raise ValueError  # tifffile takes minutes over millions of tiles that are not there
    data = page.asarray()
    if page.planarconfig == 2 and data.ndim == 3:
        data = np.moveaxis(data, 0, -1)
    data = data[..., None] if data.ndim == 2 else data
    if data.ndim != 3 or data.shape[:2] != (page.imagelength, page.imagewidth):
        raise InputError(f"{path} is a TIFF of {data.ndim} dimensions; save one picture as RGB")
    data, white = _codes(path, page, data)
    count = {"MINISWHITE": 1, "MINISBLACK": 1, "PALETTE": 1, "SEPARATED": 4}.get(name, 3)
    if data.shape[2] < count:
        raise InputError(
            f"{path} is a TIFF of {name} with {data.shape[2]} channels; save it as RGB"
        )
    data, extra = data[..., :count], data[..., count:]
    raster = Raster(data, white=white, tags=tags)
    _alpha(page, raster, extra)
    if name == "MINISWHITE":
        raster.data = (white - data).astype(data.dtype)
    elif name == "PALETTE":
        table = np.asarray(page.colormap).T
        raster.data, raster.white = table[data[..., 0]].astype(np.uint16), 65535
    elif name == "YCBCR" and page.compression not in (6, 7):
        raster.data = _rgb_of_ycbcr(path, page, data)
    raster.encoding = _encoding(path, page, raster, name)
    orientation = _value(page, ORIENTATION_TAG)
    raster.orientation = orientation if orientation in range(1, 9) else 1
    raster.aspect = aspect(*(_number(_value(page, t)) for t in (_X_RESOLUTION, _Y_RESOLUTION)))
    return raster


def _codes(path: Path, page: tifffile.TiffPage, data: NDArray[Any]) -> tuple[NDArray[Any], int]:
    """Pixels as uint8, uint16 or float32, and the code of white."""
    bits = int(page.bitspersample)
    if data.dtype == bool:
        return data.astype(np.uint8), 1
    if data.dtype.kind == "f" and data.dtype.itemsize in (2, 4, 8):
        with np.errstate(over="ignore"):
            return data.astype(np.float32), 1
    if data.dtype in (np.uint8, np.uint16):
        return data, 2 ** min(bits, 8 * data.dtype.itemsize) - 1
    if data.dtype == np.uint32:
        shift = max(bits - 16, 0)
        return (data >> shift).astype(np.uint16), 2 ** (bits - shift) - 1
    raise InputError(f"{path} is a TIFF of {data.dtype}; save it as 8 or 16 bits or as float")


def _alpha(page: tifffile.TiffPage, raster: Raster, extra: NDArray[Any]) -> None:
    kinds = [int(k) for k in page.extrasamples]
    for k in range(min(len(kinds), extra.shape[2])):
        if kinds[k] in (1, 2):
            alpha = extra[..., k].astype(np.float32) / raster.white
            if alpha.min() < 1:
                raster.alpha, raster.premultiplied = alpha, kinds[k] == 1
            return


def _encoding(path: Path, page: tifffile.TiffPage, raster: Raster, name: str) -> Encoding:
    floats = raster.data.dtype.kind == "f"
    if name in ("CIELAB", "ICCLAB"):
        if floats:
            raise InputError(f"{path} is a TIFF of float {name} pixels; save it as RGB")
        return Encoding(
            "CIE L*a*b*", convert=lambda v: _lab_to_light(v, name == "ICCLAB", raster.white)
        )
    profile = _value(page, _PROFILE)
    if isinstance(profile, bytes):
        levels = 256 if raster.white == 255 else 65536
        return icc_encoding(path, profile, raster.data.shape[2], levels)
    curve = extended_srgb if floats else SRGB.curve
    plain = LINEAR if floats else exif_encoding(raster)
    transfer = _value(page, _TRANSFER)
    if np.size(transfer) in (raster.white + 1, 3 * raster.white + 3):
        steps = np.asarray(transfer, np.float64).reshape(-1, raster.white + 1) / 65535
        steps = steps.repeat(3 // len(steps), 0)
        ramp = np.linspace(0, 1, raster.white + 1)

        def curve(x: Array) -> Array:
            return np.stack([np.interp(x[..., k], ramp, steps[k]) for k in range(3)], -1)

        plain = Encoding("the file's transfer function", curve)
    primaries, white = _value(page, _PRIMARIES), _value(page, _WHITE_POINT)
    if primaries is None and white is None:
        if raster.data.dtype == np.uint16 and plain is SRGB:
            raster.warn(
                "photo-curve-unknown",
                "the 16-bit TIFF has no colour profile, its values were taken as sRGB; if it is "
                "linear, save it with its profile or as an EXR",
            )
        return plain
    try:
        xy = [_fractions(v, n) for v, n in ((primaries, 6), (white, 2))]
        told = (*(xy[0] or (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)), *(xy[1] or (0.3127, 0.3290)))
        return encoding("the file's chromaticities", plain.curve, told)
    except ValueError:
        raise InputError(f"{path} has chromaticities that span no colours") from None


def _lab_to_light(values: NDArray[Any], unsigned: bool, white: int) -> Array:
    """TIFF 6.0, section 23, and TIFF technical note 4: L* from 0 to white; a*, b* in 8-bit steps.

    They are two's complement, or unsigned about 128 (ICCLab), under D50.
    """
    from skimage.color import lab2xyz

    step = 1 if white == 255 else 257 if unsigned else 256
    chroma = values[:, 1:].astype(np.float64)
    if unsigned:
        chroma = chroma / step - 128
    else:
        signed = values[:, 1:].astype(np.int8 if white == 255 else np.int16)
        chroma = signed.astype(np.float64) / step
    lab = np.concatenate([values[:, :1] * (100 / white), chroma], -1)
    xyz = lab2xyz(lab, illuminant="D50")
    return np.asarray(
        xyz @ (xyz_to_rec709() @ adaptation(_D50, white_xyz(0.3127, 0.3290))).T, np.float32
    )


def _rgb_of_ycbcr(path: Path, page: tifffile.TiffPage, data: NDArray[Any]) -> NDArray[Any]:
    """TIFF 6.0, section 21, without subsampling, 8 bits."""
    if data.dtype != np.uint8 or tuple(_value(page, _SUBSAMPLING) or (2, 2)) != (1, 1):
        raise InputError(f"{path} is a TIFF of subsampled YCBCR pixels; save it as RGB")
    red, green, blue = _fractions(_value(page, _YCBCR), 3) or (0.299, 0.587, 0.114)
    low = _fractions(_value(page, _REFERENCE), 6) or (0, 255, 128, 255, 128, 255)
    y, cb, cr = (
        (data[..., k].astype(np.float32) - low[2 * k])
        * (scale / max(low[2 * k + 1] - low[2 * k], 1))
        for k, scale in ((0, 255), (1, 127), (2, 127))
    )
    r, b = cr * (2 - 2 * red) + y, cb * (2 - 2 * blue) + y
    g = (y - blue * b - red * r) / green
    return (np.clip(np.stack([r, g, b], -1), 0, 255) + 0.5).astype(np.uint8)


def _value(page: tifffile.TiffPage, number: int) -> Any:
    tag = page.tags.get(number)
    return None if tag is None else tag.value


def _number(value: Any) -> Any:
    """A fraction as tifffile gives it, as a number."""
    return value[0] / value[1] if isinstance(value, tuple) and len(value) == 2 and value[1] else 1


def _fractions(value: Any, count: int) -> tuple[float, ...] | None:
    """So many fractions, which tifffile gives as pairs in a row; None where there are not."""
    if not isinstance(value, tuple) or len(value) != 2 * count or not all(value[1::2]):
        return None
    numbers = tuple(a / b for a, b in zip(value[::2], value[1::2], strict=True))
    return numbers if all(map(math.isfinite, numbers)) else None


def tiff_exif(page: Any) -> dict[int, Any]:
    """The EXIF tags of a TIFF's page by number; none where they are damaged."""
    try:
        value = page.tags[EXIF_IFD].value
    except Exception:
        return {}
    found: dict[int, Any] = {}
    for name, number in value.items() if isinstance(value, dict) else ():
        if isinstance(number, tuple) and len(number) == 2 and number[1]:  # a fraction
            number = number[0] / number[1]
        if name in tifffile.TIFF.EXIF_TAGS:
            found[int(tifffile.TIFF.EXIF_TAGS[name])] = number
    return found
