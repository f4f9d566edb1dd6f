"""JPEG, WebP, AVIF and HEIC, by Pillow (HEIC: its plug-in ``pillow-heif``, an extra)."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray
from PIL import AvifImagePlugin, Image, JpegImagePlugin, WebPImagePlugin
from PIL.ImageFile import ImageFile

from invrender.files.boxes import Picture, read_boxes
from invrender.files.exif import exif_encoding, orientation, pillow_tags
from invrender.files.icc import icc_encoding
from invrender.files.raster import (
    MAX_MEMORY,
    SRGB,
    Encoding,
    Raster,
    aspect,
    check_size,
    h273_encoding,
)  # fmt: skip
from invrender.types import InputError

HALF_CHROMA = (
    "photo-chroma",
    "the photo's colours are stored at half resolution (chroma subsampling), which blurs the maps' "
    "colours: save it as 4:4:4 JPEG, PNG or TIFF, or as camera raw",
)
# By which JPEGs, HEICs and AVIFs show that they hold a gain map: Google's and Adobe's, Apple's,
# ISO 21496-1's.
_GAIN_MAPS = (
    b"http://ns.adobe.com/hdr-gain-map/1.0/", b"HDRGainMap", b"hdrgainmap",
    b"urn:iso:std:iso:ts:21496:-1", b"tmap",
)  # fmt: skip


def read_pillow(path: Path, kind: str) -> Raster:
    """The picture in a file of the kind "JPEG", "WEBP", "AVIF" or "HEIF"."""
    boxes = Picture()
    try:
        if kind in ("AVIF", "HEIF"):
            boxes = read_boxes(path)
            check_size(path, *(boxes.size or (1, 1)), 8)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with open(path, "rb") as f:
                return _read(path, _opened(path, f, kind), kind, boxes)
    except InputError:
        raise
    except Exception:  # Pillow's decoders raise many kinds
        raise InputError(
            f"{path} is not a readable image (EXR, TIFF, PNG, JPEG and others), or not complete"
        ) from None


def _opened(path: Path, f: BinaryIO, kind: str) -> ImageFile:
    """The image, not decoded; not by `Image.open`, which has a limit of pixels of its own."""
    if kind == "HEIF":
        try:
            import pillow_heif
        except ModuleNotFoundError:
            raise InputError(
                f"{path} is a HEIC photo; to read it: pip install 'invrender[heif]', or save it as "
                "JPEG or TIFF"
            ) from None
        # What else lies in the file is not decoded.
        pillow_heif.options.THUMBNAILS = pillow_heif.options.DEPTH_IMAGES = False
        pillow_heif.options.AUX_IMAGES = False
        return cast(ImageFile, pillow_heif.HeifImageFile(f))
    if kind == "JPEG":
        return cast(ImageFile, JpegImagePlugin.jpeg_factory(f))
    if kind == "WEBP":
        return WebPImagePlugin.WebPImageFile(f)
    return AvifImagePlugin.AvifImageFile(f)


def _read(path: Path, im: ImageFile, kind: str, boxes: Picture) -> Raster:
    frames = getattr(im, "n_frames", 1)
    if frames > 1 and kind in ("WEBP", "AVIF"):
        raise InputError(f"{path} is an animation; save the one picture")
    if kind == "JPEG":
        # Beyond what memory is for, the decoder averages 2 × 2 … 8 × 8 codes itself.
        shrink = math.sqrt(im.width * im.height * 4 / MAX_MEMORY)
        if shrink > 1:
            step = min(8, 2 ** math.ceil(math.log2(shrink)))
            im.draft(None, (im.width // step, im.height // step))
    check_size(path, im.width, im.height, 4)
    exif = im.getexif()
    profile = im.info.get("icc_profile")
    cmyk = im.mode == "CMYK"
    if cmyk and not profile:
        raise InputError(f"{path} is CMYK without a colour profile; save it as RGB")
    codes, alpha, white = _codes(path, im, kind, boxes)
    raster = Raster(codes, white=white, alpha=alpha, tags=pillow_tags(exif))
    raster.orientation = orientation(raster.tags)
    if kind in ("AVIF", "HEIF"):
        raster.aspect = boxes.aspect
        if kind == "HEIF":  # libheif has turned it already
            raster.orientation = 1
    elif kind == "JPEG" and "jfif_density" in im.info:
        raster.aspect = aspect(*im.info["jfif_density"])
    raster.encoding = _encoding(path, raster, profile, boxes)
    _tell(path, im, kind, boxes, raster)
    return raster


def _codes(path: Path, image: ImageFile, kind: str, boxes: Picture) -> tuple[Any, Any, int]:
    """(H, W, C) codes, alpha or None, and the code of white."""
    im: Image.Image = image
    if kind == "AVIF" and boxes.bits > 8:  # Pillow's would be 8
        import imagecodecs

        codes = np.asarray(imagecodecs.avif_decode(path.read_bytes()))
        white = 2**boxes.bits - 1
    elif kind == "HEIF" and boxes.bits > 8:
        import pillow_heif

        file = pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
        codes, white = np.asarray(file), 65535  # it spreads ten bits over sixteen
    else:
        im.load()
        if im.mode not in ("L", "LA", "RGB", "RGBA", "CMYK"):
            im = im.convert("RGBA" if "transparency" in im.info or "A" in im.mode else "RGB")
        codes, white = _array(im), 255
    codes = codes[..., None] if codes.ndim == 2 else codes
    if im.mode == "CMYK" or codes.shape[2] in (1, 3):
        return codes, None, white
    alpha = codes[..., -1]
    opaque = alpha.min() >= white
    return codes[..., :-1], None if opaque else alpha.astype(np.float32) / white, white


def _array(im: Image.Image) -> NDArray[np.uint8]:
    """(H, W) or (H, W, C) codes; few rows at once: Pillow makes two copies, and memory that is new
    to a process takes more time than to fill it."""
    channels = len(im.getbands())
    codes = np.empty((im.height, im.width, channels)[: 3 if channels > 1 else 2], np.uint8)
    rows = 64
    for top in range(0, im.height, rows):
        part = codes[top : top + rows]
        part[:] = np.asarray(im.crop((0, top, im.width, top + len(part))))
    return codes


def _encoding(path: Path, raster: Raster, profile: bytes | None, boxes: Picture) -> Encoding:
    if profile:
        levels = 256 if raster.white == 255 else 65536
        return icc_encoding(path, profile, raster.data.shape[2], levels)
    if boxes.colour is not None:
        found = h273_encoding(path, *boxes.colour)
        return exif_encoding(raster) if found is SRGB else found
    return exif_encoding(raster)


def _tell(path: Path, im: ImageFile, kind: str, boxes: Picture, raster: Raster) -> None:
    """Chroma subsampling and gain maps."""
    head = b""
    if kind == "JPEG":
        if raster.data.shape[2] > 1 and JpegImagePlugin.get_sampling(im) != 0:
            raster.warn(*HALF_CHROMA)
    elif kind == "WEBP":
        with open(path, "rb") as f:
            head = f.read(4096)
        if b"VP8 " in head:  # always 4:2:0
            raster.warn(*HALF_CHROMA)
    elif boxes.subsampled:
        raster.warn(*HALF_CHROMA)
    if kind != "WEBP":
        with open(path, "rb") as f:
            head = f.read(2**18)
        if any(mark in head for mark in _GAIN_MAPS[: 4 if kind == "JPEG" else 5]):
            raster.note(
                "photo-gain-map",
                "the photo holds a gain map for HDR displays; it was ignored, the base image read",
            )
