"""Camera raw files, by LibRaw (the optional package ``rawpy``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from invrender.files.images import check_size, tiff_exif
from invrender.types import InputError

SATURATED = 0.99  # of the sensor's range


def read_raw(path: Path) -> tuple[NDArray[np.float32], dict[int, Any]]:
    """Develop a raw photo into (H, W, 3) linear sRGB primaries in [0, 1], upright; its EXIF tags.

    The camera's white balance, no automatic brightness, no curve, no repair of highlights: 1 is
    the sensor's range. Where a site of the sensor is saturated, the pixels around it have their
    greatest channel at 1, whatever the camera's colour matrix makes of them. Raises `InputError`
    for a damaged file, and where rawpy is missing.
    """
    try:
        import rawpy
    except ModuleNotFoundError:
        raise InputError(
            f"{path} is a camera raw file; to read it: pip install 'invrender[raw]', or save it as "
            "a 16-bit TIFF"
        ) from None
    try:
        with rawpy.imread(str(path)) as raw:
            sizes = raw.sizes
            check_size(path, sizes.width, sizes.height)
            data = raw.postprocess(
                gamma=(1, 1), no_auto_bright=True, use_camera_wb=True, output_bps=16,
                output_color=rawpy.ColorSpace.sRGB, highlight_mode=rawpy.HighlightMode.Clip,
            )  # fmt: skip
            white = raw.white_level
            full = raw.raw_image_visible >= SATURATED * white if white else None
            flip = sizes.flip
    except InputError:
        raise
    except Exception:  # LibRaw has an exception of its own for each step
        raise InputError(f"{path} is not a readable camera raw file") from None
    image = np.divide(data, 65535, dtype=np.float32)
    if full is not None and full.any():
        _mark(image, full, flip)
    return image, _tags(path)


def _mark(image: NDArray[np.float32], full: NDArray[np.bool_], flip: int) -> None:
    """Set the greatest channel to 1 where one of the 3 × 3 sites of the sensor is saturated."""
    from scipy import ndimage

    full = ndimage.maximum_filter(full, 3)
    # LibRaw's bits: 1 left to right, 2 top to bottom, 4 rows for columns.
    full = full[::-1] if flip & 2 else full
    full = full[:, ::-1] if flip & 1 else full
    full = full.T if flip & 4 else full
    if full.shape == image.shape[:2]:
        rows, columns = np.nonzero(full)
        image[rows, columns, image[rows, columns].argmax(-1)] = 1


def _tags(path: Path) -> dict[int, Any]:
    """EXIF tags of the raw formats that are TIFFs; none of the others."""
    try:
        with tifffile.TiffFile(path) as f:
            page = f.pages[0]
            return tiff_exif(page) if isinstance(page, tifffile.TiffPage) else {}
    except Exception:  # not a TIFF
        return {}
