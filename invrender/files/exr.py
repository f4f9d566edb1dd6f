"""OpenEXR: one layer's colours, by name, in the display window, as linear Rec. 709."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from invrender.colour import PRIMARIES, to_xyz
from invrender.files.raster import LINEAR, Encoding, Raster, check_size, encoding, interop_encoding
from invrender.types import Array, InputError

# Names of the layer that holds the picture, the best first; "" is the one without a name.
_PICTURE = ("", "combined", "beauty", "rgba", "rgb")
_DEEP = (OpenEXR.deepscanline, OpenEXR.deeptile)
# What OpenImageIO writes into ``oiio:ColorSpace``, as colour interop IDs.
_OIIO = {
    "srgb": "srgb_rec709", "srgb_texture": "srgb_rec709", "lin_srgb": "lin_rec709",
    "lin_rec709": "lin_rec709", "linear": "lin_rec709", "scene_linear": "lin_rec709",
    "acescg": "lin_ap1", "lin_ap1": "lin_ap1", "aces2065-1": "lin_ap0", "lin_ap0": "lin_ap0",
    "lin_p3d65": "lin_p3d65", "lin_rec2020": "lin_rec2020", "lin_adobergb": "lin_adobergb",
    "g22_rec709": "g22_rec709", "g18_rec709": "g18_rec709", "adobergb": "g22_adobergb",
}  # fmt: skip


def read_exr(path: Path) -> Raster:
    """The picture in an EXR file, in its display window; what no pixel fills is black.

    The layer without a name is taken, else Combined, beauty or rgba; of luminance-chroma files
    (Y, RY, BY) the colours. Raises `InputError` for other layers, deep pixels, damaged files.
    """
    try:
        return _read(path)
    except InputError:
        raise
    except Exception:  # the binding raises bare RuntimeError, TypeError and KeyError
        raise InputError(f"{path} is not a readable OpenEXR file") from None


def _read(path: Path) -> Raster:
    with OpenEXR.File(str(path), header_only=True) as f:
        headers = [dict(part.header) for part in f.parts]
    if not headers:
        raise ValueError
    index, layer, names = _choose(path, headers)
    header = headers[index]
    low, high = (np.asarray(v, np.int64) for v in header["dataWindow"])
    shown_low, shown_high = (np.asarray(v, np.int64) for v in header["displayWindow"])
    # Every channel of every part is decoded, and the picture is pasted into its window.
    stored = sum(
        int(np.prod(np.asarray(h["dataWindow"][1], np.int64) - h["dataWindow"][0] + 1))
        * len(h["channels"])
        for h in headers
    )
    size = shown_high - shown_low + 1
    check_size(path, int(size[0]), int(size[1]), 6)
    check_size(path, int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1, 6)
    # Each is decoded, and copied once, in two bytes or in four.
    check_size(path, 1, max(stored, 1), 4)
    with OpenEXR.File(str(path), separate_channels=True) as f:
        found = f.parts[index].channels
        planes = {n: found[layer + n].pixels for n in names}
    raster = Raster(np.empty((0, 0, 3), np.float32), _encoding(path, header, layer))
    shape = (int(high[1] - low[1]) + 1, int(high[0] - low[0]) + 1)
    colours = _colours(path, raster, header, planes, shape)
    alpha = planes.get("A")
    alpha = None if alpha is None else _window(alpha.astype(np.float32), low, shown_low, size)
    raster.partial = bool(np.any(low > shown_low) or np.any(high < shown_high))
    raster.data = _window(colours, low, shown_low, size)
    if alpha is not None and not np.all(alpha == 1) and not raster.partial:
        raster.alpha, raster.premultiplied = alpha.astype(np.float32), True
    raster.aspect = float(header.get("pixelAspectRatio", 1.0))
    orientation = header.get("Orientation", 1)
    raster.orientation = int(orientation) if isinstance(orientation, (int, np.integer)) else 1
    if layer:
        raster.note("photo-layer", f"the layer '{layer[:-1]}' of the file was taken")
    return raster


def _choose(path: Path, headers: list[dict[str, Any]]) -> tuple[int, str, list[str]]:
    """(part, prefix of the layer's channels, their names after it) of the picture."""
    found: dict[tuple[int, str], list[str]] = {}
    for index, header in enumerate(headers):
        for channel in header["channels"]:
            layer, dot, name = channel.name.rpartition(".")
            found.setdefault((index, layer + dot), []).append(name)
    ranked: dict[int, list[tuple[int, str]]] = {}
    for (index, prefix), names in found.items():
        part = str(headers[index].get("name", "")) if len(headers) > 1 else ""
        title = (prefix[:-1] or part).rpartition(".")[2].lower()
        if len(headers) > 1 and index == 0 and not prefix and not part:
            title = ""
        if title in _PICTURE and (set("RGB") <= set(names) or "Y" in names):
            ranked.setdefault(_PICTURE.index(title), []).append((index, prefix))
    best = ranked[min(ranked)] if ranked else []
    if len(best) == 1 and headers[best[0][0]].get("type") not in _DEEP:
        names = found[best[0]]
        if set("RGB") <= set(names):
            wanted = ["R", "G", "B"]
        else:
            wanted = [c for c in ("Y", "RY", "BY") if c in names]
        if len(wanted) != 2:
            return (*best[0], wanted + ["A"] * ("A" in names))
    if any(h.get("type") in _DEEP for h in headers):
        raise InputError(f"{path} holds deep pixels; flatten it and save it as plain RGB")
    listed = ", ".join(
        (f"{headers[i].get('name', i)}: " if len(headers) > 1 else "") + prefix + "".join(names)
        for (i, prefix), names in found.items()
    )
    what = "more than one picture" if len(best) > 1 else "no layer R, G, B or Y to take"
    raise InputError(
        f"{path} has {what}; save the picture alone as R, G, B (it has {listed[:300] or 'nothing'})"
    )


def _encoding(path: Path, header: dict[str, Any], layer: str) -> Encoding:
    """What the header says of its colours; plain values are linear Rec. 709."""
    told = str(header.get("colorInteropID", ""))
    if told in ("", "data", "unknown", "bypass"):
        oiio = str(header.get("oiio:ColorSpace", "")).lower()
        told = _OIIO.get(oiio, oiio if interop_encoding(oiio) else "")
    if told:
        known = interop_encoding(told)
        if known is not None:
            return LINEAR if told.startswith("lin_rec709") else known
        if "chromaticities" not in header:
            raise InputError(
                f"{path} has the colour space '{told[:40]}', which this program does not know; "
                "save it as linear Rec. 709"
            )
    values = header.get("chromaticities")
    if values is None and header.get("acesImageContainerFlag"):
        values = PRIMARIES["ap0"]
    if values is None:
        return LINEAR
    try:
        numbers = tuple(float(v) for v in np.ravel(values))
        found = encoding("the file's chromaticities", None, numbers)
    except ValueError:
        raise InputError(f"{path} has chromaticities that span no colours") from None
    return LINEAR if found.matrix is None else found


def _colours(
    path: Path,
    raster: Raster,
    header: dict[str, Any],
    planes: dict[str, Any],
    shape: tuple[int, int],
) -> Array:
    """(H, W, 3) of the data window from R, G, B, from Y alone, or from Y, RY and BY."""
    if all(c in planes and planes[c].shape == shape for c in "RGB"):
        return np.stack([planes.pop(c) for c in "RGB"], -1)
    full = {n: np.asarray(p, np.float32) for n, p in planes.items()}
    if "RY" in full:
        for name in ("RY", "BY"):
            if full[name].shape != shape:
                full[name] = _enlarged(full[name], shape)
                raster.warn(
                    "photo-chroma",
                    "the photo's colours are stored at a lower resolution than its brightness; "
                    "save it as plain RGB",
                )
        raster.warnings = raster.warnings[:1]
        raster.note("photo-colour-model", "luminance and chroma were turned into RGB")
    if "Y" not in full or any(p.shape != shape for p in full.values()):
        raise InputError(f"{path} has subsampled channels; save it as plain RGB")
    y = full["Y"]
    if "RY" not in full:
        return y[..., None].repeat(3, -1)
    # OpenEXR's technical introduction: RY = (R - Y)/Y, BY = (B - Y)/Y.
    weights = to_xyz(np.ravel(header.get("chromaticities", PRIMARIES["rec709"])).tolist())[1]
    red, blue = (full["RY"] + 1) * y, (full["BY"] + 1) * y
    green = (y - weights[0] * red - weights[2] * blue) / weights[1]
    return np.stack([red, green, blue], -1).astype(np.float32)


def _enlarged(plane: Array, shape: tuple[int, int]) -> Array:
    """A subsampled channel at full size; its samples lie on the pixels 0, 2, 4 … (bilinear)."""
    for axis, size in enumerate(shape):
        step = -(-size // plane.shape[axis])
        at = np.clip(np.arange(size) / step, 0, plane.shape[axis] - 1)
        low = at.astype(int)
        high = np.minimum(low + 1, plane.shape[axis] - 1)
        weight = (at - low).astype(np.float32)
        weight = weight[:, None] if axis == 0 else weight
        plane = plane.take(low, axis) * (1 - weight) + plane.take(high, axis) * weight
    return plane


def _window(plane: Any, low: Any, shown_low: Any, size: Any) -> Array:
    """Pixels of the data window in the display window of ``size``; black where there are none."""
    x, y = (int(v) for v in low - shown_low)
    width, height = (int(v) for v in size)
    if (x, y) == (0, 0) and plane.shape[:2] == (height, width):
        return plane
    shown = np.zeros((height, width, *plane.shape[2:]), plane.dtype)
    rows = slice(max(y, 0), min(y + plane.shape[0], height))
    columns = slice(max(x, 0), min(x + plane.shape[1], width))
    if rows.start < rows.stop and columns.start < columns.stop:
        shown[rows, columns] = plane[
            rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
        ]
    return shown
