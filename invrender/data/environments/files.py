"""Environment light from files, equirectangular EXR and Radiance HDR."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from invrender.files.images import MAX_PIXELS, read_image
from invrender.sphere import resample_environment
from invrender.types import Array, InputError

log = logging.getLogger("invrender")

SUFFIXES = (".exr", ".hdr", ".pic")


def read_environment(path: Path, height: int | None = None) -> Array:
    """Read an equirectangular EXR or Radiance HDR as (H, 2H, 3) float32 linear radiance.

    The top row is up; the azimuth is taken as it lies in the file. ``height`` resamples, keeping
    the flux. Negative values become zero, with a line saying so. Raises `InputError` for anything
    unreadable, not twice as wide as high, or black.
    """
    path = Path(path)
    env = _read_hdr(path) if path.suffix.lower() in (".hdr", ".pic") else read_image(path)
    h, w = env.shape[:2]
    if h < 2 or abs(w - 2 * h) > 0.02 * w:
        raise InputError(
            f"{path} has {w} × {h} pixels; an equirectangular environment is twice as wide as high"
        )
    if np.any(env < 0):
        log.warning("%s has negative radiance, taken as zero", path)
        env = np.maximum(env, 0)
    if not np.any(env[: max(h // 2, 1)] > 0):
        raise InputError(f"{path} is black above the horizon")
    return resample_environment(env, height if height is not None else h)


def find_environments(root: Path) -> list[Path]:
    """All EXR and HDR files below a folder, sorted. Raises `InputError` when there is none."""
    root = Path(root)
    found = sorted(p for p in root.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    if not found:
        raise InputError(f"{root} holds no .exr or .hdr environments")
    return found


def _read_hdr(path: Path) -> Array:
    """Radiance RGBE, flat or run-length encoded."""
    try:
        data = path.read_bytes()
    except OSError:
        raise InputError(f"{path} does not exist or cannot be read") from None
    try:
        if not data.startswith((b"#?RADIANCE", b"#?RGBE")):
            raise ValueError
        end = data.index(b"\n\n") + 2
        stop = data.index(b"\n", end)
        sign_y, h_text, sign_x, w_text = data[end:stop].split()
        height, width = int(h_text), int(w_text)
        if (sign_y, sign_x) != (b"-Y", b"+X") or height < 1 or width < 1:
            raise ValueError
        if height * width > MAX_PIXELS:
            raise InputError(f"{path} has {width} × {height} pixels, more than this program reads")
        rgbe = _decode_rgbe(np.frombuffer(data, np.uint8, offset=stop + 1), height, width)
    except InputError:
        raise
    except (ValueError, IndexError):
        raise InputError(f"{path} is not a readable Radiance HDR file") from None
    exponent = rgbe[..., 3].astype(np.int32)
    scale = np.where(exponent > 0, np.ldexp(np.float32(1), exponent - 136), 0)
    return ((rgbe[..., :3] + np.float32(0.5)) * scale[..., None]).astype(np.float32)


def _decode_rgbe(data: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    out = np.empty((height, width, 4), np.uint8)
    if not (8 <= width < 32768 and data[0] == 2 and data[1] == 2 and data[2] < 128):
        if len(data) < height * width * 4:
            raise ValueError
        return data[: height * width * 4].reshape(height, width, 4)
    at = 0
    for row in range(height):
        head = [int(v) for v in data[at : at + 4]]
        if head != [2, 2, width >> 8, width & 255]:
            raise ValueError
        at += 4
        for channel in range(4):
            x = 0
            while x < width:
                n = int(data[at])
                if n > 128:
                    out[row, x : x + n - 128, channel] = data[at + 1]
                    at, x = at + 2, x + n - 128
                else:
                    run = data[at + 1 : at + 1 + n]
                    if n == 0 or x + n > width or len(run) < n:
                        raise ValueError
                    out[row, x : x + n, channel] = run
                    at, x = at + 1 + n, x + n
            if x != width:
                raise ValueError
    return out
