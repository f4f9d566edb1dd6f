"""ICC profiles, by LittleCMS: what an image's codes stand for in linear Rec. 709."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.colour import PRIMARIES, srgb_to_linear
from invrender.files.raster import SRGB, Encoding
from invrender.types import Array, InputError

_SPACES = {b"RGB ": ("rgb", 3), b"GRAY": ("gray", 1), b"CMYK": ("cmyk", 4), b"Lab ": ("lab", 3)}
RELATIVE = 1  # rendering intent, relative colorimetric: white stays white, no black point moved
NEAR = 2e-3  # of white; a colour table's own accuracy


def icc_encoding(path: Path, profile: bytes, channels: int, levels: int) -> Encoding:
    """The encoding that a profile describes, for an image of so many channels (1, 3 or 4).

    Where channels can be taken apart (curves and a matrix, the rule for RGB) this is a curve known
    at ``levels`` codes and a matrix, else pixels are converted one by one. Raises `InputError` for
    a damaged profile and for one of another colour model.
    """
    space, count = _SPACES.get(profile[16:20], ("", 0))
    if not count or profile[36:40] != b"acsp":
        raise InputError(f"{path} has a damaged colour profile; save it as sRGB")
    if count != channels and not (count == 3 and channels == 1):
        raise InputError(
            f"{path} has a colour profile for {space.upper()} on {channels} channel"
            f"{'s' * (channels > 1)}; save it as sRGB"
        )
    name = _name(profile)
    try:
        if space in ("cmyk", "lab"):
            return Encoding(name, convert=lambda values: _transform(values, profile, space))
        return _separable(name, profile, space, levels) or Encoding(
            name, convert=lambda values: _transform(values, profile, space)
        )
    except (RuntimeError, ValueError):
        raise InputError(f"{path} has a damaged colour profile; save it as sRGB") from None


def _name(profile: bytes) -> str:
    from PIL import ImageCms

    try:
        text = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except Exception:  # a damaged tag of text
        text = ""
    return " ".join(text.split())[:60] or "a colour profile"


@cache
def _linear_rec709() -> bytes:
    import imagecodecs

    p = PRIMARIES["rec709"]
    profile = imagecodecs.cms_profile(
        "rgb",
        whitepoint=[p[6], p[7], 1.0],
        primaries=[p[0], p[1], 1.0, p[2], p[3], 1.0, p[4], p[5], 1.0],
        gamma=1.0,
    )
    return bytes(profile)


def _transform(values: NDArray[Any], profile: bytes, space: str) -> Array:
    """(N, C) codes of 8 or 16 bits, or floats in [0, 1], to (N, 3) linear Rec. 709."""
    import imagecodecs

    channels = {"gray": 1, "cmyk": 4}.get(space, 3)
    if values.shape[1] == 1 < channels:
        values = values.repeat(channels, 1)
    shape = (1, len(values)) if channels == 1 else (1, len(values), channels)
    out = imagecodecs.cms_transform(
        np.ascontiguousarray(values[:, :channels]).reshape(shape), profile, _linear_rec709(),
        colorspace=space, outcolorspace="rgb", outdtype="f4", intent=RELATIVE,
    )  # fmt: skip
    light = np.asarray(out).reshape(-1, 3)
    if not np.all(np.isfinite(light)):
        raise ValueError("the profile gives no numbers")
    return light


def _separable(name: str, profile: bytes, space: str, levels: int) -> Encoding | None:
    """Curves and matrix of a profile that adds its channels' light, else None."""
    ramp = np.linspace(0, 1, levels, dtype=np.float32)
    if space == "gray":
        light = _transform(ramp[:, None], profile, space)
        matrix = np.diag(light[-1]).astype(np.float64)
        curves = light[:, :1].repeat(3, 1) / light[-1, 0] if light[-1, 0] > 0 else light
    else:
        alone = np.zeros((3, levels, 3), np.float32)
        for k in range(3):
            alone[k, :, k] = ramp
        light = _transform(alone.reshape(-1, 3), profile, space).reshape(3, levels, 3)
        matrix = light[:, -1].T.astype(np.float64)
        some = np.random.default_rng(0).random((64, 3)).astype(np.float32)
        length = (matrix**2).sum(0)
        if length.min() < NEAR:
            return None
        curves = np.stack([light[k] @ matrix[:, k] / length[k] for k in range(3)], -1)
        guess = np.stack([np.interp(some[:, k], ramp, curves[:, k]) for k in range(3)], -1)
        if np.abs(guess @ matrix.T - _transform(some, profile, space)).max() > 2 * NEAR:
            return None
    white = np.allclose(matrix, np.eye(3), atol=NEAR)
    if white and np.abs(curves - srgb_to_linear(ramp)[:, None]).max() < NEAR:
        return Encoding(name, SRGB.curve)
    linear = np.abs(curves - ramp[:, None]).max() < NEAR
    steps = np.asarray(curves, np.float32)

    def curve(x: Array) -> Array:
        x = np.asarray(x, np.float32)
        light = np.stack([np.interp(x[..., k], ramp, steps[:, k]) for k in range(3)], -1)
        over = x.max(-1) > 1  # float images
        if over.any():
            exact = _transform(x[over], profile, space) @ np.linalg.inv(matrix).T
            light[over] = np.where(x[over] > 1, exact, light[over])
        return light.astype(np.float32)

    return Encoding(name, None if linear else curve, None if white else matrix)
