"""Error against run time: one plot for all benchmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

Curve = tuple[Sequence[float], Sequence[float]]  # seconds, errors
Panels = Mapping[str, Mapping[str, Curve]]


def plot_error_over_time(
    path: Path,
    panels: Panels,
    thin: Mapping[str, Mapping[str, Sequence[Curve]]] | None = None,
    *,
    x: str = "seconds",
    y: str = "RMS error",
    levels: Sequence[float] = (),
    columns: int = 3,
) -> None:
    """Save a plot with a panel for each of ``panels`` (title: method: curve), both axes in logs.

    The same method has the same colour in all panels, so that baselines of the same run stand
    beside each other. thin: by panel and method, curves of single captures, drawn thin in the
    method's colour. levels: errors to mark by horizontal lines. Noughts (a start at zero seconds)
    are drawn at half of the panel's least positive value.
    """
    methods = list(dict.fromkeys(m for panel in panels.values() for m in panel))
    colours = {m: f"C{i}" for i, m in enumerate(methods)}
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4.5 * columns, 3.8 * rows), squeeze=False)
    for axis in axes.ravel()[len(panels) :]:
        axis.set_visible(False)
    for axis, (title, panel) in zip(axes.ravel(), panels.items(), strict=False):
        singles = (thin or {}).get(title, {})
        curves = [*panel.values(), *(c for some in singles.values() for c in some)]
        least = [_least([v for c in curves for v in c[i]]) / 2 for i in (0, 1)]
        for method, some in singles.items():
            for curve in some:
                axis.loglog(*map(np.maximum, curve, least), colours[method], lw=0.4)
        for method, curve in panel.items():
            drawn = [np.maximum(v, low) for v, low in zip(curve, least, strict=True)]
            axis.loglog(*drawn, "o-", ms=3, lw=2 if singles else 1.2, c=colours[method],
                        label=method)  # fmt: skip
        for level in levels:
            axis.axhline(level, color="0.7", lw=0.8)
        axis.set(title=title, xlabel=x, ylabel=y)
        axis.grid(alpha=0.2)
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _least(values: list[float]) -> float:
    """The least positive value, 1 where there is none."""
    return min((v for v in values if v > 0), default=1.0)
