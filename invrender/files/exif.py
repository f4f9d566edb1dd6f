"""EXIF: the lens, the exposure, which way is up, and the colour space that it names."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from PIL import Image

from invrender.colour import PRIMARIES
from invrender.files.raster import SRGB, Encoding, Raster, encoding, gamma

ORIENTATION_TAG, EXIF_IFD, INTEROP_IFD = 0x0112, 0x8769, 0xA005
_EXPOSURE_TIME, _F_NUMBER, _ISO, _FOCAL_35MM = 0x829A, 0x829D, 0x8827, 0xA405
_COLOUR_SPACE, _WIDTH, _HEIGHT, _INTEROP_INDEX = 0xA001, 0xA002, 0xA003, 0x0001
# DCF 2.0: EXIF's "R03", and the 2 that some cameras write as the colour space.
ADOBE_RGB = encoding("Adobe RGB (EXIF)", gamma(563 / 256), PRIMARIES["adobergb"])


def exif_tags(blob: bytes) -> dict[int, Any]:
    """Tags of an EXIF block by number, those of its folders among them; none where damaged."""
    exif = Image.Exif()
    try:
        exif.load(blob)
    except Exception:  # damaged EXIF must not cost the photo
        return {}
    return pillow_tags(exif)


def pillow_tags(exif: Image.Exif) -> dict[int, Any]:
    """Tags that Pillow has found, by number, those of EXIF's and the interoperability folder too.

    The latter's index is filed under the folder's own number.
    """
    try:
        found = {ORIENTATION_TAG: exif.get(ORIENTATION_TAG), **exif.get_ifd(EXIF_IFD)}
        found[INTEROP_IFD] = exif.get_ifd(INTEROP_IFD).get(_INTEROP_INDEX)
    except Exception:
        return {}
    return found


def orientation(tags: dict[int, Any]) -> int:
    """EXIF's orientation, 1 where it is silent or not a number from 1 to 8."""
    value = tags.get(ORIENTATION_TAG)
    return int(value) if isinstance(value, (int, np.integer)) and 1 <= value <= 8 else 1


def exif_encoding(raster: Raster) -> Encoding:
    """What EXIF says of the colours of a photo without a profile; sRGB where it is silent."""
    tags = raster.tags
    index = tags.get(INTEROP_IFD)
    index = index.decode("latin-1") if isinstance(index, bytes) else str(index or "")
    if index.startswith("R03") or tags.get(_COLOUR_SPACE) == 2:
        return ADOBE_RGB
    if tags.get(_COLOUR_SPACE) == 0xFFFF:
        raster.warn(
            "photo-colour-unknown",
            "the photo's EXIF says that its colours are not sRGB, and nothing says what they are; "
            "they were taken as sRGB",
        )
    return SRGB


def lens(raster: Raster, width: int, height: int) -> tuple[float | None, float | None]:
    """Horizontal field of view in degrees and relative exposure in seconds; None where unknown.

    width, height: of the upright image. By CIPA DCG-001 the 35 mm equivalent is a ratio of
    diagonals: tan(fov/2) = (43.27 mm / 2f) · width/diagonal. Of a cropped photo, whose EXIF tells
    other proportions than it has, the field of view is unknown.
    """
    tags = raster.tags

    def positive(tag: int) -> float | None:
        value = tags.get(tag)
        value = value[0] if isinstance(value, tuple) and value else value
        try:
            number = float(value)  # type: ignore[arg-type]
        except (TypeError, ValueError, ZeroDivisionError, OverflowError):
            return None
        return number if math.isfinite(number) and number > 0 else None

    focal, time = positive(_FOCAL_35MM), positive(_EXPOSURE_TIME)
    f_number, iso = positive(_F_NUMBER), positive(_ISO)
    full = positive(_WIDTH), positive(_HEIGHT)
    fov = exposure = None
    if focal and full[0] and full[1] and _cropped(full[0], full[1], width, height):
        raster.warn(
            "photo-cropped",
            f"the photo has {width} × {height} pixels where its EXIF says {full[0]:.0f} × "
            f"{full[1]:.0f}; if it was cropped, give [camera] fov in rig.toml",
        )
    elif focal:
        tangent = math.hypot(36, 24) / 2 / focal * width / math.hypot(width, height)
        fov = math.degrees(2 * math.atan(tangent))
        fov = fov if 1 <= fov <= 170 else None
    if time and f_number and iso:
        exposure = time * iso / 100 / f_number**2
    return fov, exposure


def _cropped(full_width: float, full_height: float, width: int, height: int) -> bool:
    """Whether the proportions differ by more than two pixels' worth, either way up."""
    told, seen = (max(s) / min(s) for s in ((full_width, full_height), (width, height)))
    return bool(abs(told / seen - 1) > max(0.01, 2 / min(width, height)))
