"""Arguments that several subcommands read in the same way."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

T = TypeVar("T", int, float)
DIMMEST, LIGHTEST = 1e-9, 1e9  # of radiances: squares stay within single precision
GREATEST_SEED = 2**31 - 1  # the greatest that Mitsuba takes
GREATEST_SIDE = 8192  # pixels, of a simulated photo and its maps
GREATEST_SAMPLES = 65_536  # of one pixel, at most: half a minute of a photo at 256²


def ball(text: str) -> tuple[float, float, float]:
    """``X,Y,R``: the ball's centre and radius in photo pixels."""
    try:
        x, y, r = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError("expected three numbers: X,Y,R") from None
    return x, y, r


def gain(text: str) -> tuple[float, ...]:
    """One or three radiances."""
    try:
        values = tuple(float(v) for v in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (1, 3) or not all(DIMMEST <= v <= LIGHTEST for v in values):
        limits = f"from {DIMMEST:g} to {LIGHTEST:g}"
        raise argparse.ArgumentTypeError(f"expected one or three numbers {limits}: R,G,B")
    return values


def whole(least: int, most: int) -> Callable[[str], int]:
    """Reads a whole number between the two."""
    return _between(int, "a whole number", least, most)


def number(least: float, most: float) -> Callable[[str], float]:
    """Reads a number between the two."""
    return _between(float, "a number", least, most)


def _between(kind: type[T], name: str, least: float, most: float) -> Callable[[str], T]:
    def read(text: str) -> T:
        with suppress(ValueError):
            value = kind(text)
            if least <= value <= most:
                return value
        raise argparse.ArgumentTypeError(f"expected {name} from {least:.10g} to {most:.10g}")

    return read


def capture(text: str) -> Path:
    """A folder; 'example' is the bundled one."""
    from invrender.data import EXAMPLE

    return EXAMPLE if text == "example" else Path(text)
