"""The patterns that a capture's photos are taken under, one after another."""

from __future__ import annotations

import io
from functools import cache

from invrender.pattern.display import PAGE_PIXELS, encoded
from invrender.pattern.sets import pattern_set
from invrender.types import Array

# What the page calls the patterns of the set of five, in its order.
PATTERN_NAMES = ("default", "turned", "stripes", "left", "upper")


def pattern(name: str) -> Array:
    """The pattern by its name, (256, 256, 3) relative radiance. Raises `KeyError`."""
    return dict(zip(PATTERN_NAMES, pattern_set(len(PATTERN_NAMES)), strict=True))[name]


@cache
def pattern_png(name: str) -> bytes:
    """As a device must show it: a PNG, mirrored."""
    out = io.BytesIO()
    encoded(pattern(name), PAGE_PIXELS).save(out, "PNG")
    return out.getvalue()
