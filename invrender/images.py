"""Image files in and out: linear RGB float32 inside, sRGB only here at the boundary."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from invrender.errors import InputError

Array = NDArray[np.floating[Any]]
MAX_PIXELS = 200_000_000


def srgb_to_linear(x: Array) -> Array:
    """IEC 61966-2-1 decoding of values in [0, 1]."""
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(x: Array) -> Array:
    """IEC 61966-2-1 encoding, clipped to [0, 1]."""
    x = np.clip(x, 0, 1)
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)


def read_image(path: Path, *, linear: bool = False) -> Array:
    """Read an EXR, PNG, TIFF or JPEG as (H, W, 3) float32 linear RGB.

    Integer files are decoded from sRGB unless ``linear`` is set (roughness, normals). Grey becomes
    three equal channels, alpha is dropped. Raises `InputError` for anything that is not such a
    file, is larger than `MAX_PIXELS`, or holds NaN or infinity.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist")
    image = _read_exr(path) if path.suffix.lower() == ".exr" else _read_integer(path, linear)
    if not np.all(np.isfinite(image)):
        raise InputError(f"{path} contains NaN or infinite pixels")
    return image


def _read_exr(path: Path) -> Array:
    try:
        with OpenEXR.File(str(path), separate_channels=True) as f:
            window = f.header()["dataWindow"]
            w, h = (int(window[1][i]) - int(window[0][i]) + 1 for i in (0, 1))
            if w * h > MAX_PIXELS:
                raise InputError(f"{path} has {w} × {h} pixels, more than this program reads")
            channels = {k: v.pixels for k, v in f.channels().items()}
    except InputError:
        raise
    except Exception:  # the binding raises bare RuntimeError, TypeError and KeyError
        raise InputError(f"{path} is not a readable OpenEXR file") from None
    try:
        planes = [channels[c] for c in "RGB"]
    except KeyError:
        if not channels:
            raise InputError(f"{path} has no image channels") from None
        grey = channels.get("Y", next(iter(channels.values())))
        planes = [grey] * 3
    if any(p.shape != planes[0].shape for p in planes):
        raise InputError(f"{path} has subsampled channels; save it as plain RGB")
    return np.stack(planes, -1).astype(np.float32)


def _read_integer(path: Path, linear: bool) -> Array:
    try:
        with Image.open(path) as im:
            if im.width * im.height > MAX_PIXELS:
                raise InputError(f"{path} has {im.width} × {im.height} pixels, too many to read")
            im.load()
            if im.mode in ("I;16", "I;16B", "I;16L", "I"):
                grey = np.asarray(im, dtype=np.float32) / 65535
                data = np.repeat(grey[..., None], 3, -1)
            else:
                data = np.asarray(im.convert("RGB"), dtype=np.float32) / 255
    except InputError:
        raise
    except Exception:  # Pillow's decoders raise many kinds
        raise InputError(f"{path} is not a readable image") from None
    return data.astype(np.float32) if linear else srgb_to_linear(data)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it when the block ends without an error."""
    path = Path(path)
    fd, name = tempfile.mkstemp(prefix=".", suffix=path.suffix, dir=path.parent)
    os.close(fd)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_exr(path: Path, image: Array, *, half: bool = False) -> None:
    """Write (H, W) or (H, W, 3) linear values; refuses NaN and infinity."""
    image = np.asarray(image)
    if not np.all(np.isfinite(image)):
        raise ValueError(f"refusing to write non-finite values to {path}")
    data = np.ascontiguousarray(image.astype(np.float16 if half else np.float32))
    channel = {"RGB" if data.ndim == 3 else "Y": data}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary, OpenEXR.File(header, channel) as f:
        f.write(str(temporary))


def write_png(path: Path, image: Array, *, linear: bool = False) -> None:
    """Write (H, W) or (H, W, 3) values in [0, 1] as 8 bits, sRGB-encoded unless ``linear``."""
    if not np.all(np.isfinite(image)):
        raise ValueError(f"refusing to write non-finite values to {path}")
    data = np.clip(image, 0, 1) if linear else linear_to_srgb(np.asarray(image))
    with atomic_path(path) as temporary:
        Image.fromarray((data * 255 + 0.5).astype(np.uint8)).save(temporary, format="PNG")
