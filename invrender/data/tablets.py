"""Common tablets and their displays, by name."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import NamedTuple

from invrender.files.write import INCH
from invrender.rig import Rig
from invrender.types import InputError


class Tablet(NamedTuple):
    """A display: its long and short side in pixels, and pixels an inch, as its maker states."""

    name: str
    long: int
    short: int
    ppi: float

    @property
    def sides(self) -> tuple[float, float]:
        """The display's long and short side in metres."""
        return self.long / self.ppi * INCH, self.short / self.ppi * INCH


# By the makers' data sheets.
TABLETS = (
    Tablet("iPad Pro 13″ (M4)", 2752, 2064, 264),
    Tablet("iPad Pro 12.9″, iPad Air 13″", 2732, 2048, 264),
    Tablet("iPad Pro 11″ (M4)", 2420, 1668, 264),
    Tablet("iPad Pro 11″ (2018–2022)", 2388, 1668, 264),
    Tablet("iPad Air 11″, iPad 10.9″", 2360, 1640, 264),
    Tablet("iPad 10.2″", 2160, 1620, 264),
    Tablet("iPad mini 8.3″", 2266, 1488, 326),
    Tablet("Galaxy Tab S8, S9 11″", 2560, 1600, 274),
    Tablet("Galaxy Tab S8+, S9+ 12.4″", 2800, 1752, 266),
    Tablet("Galaxy Tab S8, S9 Ultra 14.6″", 2960, 1848, 239),
    Tablet("Galaxy Tab A9+ 11″", 1920, 1200, 206),
    Tablet("Pixel Tablet 11″", 2560, 1600, 276),
    Tablet("Xiaomi Pad 6 11″", 2880, 1800, 309),
    Tablet("OnePlus Pad 11.6″", 2800, 2000, 296),
    Tablet("Surface Pro 8, 9 13″", 2880, 1920, 267),
    Tablet("Surface Go 10.5″", 1920, 1280, 220),
    Tablet("Fire HD 10 10.1″", 1920, 1200, 224),
)


def find_tablet(name: str) -> tuple[Tablet, list[Tablet]]:
    """The tablet of that name, and the other ones that all words of it fit: "iPad Pro 11" is the
    newest of two. Raises `InputError` for an unknown one."""
    words = _words(name)
    fit = [t for t in TABLETS if words and words <= _words(t.name)]
    if not fit:
        known = "; ".join(t.name for t in TABLETS)
        raise InputError(f"no display is known as {name!r}; known are: {known}")
    return fit[0], fit[1:]


def tablet_rig(tablet: Tablet) -> Rig:
    """The default rig, as high as a square of the tablet's short side needs, with its whole display
    lit."""
    default, (long, short) = Rig(), tablet.sides
    scale = short / max(default.screen_sides)
    height = round(default.screen_height * scale, 3)
    return replace(default, screen_size=(round(long, 4), round(short, 4)), screen_height=height)


def _words(name: str) -> set[str]:
    """Its words in small letters, without inches: "11-inch", "11″" and "11" are one."""
    plain = re.sub(r"[-\s]*(inch(es)?|[\"″”])", " ", name.lower())
    return set(re.findall(r"[a-z0-9.+]+", plain))
