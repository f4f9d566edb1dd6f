"""Image files in: linear RGB float32 inside, sRGB only here at the boundary."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import tifffile
from numpy.typing import NDArray
from PIL import Image

from invrender.colour import srgb_to_linear
from invrender.types import Array, InputError

MAX_PIXELS = 100_000_000
_ORIENTATION, _EXIF_IFD = 0x0112, 0x8769
_EXPOSURE_TIME, _F_NUMBER, _ISO, _FOCAL_35MM = 0x829A, 0x829D, 0x8827, 0xA405
RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
PHOTOS = (".exr", *RAW, ".tif", ".tiff", ".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Photo:
    """A photograph, upright: ``image`` (H, W, 3) linear RGB float32, not negative.

    ``clip_level`` is the value at which a channel is saturated, None for HDR files. ``fov`` is the
    horizontal field of view in degrees and ``exposure`` the relative exposure t·ISO/(100·N²), in
    seconds, both None where the file does not say.
    """

    image: Array
    clip_level: float | None = None
    fov: float | None = None
    exposure: float | None = None

    @property
    def height(self) -> int:
        return int(self.image.shape[0])

    @property
    def width(self) -> int:
        return int(self.image.shape[1])

    @cached_property
    def clipped(self) -> NDArray[np.bool_]:
        """(H, W): pixels where at least one channel is saturated."""
        if self.clip_level is None:
            return np.zeros(self.image.shape[:2], bool)
        r, g, b = (self.image[..., k] >= self.clip_level for k in range(3))
        return np.asarray(r | g | b)


def read_image(path: Path, *, linear: bool = False) -> Array:
    """Read an EXR, PNG, TIFF, JPEG or camera raw as (H, W, 3) float32 linear RGB.

    Integer files (8 or 16 bits) are decoded from sRGB unless ``linear`` is set (roughness,
    normals); float files are linear. Grey becomes three equal channels, alpha is dropped, the EXIF
    orientation is applied. Raises `InputError` for anything that is not such a file, is larger
    than `MAX_PIXELS`, or holds NaN or infinity.
    """
    return _read(Path(path), linear).image


def read_photo(path: Path) -> Photo:
    """Read a photograph as `read_image` does, with what its EXIF says about lens and exposure.

    The field of view comes from the 35 mm equivalent focal length, by CIPA DCG-001 a ratio of
    diagonals: tan(fov/2) = (43.27 mm / 2f) · width/diagonal.
    """
    photo = _read(Path(path), False)
    if photo.clip_level is None:  # float files may hold negative values
        photo = replace(photo, image=np.maximum(photo.image, 0))
    return photo


def _read(path: Path, linear: bool) -> Photo:
    if not path.is_file():
        raise InputError(f"{path} does not exist")
    try:
        with open(path, "rb") as f:
            head = f.read(32)
    except OSError:
        raise InputError(f"{path} cannot be read") from None
    suffix = path.suffix.lower()
    if suffix == ".exr":
        photo = Photo(_read_exr(path))
    elif suffix in RAW:
        from invrender.files.raw import read_raw

        image, tags = read_raw(path)
        photo = Photo(image, 1.0, *_lens(tags, *image.shape[:2]))
    else:
        if head[:4] in (b"II*\0", b"MM\0*"):
            data, orientation, tags = _read_tiff(path)
        else:
            data, orientation, tags = _read_pillow(path, head)
        data = _upright(data, orientation)
        clip = None
        if data.dtype != np.float32:
            # JPEG rings around a saturated area: its pixels lie a little below white.
            clip = float(srgb_to_linear(np.array(250 / 255)))
            data = _decoded(data, linear)
        photo = Photo(data, clip, *_lens(tags, *data.shape[:2]))
    if photo.clip_level is None and not np.all(np.isfinite(photo.image)):
        raise InputError(f"{path} contains NaN or infinite pixels")
    return photo


def _decoded(data: NDArray[Any], linear: bool) -> NDArray[np.float32]:
    """Integers (H, W, 3) of 8 or 16 bits as linear values in [0, 1], row by row."""
    levels = 256 if data.dtype == np.uint8 else 65536
    table = (np.arange(levels) / (levels - 1)).astype(np.float32)
    table = table if linear else srgb_to_linear(table)
    image = np.empty(data.shape, np.float32)
    for row, values in zip(image, data, strict=True):
        np.take(table, values, out=row, mode="clip")  # the mode saves a copy
    return image


def check_size(path: Path, width: int, height: int) -> None:
    """Raise `InputError` for an image without pixels or with too many to be one."""
    if width < 1 or height < 1:
        raise InputError(f"{path} has no pixels")
    if width * height > MAX_PIXELS:
        raise InputError(
            f"{path} has {width} × {height} pixels, more than the {MAX_PIXELS:,} this program reads"
        )


def _read_exr(path: Path) -> Array:
    try:
        with OpenEXR.File(str(path), header_only=True) as f:
            window = f.header()["dataWindow"]
            check_size(path, *(int(window[1][i]) - int(window[0][i]) + 1 for i in (0, 1)))
        with OpenEXR.File(str(path), separate_channels=True) as f:
            channels = {k: v.pixels for k, v in f.channels().items()}
    except InputError:
        raise
    except Exception:  # the binding raises bare RuntimeError, TypeError and KeyError
        raise InputError(f"{path} is not a readable OpenEXR file") from None
    colour = {k.rpartition(".")[2]: v for k, v in reversed(channels.items())} | channels
    if all(c in colour for c in "RGB"):
        planes = [colour[c] for c in "RGB"]
    elif "Y" in colour or len(channels) == 1:
        planes = [colour.get("Y", next(iter(channels.values())))] * 3
    else:
        names = ", ".join(channels) or "none"
        raise InputError(f"{path} has neither R, G, B nor Y channels (it has {names})")
    if any(p.shape != planes[0].shape for p in planes):
        raise InputError(f"{path} has subsampled channels; save it as plain RGB")
    return np.stack(planes, -1).astype(np.float32)


def _rgb(data: NDArray[Any]) -> NDArray[Any]:
    """(H, W) or (H, W, 1..4) to (H, W, 3): grey repeated, alpha dropped."""
    data = data[..., None] if data.ndim == 2 else data
    return data[..., :3] if data.shape[-1] >= 3 else np.repeat(data[..., :1], 3, -1)


def _read_pillow(path: Path, head: bytes) -> tuple[NDArray[Any], int, dict[int, Any]]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as im:
                check_size(path, im.width, im.height)
                if head[:8] == b"\x89PNG\r\n\x1a\n" and head[24] == 16:
                    # Only what lies before the pixels: Pillow decodes them all to look behind.
                    exif = im.getexif() if "exif" in im.info else Image.Exif()
                    data = _read_png16(path)
                else:
                    exif = im.getexif()
                    im.load()
                    wide = im.mode.startswith("I")
                    data = np.asarray(im if wide else im.convert("RGB"))
                    data = _rgb(data.astype(np.uint16) if wide else data)
            return data, _orientation(exif.get(_ORIENTATION)), _exif_tags(exif)
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise InputError(
            f"{path} has more than the {MAX_PIXELS:,} pixels this program reads"
        ) from None
    except Exception:  # Pillow's decoders raise many kinds
        raise InputError(
            f"{path} is not a readable image (EXR, TIFF, PNG or JPEG, complete)"
        ) from None


def _exif_tags(exif: Image.Exif) -> dict[int, Any]:
    try:
        return dict(exif.get_ifd(_EXIF_IFD))
    except Exception:  # damaged EXIF must not cost the photo
        return {}


def _orientation(value: Any) -> int:
    return int(value) if isinstance(value, (int, np.integer)) else 1


def tiff_exif(page: tifffile.TiffPage) -> dict[int, Any]:
    """The EXIF tags of a TIFF's page by number; none where they are damaged."""
    try:
        value = page.tags[_EXIF_IFD].value
    except Exception:
        return {}
    found: dict[int, Any] = {}
    for name, number in value.items() if isinstance(value, dict) else ():
        if isinstance(number, tuple) and len(number) == 2 and number[1]:  # a fraction
            number = number[0] / number[1]
        if name in tifffile.TIFF.EXIF_TAGS:
            found[int(tifffile.TIFF.EXIF_TAGS[name])] = number
    return found


def _read_tiff(path: Path) -> tuple[NDArray[Any], int, dict[int, Any]]:
    try:
        with tifffile.TiffFile(path) as f:
            page = f.pages[0]
            assert isinstance(page, tifffile.TiffPage)
            check_size(path, page.imagewidth, page.imagelength)
            tag = page.tags.get(_ORIENTATION)
            orientation = _orientation(tag.value if tag else 1)
            tags = tiff_exif(page)
            if page.photometric == tifffile.PHOTOMETRIC.PALETTE or page.compression not in (
                1, 5, 8, 32773, 32946
            ):  # fmt: skip
                with Image.open(path) as im:
                    return np.asarray(im.convert("RGB")), orientation, tags
            data = page.asarray()
            if page.planarconfig == 2 and data.ndim == 3:
                data = np.moveaxis(data, 0, -1)
            if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
                data = data.max() - data if data.dtype == bool else np.invert(data)
    except InputError:
        raise
    except Exception:  # damaged files raise many kinds
        raise InputError(f"{path} is not a readable TIFF image") from None
    if data.dtype == bool:
        data = data.astype(np.uint8) * 255
    if data.dtype in (np.float16, np.float64):
        data = data.astype(np.float32)
    if data.dtype not in (np.uint8, np.uint16, np.float32) or data.ndim not in (2, 3):
        raise InputError(f"{path} is a TIFF of {data.dtype}; save it as 8 or 16 bits or as float")
    return _rgb(data), orientation, tags


def _read_png16(path: Path) -> NDArray[Any]:
    """A 16-bit PNG by Mitsuba's reader: Pillow reduces the colour ones to 8 bits."""
    from invrender.render.backend import BACKEND

    import mitsuba as mi  # isort: skip

    if mi.variant() is None:
        mi.set_variant(f"{BACKEND}_ad_rgb")
        mi.set_log_level(mi.LogLevel.Error)
    return _rgb(np.array(mi.Bitmap(str(path))))


def _upright(data: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Apply the EXIF orientation 1 to 8; unknown values leave the image alone."""
    if orientation in (5, 6, 7, 8):
        data = data.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        data = data[:, ::-1]
    if orientation in (3, 4, 7, 8):
        data = data[::-1]
    return data


def _lens(tags: dict[int, Any], height: int, width: int) -> tuple[float | None, float | None]:
    """Field of view in degrees and relative exposure in seconds, None where EXIF is silent."""

    def positive(tag: int) -> float | None:
        value = tags.get(tag)
        value = value[0] if isinstance(value, tuple) and value else value
        try:
            number = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError, ZeroDivisionError):
            return None
        return number if math.isfinite(number) and number > 0 else None

    focal, time = positive(_FOCAL_35MM), positive(_EXPOSURE_TIME)
    f_number, iso = positive(_F_NUMBER), positive(_ISO)
    fov = exposure = None
    if focal:
        tangent = math.hypot(36, 24) / 2 / focal * width / math.hypot(width, height)
        fov = math.degrees(2 * math.atan(tangent))
        fov = fov if 1 <= fov <= 170 else None
    if time and f_number and iso:
        exposure = time * iso / 100 / f_number**2
    return fov, exposure
