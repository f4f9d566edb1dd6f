"""The patterns that a capture's photos are taken under, one after another."""

from __future__ import annotations

import io
from functools import cache

import numpy as np

from invrender.pattern.default import default_pattern
from invrender.pattern.display import PAGE_PIXELS, encoded
from invrender.types import Array

HALVES = {
    "right": (slice(None), slice(128, None)),
    "left": (slice(None), slice(None, 128)),
    "upper": (slice(None, 128), slice(None)),
    "lower": (slice(128, None), slice(None)),
}
PATTERNS = ("default", *HALVES)


def pattern(name: str) -> Array:
    """The pattern by its name, (256, 256, 3) relative radiance; a half of it white, or the
    default. Raises `KeyError`."""
    if name == "default":
        return default_pattern()
    image = np.zeros((256, 256, 3), np.float32)
    image[HALVES[name]] = 1
    return image


@cache
def pattern_png(name: str) -> bytes:
    """As a device must show it: a PNG, mirrored."""
    out = io.BytesIO()
    encoded(pattern(name), PAGE_PIXELS).save(out, "PNG")
    return out.getvalue()
