"""The light pattern for a device: a page for its browser, or an image that knows its size."""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import jinja2
import numpy as np
from PIL import Image

from invrender.colour import linear_to_srgb
from invrender.data.tablets import TABLETS
from invrender.files.write import INCH, atomic_path
from invrender.pattern.default import mirrored
from invrender.sampling import resize_pattern
from invrender.types import Array, InputError

PAGE_PIXELS = 768  # a side of the page's image: the pattern has no finer detail
LARGEST_PNG = 8192  # pixels a side


def device_pixels(size: float, ppi: float) -> int:
    """Pixels a side of a pattern of ``size`` metres. Raises `InputError` for impossible ones."""
    if not 30 <= ppi <= 2000:
        raise InputError(f"a display has 30 to 2000 pixels an inch, not {ppi:g}")
    pixels = round(size / INCH * ppi)
    if not 1 <= pixels <= LARGEST_PNG:
        raise InputError(
            f"a pattern of {1000 * size:g} mm at {ppi:g} pixels an inch would be {pixels} pixels "
            f"wide; 1 to {LARGEST_PNG} are possible"
        )
    return pixels


Size = float | tuple[float, float]  # metres: of a square's side, or along x and y


def write_display_png(path: Path, pattern: Array, size: Size, ppi: float) -> None:
    """Write the pattern (h, w, 3) as a device must show it, mirrored, ``size`` metres large.

    The file states its resolution (pHYs). Raises `InputError` for impossible sizes.
    """
    wide, deep = _sides(size)
    image = encoded(pattern, device_pixels(deep, ppi), device_pixels(wide, ppi))
    with atomic_path(path) as temporary:
        image.save(temporary, format="PNG", dpi=(ppi, ppi))


def pattern_page(
    pattern: Array,
    size: Size,
    ppi: float | None = None,
    script: str = "",
    rest: Sequence[Array] = (),
) -> str:
    """An HTML page that shows the pattern (h, w, 3), mirrored, ``size`` metres large.

    It is one file and loads nothing: its content security policy allows the image inside it and
    its one script, by that script's hash. Without ``ppi``, the display's pixels an inch, its user
    names the tablet or finds the scale with a bank card. ``script``: the address of one more
    script, for a page that a server of its own keeps in step: it may ask that server, and nobody
    else. rest: more patterns of a set, which taps show one after another.
    """
    wide, deep = _sides(size)
    if ppi is not None:
        device_pixels(wide, ppi), device_pixels(deep, ppi)
    own = _data("page.js")
    digest = base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        _data("page.html.j2")
    )
    return page.render(
        css=_data("page.css"),
        script=own,
        more=script,
        script_hash=f"sha256-{digest}",
        uri=_uri(pattern),
        rest=[_uri(p) for p in rest],
        mm=1000 * wide,
        deep=1000 * deep,
        ppi=ppi,
        tablets=TABLETS,
    )


def _uri(pattern: Array) -> str:
    out = io.BytesIO()
    encoded(pattern, PAGE_PIXELS).save(out, "PNG")
    return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()


def _sides(size: Size) -> tuple[float, float]:
    return size if isinstance(size, tuple) else (size, size)


def encoded(pattern: Array, rows: int, columns: int | None = None) -> Image.Image:
    data = linear_to_srgb(mirrored(resize_pattern(pattern, rows, columns)))
    return Image.fromarray((data * 255 + 0.5).astype(np.uint8))


def _data(name: str) -> str:
    return (resources.files("invrender") / "pattern" / "page" / name).read_text(encoding="utf-8")
