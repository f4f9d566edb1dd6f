"""Robust statistics that several steps of the capture share."""

from __future__ import annotations

from typing import Any

import numpy as np

from invrender.capture.settings import GAUSSIAN_SPREAD
from invrender.types import Array


def spread(errors: Array, axis: int | None = None) -> Any:
    """Standard deviation of errors about nought, by their median absolute value."""
    return GAUSSIAN_SPREAD * np.median(np.abs(errors), axis).astype(float)


def cauchy_residuals(errors: Array) -> Array:
    """Residuals whose squares are Cauchy's loss, log(1 + z²), of ``errors`` z; the sign stays.

    For solvers of plain least squares.
    """
    return np.asarray(np.sign(errors) * np.sqrt(np.log1p(errors * errors)))
