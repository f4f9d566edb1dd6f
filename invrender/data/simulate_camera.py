"""A phone's camera: what its lens, its sensor and its developer make of the light."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass

import numpy as np
from PIL import Image
from scipy import ndimage

from invrender.colour import PRIMARIES, adaptation, linear_to_srgb, to_rec709, to_xyz, white_xyz
from invrender.rig import lens_gain
from invrender.types import Array

WIDER = 1.04  # of the render, so that a barrel distortion finds something in the corners
READ_NOISE = 3.0  # electrons
# Millimetres: half of the width of 4 : 3 whose diagonal is that of 36 × 24 (CIPA DCG-001).
HALF_WIDTH = 0.4 * 43.267
F_NUMBER = 1.8  # a phone's main camera
_PCS_WHITE = np.array([0.9642, 1.0, 0.8249])  # the white of ICC profiles


@dataclass(frozen=True)
class Camera:
    """A phone's camera; by default an ideal one.

    distortion: by how much of its distance from the photo's middle a corner is displaced, outward
    if positive. vignetting: the share of light that a corner lacks. blur: standard deviation in
    pixels of a photo 1,280 wide. electrons: that a white pixel collects, from which its noise
    follows; infinite for none. Of a JPEG: shoulder and contrast of its tone curve (`toned`),
    display_p3 its colours, quality its own.
    """

    distortion: float = 0.0
    vignetting: float = 0.0
    blur: float = 0.0
    electrons: float = float("inf")
    shoulder: float = 0.0
    contrast: float = 0.0
    display_p3: bool = False
    quality: int = 95

    @property
    def wider(self) -> float:
        """How many times wider than the photo the light is rendered that `seen` takes."""
        return WIDER if self.distortion else 1.0


def seen(camera: Camera, radiance: Array, height: int, width: int) -> Array:
    """What falls on the sensor, (height, width, 3).

    radiance: by a pinhole camera whose pixels are as large, but `Camera.wider` as many a row.
    """
    image = radiance
    # Distance of each pixel from the middle, that of a corner being 1, and the way there.
    y, x = (np.arange(n) + 0.5 - n / 2 for n in (height, width))
    r2 = (x[None, :] ** 2 + y[:, None] ** 2) / (width**2 / 4 + height**2 / 4)
    if camera.distortion:
        scale = np.ones_like(r2)  # of the way to where the light would have gone without the lens
        for _ in range(12):
            scale = 1 / (1 + camera.distortion * r2 * scale**2)
        rows = y[:, None] * scale + radiance.shape[0] / 2 - 0.5
        columns = x[None, :] * scale + radiance.shape[1] / 2 - 0.5
        image = np.stack([
            ndimage.map_coordinates(c, [rows, columns], order=1, mode="nearest")
            for c in np.moveaxis(radiance, -1, 0)
        ], -1)  # fmt: skip
    if camera.vignetting:
        image = image / lens_gain(camera.vignetting, r2)[..., None]
    if camera.blur:
        sigma = camera.blur * width / 1280
        image = ndimage.gaussian_filter(image, (sigma, sigma, 0))
    return np.asarray(image, np.float32)


def developed(
    camera: Camera, light: Array, exposure: float, rng: np.random.Generator, clip: bool = True
) -> Array:
    """Linear values, 1 is white: light on the sensor times ``exposure``, with noise, cut at white
    unless ``clip`` is false."""
    values = light * np.float32(exposure)
    if np.isfinite(camera.electrons):
        full = camera.electrons
        noise = np.sqrt(np.maximum(values, 0) / full + (READ_NOISE / full) ** 2)
        values = values + noise * rng.standard_normal(values.shape)
    return np.asarray(np.clip(values, 0, 1 if clip else None), np.float32)


def toned(camera: Camera, values: Array) -> Array:
    """Codes in [0, 1] of linear values in [0, 1]: the shoulder (1 + k)x/(1 + kx), then the sRGB
    curve, then a share ``contrast`` of the way to the smooth step 3e² - 2e³."""
    k = camera.shoulder
    e = linear_to_srgb((1 + k) * values / (1 + k * values))
    return np.asarray(e + camera.contrast * (3 * e**2 - 2 * e**3 - e), np.float32)


def to_jpeg(camera: Camera, values: Array, fov: float, exposure: float) -> bytes:
    """A JPEG of linear Rec. 709 values, with its profile and its EXIF: the lens by ``fov``
    (degrees), and the time by ``exposure`` (1 is a hundredth of a second)."""
    profile = None
    if camera.display_p3:
        values = np.clip(values @ np.linalg.inv(to_rec709(PRIMARIES["p3d65"])).T, 0, 1)
        profile = _p3_profile()
    codes = (toned(camera, values) * 255 + 0.5).astype(np.uint8)
    exif = Image.Exif()
    tags = exif.get_ifd(0x8769)
    tags[0x829A] = float(exposure / 100)  # exposure time, seconds
    tags[0x829D], tags[0x8827] = F_NUMBER, 100  # aperture, ISO
    tags[0xA405] = round(
        HALF_WIDTH / np.tan(np.radians(fov) / 2)
    )  # focal length at 36 mm, millimetres
    exif[0x8769] = tags
    with io.BytesIO() as file:
        options = {"icc_profile": profile} if profile else {}
        Image.fromarray(codes).save(
            file, "JPEG", quality=camera.quality, subsampling=0, exif=exif.tobytes(), **options
        )
        return file.getvalue()


def _p3_profile() -> bytes:
    """Display P3 as an ICC v4 profile: primaries, and the sRGB curve."""

    def s15(*values: float) -> bytes:
        return b"".join(struct.pack(">i", round(x * 65536)) for x in values)

    def text(words: str) -> bytes:
        wide = words.encode("utf-16-be")
        head = struct.pack(">II", 1, 12) + b"enUS" + struct.pack(">II", len(wide), 28)
        return b"mluc" + bytes(4) + head + wide

    p3 = PRIMARIES["p3d65"]
    to_d50 = adaptation(white_xyz(*p3[6:8]), _PCS_WHITE)
    matrix = to_d50 @ to_xyz(p3)
    curve = struct.pack(">HH", 3, 0) + s15(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
    tags = {
        b"desc": text("Display P3"), b"cprt": text("CC0"),
        b"wtpt": b"XYZ " + bytes(4) + s15(*_PCS_WHITE),
        b"chad": b"sf32" + bytes(4) + s15(*to_d50.ravel()),
    }  # fmt: skip
    for k, c in enumerate(b"rgb"):
        tags[bytes([c]) + b"XYZ"] = b"XYZ " + bytes(4) + s15(*matrix[:, k])
        tags[bytes([c]) + b"TRC"] = b"para" + bytes(4) + curve
    at, table, data = 128 + 4 + 12 * len(tags), b"", b""
    for key, value in tags.items():
        value += bytes(-len(value) % 4)
        table += key + struct.pack(">II", at + len(data), len(value))
        data += value
    head = struct.pack(">II", at + len(data), 0) + struct.pack(">I", 0x04300000)
    head += b"mntrRGB XYZ " + struct.pack(">6H", 2026, 1, 1, 0, 0, 0)
    head += b"acsp" + bytes(28) + s15(*_PCS_WHITE) + bytes(48)
    return head + struct.pack(">I", len(tags)) + table + data
