"""Arguments that several subcommands read in the same way."""

from __future__ import annotations

import argparse
import math
from pathlib import Path


def ball(text: str) -> tuple[float, float, float]:
    """``X,Y,R``: the ball's centre and radius in photo pixels."""
    try:
        x, y, r = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError("expected three numbers: X,Y,R") from None
    return x, y, r


def gain(text: str) -> tuple[float, ...]:
    """One or three positive numbers."""
    try:
        values = tuple(float(v) for v in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (1, 3) or not all(0 < v < math.inf for v in values):
        raise argparse.ArgumentTypeError("expected one or three positive numbers: R,G,B")
    return values


def capture(text: str) -> Path:
    """A folder; 'example' is the bundled one."""
    from invrender.data import EXAMPLE

    return EXAMPLE if text == "example" else Path(text)
