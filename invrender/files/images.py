"""Image files in: any format's pixels as upright linear Rec. 709 float32.

`docs/reference-files.md` says what is done with every tag of every format.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from invrender.files.exif import lens
from invrender.files.raster import Raster, clip_level, decode, oriented
from invrender.types import Array, InputError, Notice

RAW = (
    ".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2",
    ".pef", ".rwl", ".srw", ".3fr", ".fff", ".iiq", ".erf", ".mrw", ".x3f",
)  # fmt: skip
# Every ending that a photo may have, the best first.
PHOTOS = (
    ".exr", ".hdr", ".pic", *RAW, ".tif", ".tiff", ".png", ".heic", ".heif", ".hif", ".avif",
    ".webp", ".jpg", ".jpeg",
)  # fmt: skip
# A photo with more pixels is averaged down by a whole number: 50-megapixel sensors stay whole.
WHOLE_PIXELS = 52_000_000
SQUARE = 0.01  # by which a pixel's width may differ from its height


@dataclass(frozen=True)
class Photo:
    """A photograph, upright: ``image`` (H, W, 3) linear RGB float32, not negative.

    ``matrix`` (3, 3) makes Rec. 709 of it; None where it is that. An integer file keeps its own
    primaries, in which its camera's tone curve and saturation are simple, until `in_rec709`.
    ``linear``: no tone curve of a camera is in it, or none any more; an HDR file has none anyway.
    ``curve_deviation``: what undoing it leaves, a standard deviation of the logarithm of bright
    over dark light. ``clip_level`` is the value at which a channel is saturated, None for HDR
    files. ``fov`` is the horizontal field of view in degrees and ``exposure`` the relative exposure
    t·ISO/(100·N²), in seconds, both None where the file does not say. ``notes`` tell what was done
    to the file's values to get here, ``warnings`` what is doubtful about them.
    """

    image: Array
    clip_level: float | None = None
    fov: float | None = None
    exposure: float | None = None
    notes: tuple[Notice, ...] = ()
    warnings: tuple[Notice, ...] = ()
    matrix: Array | None = None
    linear: bool = False
    curve_deviation: float = 0.0

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
        out = np.empty(self.image.shape[:2], bool)
        rows = 16  # stay in the processor's caches
        for top in range(0, self.height, rows):
            full = self.image[top : top + rows] >= self.clip_level
            out[top : top + rows] = full[..., 0] | full[..., 1] | full[..., 2]
        return out

    def in_rec709(self) -> Photo:
        """The photo with Rec. 709 primaries; what is saturated stays so, and nothing else is."""
        if self.matrix is None:
            return self
        image = np.maximum(self.image @ self.matrix.T.astype(np.float32), 0)
        level = self.clip_level
        if level is not None:
            top = level * float(np.maximum(self.matrix, 0).sum(1).max())
            full = self.clipped
            image[full] = np.maximum(image[full], top * (self.image[full] >= level))
            level = top
        return replace(self, image=image, clip_level=level, matrix=None)


def read_image(path: Path, *, linear: bool = False) -> Array:
    """Read an image of any known format as (H, W, 3) float32 linear Rec. 709, upright.

    linear: the file's values stand for themselves (roughness, normals): no curve, no colour
    conversion. Grey becomes three equal channels, alpha is dropped (and divided out where colours
    hold it), what an EXR's data window leaves out is black. Raises `InputError` for anything that
    is not such a file, takes too much memory, or holds NaN or infinity.
    """
    path = Path(path)
    raster = _read(path)
    image = decode(raster, data=linear)
    _check_finite(path, raster, image)
    return image


def read_alpha(path: Path) -> Array:
    """The alpha channel (H, W) of an image, upright, in [0, 1]; ones where it has none."""
    raster = _read(Path(path))
    alpha = np.ones(raster.data.shape[:2]) if raster.alpha is None else raster.alpha
    return np.ascontiguousarray(oriented(alpha, raster.orientation), np.float32)


def read_photo(path: Path) -> Photo:
    """Read a photograph as `read_image` does, with what its file says about lens and exposure; but
    an integer file's colours keep their primaries (`Photo.matrix`).

    One of more than `WHOLE_PIXELS` is averaged down, light by light. Raises `InputError` as
    `read_image` does, and for a photo with pixels that are missing, transparent or not square.

    >>> from invrender.data import EXAMPLE
    >>> photo = read_photo(EXAMPLE / "photo.exr")
    >>> photo.image.shape, photo.notes
    ((720, 960, 3), ())
    """
    path = Path(path)
    raster = _read(path)
    _check_photo(path, raster)
    height, width = raster.data.shape[:2]
    reduction = next(k for k in range(1, 1 << 16) if height * width <= WHOLE_PIXELS * k * k)
    clip, matrix = clip_level(raster), None
    linear = raster.encoding.curve is None and raster.encoding.convert is None
    if clip is not None and raster.encoding.convert is None:
        matrix = raster.encoding.matrix
        raster.encoding = replace(raster.encoding, matrix=None)
    image = decode(raster, reduction=reduction, saturated=math.inf if clip is None else clip)
    _check_finite(path, raster, image)
    if clip is None or raster.encoding.matrix is not None or raster.encoding.convert is not None:
        np.maximum(image, 0, out=image)
    _tell(raster, image.shape, reduction)
    fov, exposure = lens(raster, *_stored_size(raster))
    return Photo(
        image, clip, fov, exposure, tuple(raster.notes), tuple(raster.warnings), matrix, linear
    )


def _stored_size(raster: Raster) -> tuple[int, int]:
    """(width, height) of the upright image before it was averaged down."""
    height, width = raster.data.shape[:2]
    return (height, width) if raster.orientation >= 5 else (width, height)


def _reader(path: Path, head: bytes) -> Callable[[Path], Raster]:
    """The reader for a file, by its first bytes; by its ending for camera raw."""
    from invrender.files import exr, hdr, pillow, png, raw, tiff

    if path.suffix.lower() in RAW:
        return raw.read_raw
    if head.startswith(b"\x76\x2f\x31\x01"):
        return exr.read_exr
    if head.startswith(png.SIGNATURE):
        return png.read_png
    if head.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
        return raw.read_raw if tiff.is_dng(path) else tiff.read_tiff
    if head.startswith(hdr.SIGNATURES):
        return hdr.read_hdr
    if head.startswith(b"\xff\xd8\xff"):
        return lambda path: pillow.read_pillow(path, "JPEG")
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return lambda path: pillow.read_pillow(path, "WEBP")
    if head[4:8] == b"ftyp":
        kind = "AVIF" if b"avif" in head or b"avis" in head else "HEIF"
        return lambda path: pillow.read_pillow(path, kind)
    raise InputError(
        f"{path} is not a readable image; known are EXR, HDR, TIFF, PNG, JPEG, HEIC, AVIF, WebP "
        "and camera raw"
    )


def _read(path: Path) -> Raster:
    if not path.is_file():
        why = "is a folder, not an image" if path.is_dir() else "does not exist"
        raise InputError(f"{path} {why}")
    try:
        with open(path, "rb") as f:
            head = f.read(64)
        return _reader(path, head)(path)
    except OSError:
        raise InputError(f"{path} cannot be read") from None
    except MemoryError:
        raise InputError(f"{path} takes more memory than there is: scale it down") from None


def _check_finite(path: Path, raster: Raster, image: Array) -> None:
    if raster.data.dtype.kind == "f" and not np.all(np.isfinite(image)):
        raise InputError(f"{path} contains NaN or infinite pixels")


def _check_photo(path: Path, raster: Raster) -> None:
    """Refuse what cannot be a photograph of a whole scene."""
    if raster.partial:
        raise InputError(
            f"{path} has a data window that does not fill its picture; save the whole photo"
        )
    if abs(raster.aspect - 1) > SQUARE:
        raise InputError(
            f"{path} has pixels {raster.aspect:.3g} times as wide as high; save it with square ones"
        )
    if raster.alpha is not None:
        if not np.all(raster.alpha > 0):
            raise InputError(f"{path} has transparent pixels; save the photo without transparency")
        done = "divided out" if raster.premultiplied else "dropped"
        raster.note("photo-alpha", f"the photo's transparency was {done}")


def _tell(raster: Raster, shape: tuple[int, ...], reduction: int) -> None:
    """Note colour conversion, orientation and scale."""
    e = raster.encoding
    if e.name not in ("sRGB", "linear Rec. 709"):
        raster.note("photo-colour", f"the photo's colours were converted from {e.name}")
    if raster.orientation != 1:
        raster.note("photo-orientation", "the photo was turned as its orientation tag says")
    if reduction > 1:
        raster.note(
            "photo-reduced",
            f"the photo was averaged down {reduction} times, to {shape[1]} × {shape[0]} pixels; "
            "pixel coordinates count these",
        )
