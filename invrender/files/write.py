"""Images out: whole files or none, with their colour space, and the program, in their headers."""

from __future__ import annotations

import errno
import os
import shutil
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from invrender.colour import linear_to_srgb
from invrender.types import Array, InputError

# x and y of red, green, blue and white, ITU-R BT.709.
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
INCH = 0.0254  # metres
BAND_VALUES = 1 << 20  # of an image that are encoded at once
PNG_LEVEL = 4  # of zlib: maps as small as with its usual 6, in half the time


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it when the block ends without an error.

    Raises `InputError` where the system does not let it be written: no such folder, no right to,
    a full disk.
    """
    path = Path(path)
    temporary = None
    try:
        fd, name = tempfile.mkstemp(prefix=".", suffix=path.suffix, dir=path.parent)
        os.close(fd)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        raise InputError(
            f"{path} cannot be written: {error.strerror or 'the system refuses it'}"
        ) from None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_exr(
    path: Path,
    image: Array,
    *,
    half: bool = False,
    data: bool = False,
    width: float | None = None,
) -> None:
    """Write (H, W), (H, W, 3) or (H, W, 4) linear values as a scan-line OpenEXR, ZIP-compressed.

    Three and four channels are linear Rec. 709, and the header says so (``chromaticities``,
    ``colorInteropID``), unless they are ``data`` (normals, deviations); one channel is data. width:
    of what the image shows, in metres, stored as ``xDensity`` (pixels an inch). Raises
    `ValueError` for NaN and infinity, `InputError` where it cannot be written.
    """
    image = np.asarray(image)
    if not np.all(np.isfinite(image)):
        raise ValueError(f"refusing to write non-finite values to {path}")
    pixels = np.ascontiguousarray(image, np.float16 if half else np.float32)
    channel = {"Y" if pixels.ndim == 2 else "RGBA"[: pixels.shape[2]]: pixels}
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": f"invrender {version('invrender')}",
    }
    if data or pixels.ndim == 2:
        header["colorInteropID"] = "data"
    else:
        header |= {"colorInteropID": "lin_rec709_scene", "chromaticities": REC709}
    if width is not None:
        header["xDensity"] = float(pixels.shape[1] * INCH / width)
    with atomic_path(path) as temporary, OpenEXR.File(header, channel) as f:
        try:
            f.write(str(temporary))
        except RuntimeError as error:  # what the binding makes of a full disk
            full = shutil.disk_usage(temporary.parent).free < pixels.nbytes
            reason = errno.ENOSPC if full else errno.EIO
            raise OSError(reason, os.strerror(reason)) from error


def png_tags(colour: bool) -> PngInfo:
    """The chunks by which a PNG says that its values are sRGB, or else linear (gamma 1)."""
    tags = PngInfo()
    if colour:
        tags.add(b"sRGB", b"\0")
    else:
        tags.add(b"gAMA", struct.pack(">I", 100_000))
    tags.add_text("Software", f"invrender {version('invrender')}")
    return tags


def write_png(
    path: Path, image: Array, *, linear: bool = False, white: float = 1.0, coded: bool = False
) -> None:
    """Write (H, W) or (H, W, 3) values from 0 to ``white`` as 8 bits, sRGB-encoded unless
    ``linear``, or unless they are ``coded`` so already.

    The file says which (sRGB or gAMA chunk). Raises as `write_exr` does.
    """
    image = np.asarray(image)
    codes = np.empty(image.shape, np.uint8)
    rows = max(1, BAND_VALUES // max(image[:1].size, 1))
    for top in range(0, len(image), rows):
        part = image[top : top + rows] / white
        if not np.all(np.isfinite(part)):
            raise ValueError(f"refusing to write non-finite values to {path}")
        data = np.clip(part, 0, 1) if linear or coded else linear_to_srgb(part)
        codes[top : top + rows] = data * 255 + 0.5
    with atomic_path(path) as temporary:
        Image.fromarray(codes).save(
            temporary, format="PNG", pnginfo=png_tags(not linear), compress_level=PNG_LEVEL
        )
