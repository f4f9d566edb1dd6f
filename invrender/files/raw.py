"""Camera raw files, by LibRaw (the optional package ``rawpy``), and what DNGs say of their lens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from invrender.files.opcodes import GainMap, Opcodes, Warp, read_opcodes, sensor_gain
from invrender.files.raster import LINEAR, Raster, check_size
from invrender.files.tiff import tiff_exif
from invrender.types import InputError

SENSOR_SATURATED = 0.99  # of the sensor's range
HALF_SIZE = 52_000_000  # pixels from which each 2 × 2 sites make one pixel, without interpolation
_OPCODE_LISTS = {1: 51008, 2: 51009, 3: 51022}
_SENSOR = (32803, 34892)  # photometric: a mosaic, and a linear image of the sensor
# EXIF orientation of LibRaw's flip; its bits: 1 left to right, 2 top to bottom, 4 rows for columns.
_ORIENTATION = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}


def read_raw(path: Path) -> Raster:
    """Develop a raw photo into linear Rec. 709 codes of 16 bits, 1 being the sensor's range.

    The camera's white balance, no automatic brightness, no curve, no repair of highlights; a DNG's
    lens corrections (`invrender.files.opcodes`) are applied. Where a site of the sensor is
    saturated, the pixels around it have their greatest channel at 1, whatever the camera's colour
    matrix makes of them. Raises `InputError` for a damaged file, and where rawpy is missing.
    """
    try:
        import rawpy
    except ModuleNotFoundError:
        raise InputError(
            f"{path} is a camera raw file; to read it: pip install 'invrender[raw]', or save it as "
            "a 16-bit TIFF"
        ) from None
    raster = Raster(np.empty((0, 0, 3), np.uint16), LINEAR, white=65535, saturated=1.0)
    try:
        raster.tags, opcodes = _tags(path)
        with rawpy.imread(str(path)) as raw:
            sizes = raw.sizes
            # LibRaw holds four channels of two bytes, and makes three of them of that.
            check_size(path, sizes.width, sizes.height, 16)
            half = sizes.width * sizes.height > HALF_SIZE
            white = int(raw.white_level)
            plane = raw.raw_image_visible
            full: NDArray[np.bool_] | None = None
            if white and plane is not None:
                full = np.asarray(plane >= SENSOR_SATURATED * white)
                full = np.asarray(full[..., :3].any(-1)) if full.ndim == 3 else full
            if not any(raw.camera_whitebalance[:3]):
                raster.warn(
                    "photo-white-balance",
                    "the raw photo has no white balance; the daylight's was taken",
                )
            new_white = _apply_to_sensor(raster, raw, opcodes, white)
            data = raw.postprocess(
                gamma=(1, 1), no_auto_bright=True, use_camera_wb=True, output_bps=16, user_flip=0,
                output_color=rawpy.ColorSpace.sRGB, highlight_mode=rawpy.HighlightMode.Clip,
                adjust_maximum_thr=0.0, half_size=half,
                user_sat=new_white,
            )  # fmt: skip
            flip = sizes.flip
    except InputError:
        raise
    except Exception:  # LibRaw has an exception of its own for each step
        raise InputError(f"{path} is not a readable camera raw file, or not complete") from None
    codes = _apply_to_image(
        raster, data.astype(np.uint16, copy=False), opcodes, new_white is not None
    )
    if full is not None and full.any():
        _mark(codes, full)
    raster.data = codes
    raster.orientation = _ORIENTATION.get(int(flip), 1)
    if half:
        raster.note("photo-half-size", "each 2 × 2 sites of the large sensor made one pixel")
    return raster


def _tags(path: Path) -> tuple[dict[int, Any], Opcodes]:
    """EXIF tags of the raw formats that are TIFFs, and a DNG's lens corrections."""
    try:
        with tifffile.TiffFile(path) as f:
            first = f.pages[0]
            tags = tiff_exif(first)
            lists: dict[int, bytes] = {}
            for page in (first, *(first.pages or ())):  # type: ignore[union-attr]
                if int(getattr(page, "photometric", 0)) in _SENSOR:
                    found = {k: page.tags.get(n) for k, n in _OPCODE_LISTS.items()}
                    lists = {k: bytes(t.value) for k, t in found.items() if t is not None}
    except Exception:  # not a TIFF
        return {}, Opcodes()
    return tags, read_opcodes(path, lists)


def _apply_to_sensor(raster: Raster, raw: Any, opcodes: Opcodes, white: int) -> int | None:
    """Multiply the mosaic by the gains of list 2; returns its new level of white, None for the old.

    What the largest gain makes of white is white after it, so that nothing is cut off.
    """
    plane = raw.raw_image_visible
    if not opcodes.sensor or plane is None or plane.ndim != 2 or not white:
        return None
    gain = sensor_gain(opcodes.sensor, plane.shape)
    most = float(gain.max())
    blacks = np.asarray(raw.black_level_per_channel, np.float32)
    black = blacks[np.minimum(raw.raw_colors_visible, len(blacks) - 1)]
    lowest = float(blacks.min())
    fit = min(1.0, (65535 - float(blacks.max())) / max((white - lowest) * most, 1))
    plane[:] = np.clip((plane - black) * gain * fit + black + 0.5, 0, 65535).astype(plane.dtype)
    raster.note("photo-lens-shading", "the file's lens shading correction (gain map) was applied")
    return round(lowest + (white - lowest) * most * fit)


def _apply_to_image(
    raster: Raster, data: NDArray[np.uint16], opcodes: Opcodes, on_sensor: bool
) -> NDArray[np.uint16]:
    """Apply list 3, and list 2 where there was no mosaic; brightest is 65535 again."""
    if opcodes.skipped:
        raster.warn(
            "photo-lens-uncorrected",
            f"lens corrections in the file were left out: {', '.join(opcodes.skipped)}",
        )
    steps = (*(() if on_sensor else opcodes.sensor), *opcodes.image)
    if not steps:
        return data
    image = data.astype(np.float32)
    shape = image.shape[0], image.shape[1]
    most = 1.0
    for step in steps:
        if isinstance(step, Warp):
            image = step.warped(image)
            raster.note("photo-distortion", "the file's lens distortion correction was applied")
        else:
            first = step.planes[0] if isinstance(step, GainMap) else 0
            gain = sensor_gain((step,), shape, first)
            most *= float(gain.max())
            image *= gain[..., None]
            raster.note("photo-lens-shading", "the file's vignetting correction was applied")
    return np.clip(image / max(most, 1e-6) + 0.5, 0, 65535).astype(np.uint16)


def _mark(image: NDArray[np.uint16], full: NDArray[np.bool_]) -> None:
    """Set the greatest channel to white where one of the 3 × 3 sites of the sensor is saturated."""
    from scipy import ndimage

    full = ndimage.maximum_filter(full, 3)
    step = max(1, round(full.shape[0] / image.shape[0]))
    if step > 1:
        height, width = image.shape[:2]
        full = full[: height * step, : width * step]
        missing = height * step - full.shape[0], width * step - full.shape[1]
        full = np.pad(full, [(0, n) for n in missing])
        full = np.asarray(full.reshape(height, step, width, step).any((1, 3)))
    if full.shape == image.shape[:2]:
        rows, columns = np.nonzero(full)
        image[rows, columns, image[rows, columns].argmax(-1)] = 65535
