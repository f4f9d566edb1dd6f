"""The capture sheet: paper with a window for the sample, markers around it and the ball's place.

All of it follows from the rig: `capture_sheet` says where everything lies on the table, in the
rig's coordinates, and `draw_sheet` makes a picture of it. `invrender.pattern.guide` prints it,
`invrender.capture.sheet` finds it in a photo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.rig import Rig
from invrender.types import Array, InputError

PAPER = 0.80  # reflectance of plain office paper
PAPER_DEVIATION = 0.05  # of that, from one paper to another
INK_REFLECTANCE = 0.05  # reflectance of a printer's black, about
# Of its logarithm: blacks on plain paper have optical densities of 1.15 to 1.45; by hand.
INK_DEVIATION = 0.25
# What A4 and Letter, or A3 and Ledger, have in common, metres: one sheet fits on either.
PAPERS = {"A4 or Letter": (0.2794, 0.210), "A3 or Ledger": (0.4191, 0.2794)}
UNPRINTED = 0.006  # metres along the paper's edges where printers may leave nothing

# Markers of 5 × 5 bits in a black border, of which any two differ in 5 bits or more.
DICTIONARY = "DICT_5X5_1000"
MODULES = 7  # black or white squares across a marker
FAMILY = 100  # numbers that a sheet takes of the dictionary's thousand
FAMILY_STEP = 1.1  # ratio of two samples' sizes whose sheets have other numbers
FAMILY_STRETCH = 1.02  # the same, of the rings' heights

MARKER = 0.15  # sides of the sample: a marker's
BORDER = 0.07  # the same, of plain paper between the window and the markers
PITCH = 1.4  # markers' sides from one to the next
BALL_CLEAR = 4.0  # radii of the ball around it that stay plain
PATCH = 0.6  # markers' sides: a square of plain paper that is measured


@dataclass(frozen=True)
class Sheet:
    """Where all of a sheet lies on the table (z = 0), metres in the rig's coordinates.

    ids: (n,) the markers' numbers; corners: (n, 4, 2) each one's upper left, upper right, lower
    right and lower left as printed; white: (k, 2) the middles of squares of plain paper,
    ``white_side`` wide, that neither window nor ball touches; page: the paper's least x, least y,
    greatest x and greatest y; paper: the sizes of paper that hold it; window: the side of the
    square hole for the sample, around the origin; ball: the place (x, y) and radius of the ball.
    """

    ids: NDArray[np.int_]
    corners: Array
    white: Array
    white_side: float
    page: tuple[float, float, float, float]
    paper: str
    window: float
    ball: tuple[float, float, float]


def capture_sheet(rig: Rig) -> Sheet:
    """The capture sheet for a rig's sample, ball and camera; screens do not matter.

    A ring of markers stands around window and ball, as far to the ball's side as the camera sees,
    where the paper is wide enough. Raises `InputError` for a rig that no paper is large enough for.

        sheet = capture_sheet(Rig())
        print(sheet.paper, len(sheet.ids))
    """
    side, axis, ball = rig.sample_size, rig.optical_axis_x, rig.ball_radius
    marker = MARKER * side
    pitch = PITCH * marker
    near = side / 2 + BORDER * side + marker / 2  # middles of the markers beside the window
    far = max(near, axis + BALL_CLEAR * ball + marker / 2)  # of the last column, at least
    high = max(near, BALL_CLEAR * ball + marker / 2)
    paper, size, columns = _paper(near, far, high, marker, pitch, 2 * axis + near)
    x = np.linspace(-near, -near + pitch * (columns - 1), columns)
    rows = math.ceil(2 * high / pitch) + 1
    y = np.linspace(high, -high, rows)
    places = np.array([
        (u, v) for v in y for u in x
        if _clear(u, v, marker / 2, rig) and (v in (y[0], y[-1]) or u in (x[0], x[-1]))
    ])  # fmt: skip
    half = marker / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    middle = (x[0] + x[-1]) / 2
    # Rather the view of the camera than the sheet's middle: the table beside paper is darker.
    room = max(0.0, (size[0] - (x[-1] - x[0]) - marker) / 2 - UNPRINTED)
    middle += min(max(axis - middle, -room), room)
    left = float(middle - size[0] / 2)
    page = (left, -size[1] / 2, left + size[0], size[1] / 2)
    first = _family(side, high / near) * FAMILY
    if len(places) > FAMILY:
        raise InputError("the capture sheet would need more markers than there are")
    corners = places[:, None] + half
    white = _white(corners, rig, page, PATCH * marker)
    return Sheet(
        first + np.arange(len(places)), corners, white, PATCH * marker, page, paper, side,
        (axis, 0.0, ball),
    )  # fmt: skip


def _paper(
    near: float, far: float, high: float, marker: float, pitch: float, seen: float
) -> tuple[str, tuple[float, float], int]:
    """The smallest paper, its width along x and along y, and the columns of markers on it."""
    least = math.ceil((near + far) / pitch) + 1
    most = max(least, math.floor((near + seen - marker) / pitch) + 1)
    for name, (long, short) in PAPERS.items():
        for wide, deep in ((long, short), (short, long)):
            across = wide - 2 * UNPRINTED - marker
            columns = min(most, math.floor(across / pitch) + 1)
            if columns >= least and 2 * high + marker <= deep - 2 * UNPRINTED:
                return name, (wide, deep), columns
    raise InputError(
        f"the capture sheet of this rig, {near + far + marker:.3g} × {2 * high + marker:.3g} m at "
        f"least, fits on none of {', '.join(PAPERS)}"
    )


def _clear(u: float, v: float, half: float, rig: Rig) -> bool:
    """Whether a square around (u, v) leaves the window's border and the ball's surroundings
    plain."""
    window = rig.sample_size / 2 + BORDER * rig.sample_size * (1 - 1e-9)
    if max(abs(u), abs(v)) < window + half:
        return False
    away = max(abs(u - rig.optical_axis_x) - half, 0), max(abs(v) - half, 0)
    return math.hypot(*away) >= BALL_CLEAR * rig.ball_radius * (1 - 1e-9)


def _white(corners: Array, rig: Rig, page: tuple[float, ...], side: float) -> Array:
    """Middles (k, 2) of squares of plain paper, a side apart, inside the markers' outline."""
    half = side / 2
    low, high = corners.min((0, 1)), corners.max((0, 1))
    count = np.floor((high - low) / side).astype(int)
    x, y = ((np.arange(n) + 0.5) * side - n * side / 2 for n in count)
    middle = (low + high) / 2
    grid = np.stack(np.meshgrid(x + middle[0], y + middle[1]), -1).reshape(-1, 2)
    apart = np.abs(grid[:, None] - corners.mean(1)).max(-1)
    free = apart.min(1) >= half + (corners[0, 1, 0] - corners[0, 0, 0]) / 2
    free &= np.abs(grid).max(-1) >= rig.sample_size / 2 + half
    ball = np.linalg.norm(grid - [rig.optical_axis_x, 0], axis=-1)
    free &= ball >= BALL_CLEAR * rig.ball_radius + half * math.sqrt(2)
    return grid[free]


def _family(side: float, stretch: float) -> int:
    """Which of the dictionary's ten families of markers a sheet has, by its sample's side and by
    how much higher its ring is than the window needs: one sheet is not taken for another's
    enlargement, if they differ by `FAMILY_STEP` or more, or for one seen aslant."""
    steps = math.floor(math.log(side) / math.log(FAMILY_STEP))
    return (steps + 3 * math.ceil(math.log(stretch) / math.log(FAMILY_STRETCH))) % 10


def marker_dictionary() -> Any:
    """OpenCV's dictionary of the markers."""
    from cv2 import aruco

    return aruco.getPredefinedDictionary(getattr(aruco, DICTIONARY))


def marker_bits(ids: NDArray[np.int_]) -> NDArray[np.int_]:
    """Black (0) and white (1) squares of markers, (n, 7, 7), row 0 on top."""
    from cv2 import aruco

    dictionary = marker_dictionary()
    bits = [aruco.generateImageMarker(dictionary, int(i), MODULES) for i in ids]
    return np.asarray(bits, int) // 255


def draw_sheet(sheet: Sheet, resolution: float, ink: float = INK_REFLECTANCE) -> Array:
    """The sheet's reflectance (H, W), float32, ``resolution`` pixels a metre, row 0 at +y;
    ink: that of what is printed.

    It covers ``sheet.page``, each pixel the mean over its square; the window is plain paper.

        picture = draw_sheet(capture_sheet(Rig()), 4000)
    """
    x0, y0, x1, y1 = sheet.page
    height, width = round((y1 - y0) * resolution), round((x1 - x0) * resolution)
    columns, rows = np.linspace(x0, x1, width + 1), np.linspace(y1, y0, height + 1)
    image = np.full((height, width), PAPER, np.float32)
    for bits, square in zip(marker_bits(sheet.ids), sheet.corners, strict=True):
        (left, top), (right, bottom) = square[0], square[2]
        v0, v1 = np.searchsorted(-rows, [-top, -bottom])
        u0, u1 = np.searchsorted(columns, [left, right])
        v0, u0 = max(v0 - 1, 0), max(u0 - 1, 0)
        down = _shares(-rows[v0 : v1 + 1], np.linspace(-top, -bottom, MODULES + 1))
        across = _shares(columns[u0 : u1 + 1], np.linspace(left, right, MODULES + 1))
        black = down @ (1 - bits) @ across.T
        image[v0 : v0 + len(black), u0 : u0 + black.shape[1]] -= (PAPER - ink) * black
    return image


def _shares(pixels: Array, squares: Array) -> Array:
    """Which share of each pixel (n) lies in each square (m), from their edges (n + 1), (m + 1)."""
    low = np.maximum(pixels[:-1, None], squares[None, :-1])
    high = np.minimum(pixels[1:, None], squares[None, 1:])
    return np.maximum(high - low, 0) / np.diff(pixels)[:, None]
