"""Environment light from files, equirectangular EXR and Radiance HDR."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from invrender.files.images import read_image
from invrender.sphere import resample_environment
from invrender.types import Array, InputError

log = logging.getLogger("invrender")

HDR_SUFFIXES = (".exr", ".hdr", ".pic")


def read_environment(path: Path, height: int | None = None) -> Array:
    """Read an equirectangular EXR or Radiance HDR as (H, 2H, 3) float32 linear radiance.

    The top row is up; the azimuth is taken as it lies in the file. ``height`` resamples, keeping
    the flux. Negative values become zero, with a line saying so. Raises `InputError` for anything
    unreadable, not twice as wide as high, or black.
    """
    path = Path(path)
    env = read_image(path)
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
    found = sorted(p for p in root.rglob("*") if p.suffix.lower() in HDR_SUFFIXES and p.is_file())
    if not found:
        raise InputError(f"{root} holds no .exr or .hdr environments")
    return found
