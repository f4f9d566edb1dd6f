"""Seconds as medians, and ratios of pairs that take turns."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any


def seconds(f: Callable[[], Any]) -> float:
    """How long one call takes."""
    start = time.perf_counter()
    f()
    return time.perf_counter() - start


def timed(f: Callable[[], Any], repeats: int = 3) -> tuple[float, float]:
    """(first call's seconds, median seconds of the calls after it)."""
    cold = seconds(f)
    return cold, statistics.median(seconds(f) for _ in range(repeats))


def paired(
    f: Callable[[], Any], baseline: Callable[[], Any], rounds: int
) -> tuple[float, float, float]:
    """(median seconds of f, of the baseline, median of the rounds' ratios f over baseline).

    They take turns, so that other work on the machine slows both alike; each is called once before.
    """
    f()
    baseline()
    pairs = [(seconds(f), seconds(baseline)) for _ in range(rounds)]
    a, b = zip(*pairs, strict=True)
    return statistics.median(a), statistics.median(b), statistics.median(x / y for x, y in pairs)
