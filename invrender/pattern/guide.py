"""The capture guide: the rig drawn to scale on A4, and the capture sheet in its real size."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from invrender.capture.sheet_layout import Sheet, capture_sheet, marker_bits
from invrender.files.write import atomic_path
from invrender.rig import Rig
from invrender.types import InputError

MM = 1 / 25.4  # inches
PAGE = (210.0, 297.0)  # A4, mm
PAGE_MARGIN = 15.0
SCALES = (1, 2, 2.5, 5, 10, 20, 50, 100)
INK, SOFT, SCREEN, BALL = "#1c1d20", "#74767c", "#2f6fb0", "#b04a2f"
DIAGONAL = math.hypot(36, 24)  # mm, of the 35 mm frame
LINES = (100, 50, 20, 10, 5)  # mm, to check the printer's scale by
DOTS = 20  # image pixels in a marker's module, so that no viewer blurs it


def write_guide(path: Path, rig: Rig) -> None:
    """Write the guide of a ``rig`` as a PDF: its drawing's scale is printed on it, and the capture
    sheet is as large as paper of A4 and Letter, or of A3 and Ledger, have in common."""
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure

    with atomic_path(path) as temporary, PdfPages(temporary) as pdf:
        figure = Figure(figsize=(PAGE[0] * MM, PAGE[1] * MM))
        _guide(figure, rig)
        pdf.savefig(figure)
        try:
            sheet = capture_sheet(rig)
        except InputError as error:
            figure = Figure(figsize=(PAGE[0] * MM, PAGE[1] * MM))
            page = _axes(figure, 0, 0, 1)
            page.text(PAGE_MARGIN, -20, "No capture sheet", size=17, weight="bold", color=INK)
            page.text(PAGE_MARGIN, -30, f"{error}.\nMeasure from page 1.", size=8, color=INK)
        else:
            x0, y0, x1, y1 = sheet.page
            figure = Figure(figsize=(1000 * (x1 - x0) * MM, 1000 * (y1 - y0) * MM))
            _sheet(figure, sheet)
        pdf.savefig(figure)
        pdf.infodict()["Title"] = "invrender: capture guide"


def needed_focal(rig: Rig) -> float:
    """Longest lens, as its 35 mm equivalent, whose 4:3 photo shows the whole sample.

    In millimetres, by CIPA DCG-001 (diagonals); 5% of the photo's half width are kept free.
    """
    tangent = (rig.optical_axis_x + rig.sample_size / 2) / _lens_height(rig)
    return DIAGONAL / 2 * 0.8 / tangent * 0.95


def _lens_height(rig: Rig) -> float:
    return rig.screen_height if rig.camera_height is None else rig.camera_height


def _axes(figure: Any, x: float, y: float, scale: float) -> Any:
    """Axes over the page in millimetres of the rig, (0, 0) at (x, y) of the page from above."""
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.patch.set_alpha(0)
    axes.set_xlim(-x * scale, (PAGE[0] - x) * scale)
    axes.set_ylim(-(PAGE[1] - y) * scale, y * scale)
    return axes


def _guide(figure: Any, rig: Rig) -> None:
    w, d = (1000 * side for side in rig.screen_sides)
    h, lens, r = 1000 * rig.screen_height, 1000 * _lens_height(rig), 1000 * rig.ball_radius
    a, delta, axis = 500 * rig.sample_size, 1000 * rig.camera_offset, 1000 * rig.optical_axis_x
    edge, top = a - delta, max(h, lens)
    left, right = edge - w, axis + r + 22 * d / 90
    wide, high = right - left + 40, 1.25 * top + d * 1.15
    scale = next(
        (s for s in SCALES if wide / s < PAGE[0] - 2 * PAGE_MARGIN and high / s < 205), SCALES[-1]
    )
    page = _axes(figure, 0, 0, 1)
    x0 = PAGE_MARGIN + (-left + 20) / scale
    text = page.text
    text(PAGE_MARGIN, -20, "Capture guide", size=17, weight="bold", color=INK)
    text(PAGE_MARGIN, -26, f"Drawn at 1 : {scale:g}, lengths in millimetres.", size=9, color=SOFT)

    # From the side.
    y0 = 38 + top * 1.12 / scale
    side = _axes(figure, x0, y0, scale)
    side.text(left, top * 1.12, "From the side", size=10, weight="bold", color=INK)
    side.plot([left - 8, right + 8], [0, 0], color=INK, lw=1)
    side.plot([-a, a], [0, 0], color=INK, lw=4, solid_capstyle="butt")
    side.text(0, 3 * scale, "sample", ha="center", size=8, color=INK)
    side.plot([left, edge], [h, h], color=SCREEN, lw=4, solid_capstyle="butt")
    side.text(left, h + 2.5 * scale, "pattern, facing down", size=8, color=SCREEN)  # fmt: skip
    angle = np.linspace(0, math.pi, 60)
    side.fill(axis + r * np.cos(angle), r * np.sin(angle), color=BALL)
    side.text(axis + r + 1.5 * scale, 2 * scale, f"mirror ball\nradius {r:.1f}", size=8,
              color=BALL)  # fmt: skip
    side.plot([axis, axis], [r, lens], color=SOFT, lw=0.7, ls=(0, (5, 4)))
    side.plot([axis], [lens], marker="o", ms=5, color=INK)
    side.text(axis + 2 * scale, lens + 2.5 * scale, "lens, looking straight down", size=8,
              ha="center", color=INK)  # fmt: skip
    for x in (-a, a):  # the ways on which the sample's edges mirror the screen into the lens
        side.plot([x - (axis - x) * h / lens, x, axis], [h, 0, lens], color=SOFT, lw=0.5)
    _length(side, (right, 0), (right, h), f"{h:.0f}", scale)
    if lens != h:
        _length(side, (axis + 4 * scale, 0), (axis + 4 * scale, lens), f"{lens:.0f}", scale)
    _length(side, (edge, h * 0.9), (axis, h * 0.9), f"{2 * delta:.0f}", scale)

    # From above, in the photo's orientation.
    y1 = y0 + 14 + (d / 2 * 1.12) / scale
    above = _axes(figure, x0, y1, scale)
    above.text(left, d / 2 + 3 * scale, "From above, as the photo shows it", size=10,
               weight="bold", color=INK)  # fmt: skip
    _rectangle(above, left, -d / 2, w, d, SCREEN, ls="--", lw=1)
    above.text(left + 2 * scale, -d / 2 + 2 * scale, "pattern (above)", size=8, color=SCREEN)
    _rectangle(above, -a, -a, 2 * a, 2 * a, INK, lw=1.4)
    above.text(0, 0, "sample", ha="center", va="center", size=8, color=INK)
    turn = np.linspace(0, 2 * math.pi, 90)
    above.fill(axis + r * np.cos(turn), r * np.sin(turn), color=BALL)
    above.text(axis, r + 2 * scale, "ball, below the lens", ha="center", size=8, color=BALL)
    _length(above, (left, -d / 2 - 5 * scale), (edge, -d / 2 - 5 * scale), f"{w:.0f}", scale)
    if w != d:
        _length(above, (left - 11 * scale, -d / 2), (left - 11 * scale, d / 2), f"{d:.0f}", scale)
    _length(above, (-a, -a - 5 * scale), (a, -a - 5 * scale), f"{2 * a:.0f}", scale)
    _length(above, (0, -a / 2), (axis, -a / 2), f"{axis:.0f}", scale)
    above.annotate("photo's top", (right, d / 2), (right, d / 4), ha="center", size=8, color=SOFT,
                   arrowprops={"arrowstyle": "->", "color": SOFT})  # fmt: skip

    y = -(y1 + d / 2 / scale + 16)
    fov, focal = rig.fov, needed_focal(rig)
    for i, line in enumerate((
        "Page 2 is the capture sheet: its markers tell where the camera was, its white paper how "
        "bright the light is.",
        "Lay it on the sample, its square cut out, or the sample on it. The ball stands on its "
        "cross.",
        "Show the pattern at its real size and full brightness; switch off automatic brightness, "
        "night light and tone adaptation.",
        f"Hold the display {h:.0f} mm above the table, face down and level, its top edge where the "
        "photo's top is.",
        f"The lens is beside the pattern, {2 * delta:.0f} mm from its edge, "
        + ("at the same height" if lens == h else f"{lens:.0f} mm above the table")
        + ", straight above the ball.",
        f"Lens of {focal:.0f} mm or less (35 mm equivalent; rig.toml says {fov:.0f}° across); "
        "no zoom, no portrait mode, no filters, no flash.",
        "Focus on the sample and lock it. Expose so that neither the sample nor the pattern in the "
        "ball is white. Raw is best.",
        "The photo shows the whole sample, and the ball in its middle. Keep hands and head out of "
        "the ball's view.",
        "invrender inspect FOLDER tells whether it was a good one.",
    )):  # fmt: skip
        text(PAGE_MARGIN, y - 5.1 * i, f"{i + 1}.", size=8.5, color=SOFT)
        text(PAGE_MARGIN + 6, y - 5.1 * i, line, size=8.2, color=INK)


def _sheet(figure: Any, sheet: Sheet) -> None:
    """The sheet's markers, window and ball in real size; what is to be read stands in the window,
    which is cut out or covered."""
    x0, y0, x1, y1 = (1000 * v for v in sheet.page)
    page = figure.add_axes((0, 0, 1, 1))
    page.set_axis_off()
    for bits, square in zip(marker_bits(sheet.ids), 1000 * sheet.corners, strict=True):
        (left, top), (right, bottom) = square[0], square[2]
        image = np.kron(bits, np.ones((DOTS, DOTS)))
        page.imshow(image, cmap="gray", vmin=0, vmax=1, extent=(left, right, bottom, top),
                    interpolation="none", aspect="auto")  # fmt: skip
    half = 500 * sheet.window
    _rectangle(page, -half, -half, 2 * half, 2 * half, SOFT, lw=0.4)
    size = min(9.0, half / 5.5)  # points: all lines fit into the window
    mm = f"{2 * half:.4g}"
    lines = (
        "Capture sheet",
        f"Print at 100% on {sheet.paper}.",
        f"Cut out this square ({mm} × {mm} mm) and lay the sheet on the",
        "sample; or lay a sample of its size on it.",
        "The ball stands on the cross, the lens is above it.",
        "Leave the markers and the white paper uncovered.",
        "← display                                  lens and ball →",
    )
    for i, line in enumerate(lines):
        page.text(0, half * (0.75 - 0.2 * i), line, ha="center", va="center", size=size, color=INK,
                  weight="bold" if i == 0 else "normal")  # fmt: skip
    length = next((n for n in LINES if n < 1.8 * half), LINES[-1])
    _length(page, (-length / 2, -0.75 * half), (length / 2, -0.75 * half), f"{length} mm", 1)
    x, y, r = (1000 * v for v in sheet.ball)
    turn = np.linspace(0, 2 * math.pi, 90)
    page.plot(x + 0.9 * r * np.cos(turn), y + 0.9 * r * np.sin(turn), color=SOFT, lw=0.4)
    page.plot([x - 0.3 * r, x + 0.3 * r], [y, y], color=SOFT, lw=0.4)
    page.plot([x, x], [y - 0.3 * r, y + 0.3 * r], color=SOFT, lw=0.4)
    page.set_xlim(x0, x1)
    page.set_ylim(y0, y1)


def _rectangle(
    axes: Any, x: float, y: float, w: float, h: float, colour: str, **style: Any
) -> None:
    axes.plot([x, x + w, x + w, x, x], [y, y, y + h, y + h, y], color=colour, **style)


def _length(
    axes: Any, a: tuple[float, float], b: tuple[float, float], text: str, scale: float
) -> None:
    """A dimension line from a to b, its number beside its middle."""
    axes.annotate("", b, a, arrowprops={"arrowstyle": "<->", "color": SOFT, "lw": 0.7,
                                        "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    upright = a[0] == b[0]
    x, y = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2
    axes.text(x + (1.2 * scale if upright else 0), y + (0 if upright else 0.8 * scale), text,
              ha="left" if upright else "center", va="center" if upright else "bottom", size=8,
              color=SOFT)  # fmt: skip
