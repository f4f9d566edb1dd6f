"""The capture sheet: its geometry, and its picture as OpenCV reads it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from invrender.capture.sheet_layout import (
    BALL_CLEAR,
    INK_REFLECTANCE,
    PAPER,
    PAPERS,
    UNPRINTED,
    capture_sheet,
    draw_sheet,
    marker_dictionary,
)
from invrender.rig import Rig
from invrender.types import InputError

RIGS = [
    Rig(),
    Rig(screen_size=0.1),
    Rig(screen_size=0.24, screen_height=0.2),
    Rig(screen_size=0.3, screen_height=0.3, ball_radius=0.015),
    Rig(ball_radius=0.004),
]


@pytest.mark.parametrize("rig", RIGS)
def test_nothing_on_the_sheet_overlaps(rig):
    sheet = capture_sheet(rig)
    assert len(set(sheet.ids)) == len(sheet.ids) >= 16 and len(sheet.white) >= 12
    half = np.ptp(sheet.corners[:, :, 0], axis=1)[0] / 2
    middles = sheet.corners.mean(1)
    apart = np.abs(middles[:, None] - middles).max(-1) + np.eye(len(middles))
    assert apart.min() > 2.3 * half  # white around each, as the detection needs
    everything = [(m, half) for m in middles] + [(w, sheet.white_side / 2) for w in sheet.white]
    x0, y0, x1, y1 = sheet.page
    for middle, h in everything:
        assert np.abs(middle).max() > sheet.window / 2 + h - 1e-9
        outside = np.hypot(*np.maximum(np.abs(middle - sheet.ball[:2]) - h, 0))
        assert outside >= BALL_CLEAR * rig.ball_radius * (1 - 1e-6)
        assert x0 + UNPRINTED - 1e-9 <= middle[0] - h and middle[0] + h <= x1 - UNPRINTED + 1e-9
        assert y0 + UNPRINTED - 1e-9 <= middle[1] - h and middle[1] + h <= y1 - UNPRINTED + 1e-9
    for white in sheet.white:
        assert np.abs(white - middles).max(-1).min() >= half + sheet.white_side / 2 - 1e-9
    assert sorted((x1 - x0, y1 - y0)) == pytest.approx(sorted(PAPERS[sheet.paper]))


def test_the_picture_has_the_markers_where_the_geometry_says():
    sheet = capture_sheet(Rig())
    resolution = 5000
    image = draw_sheet(sheet, resolution)
    assert image.min() == pytest.approx(INK_REFLECTANCE, abs=1e-6) and image.max() == np.float32(
        PAPER
    )
    detector = cv2.aruco.ArucoDetector(marker_dictionary())
    corners, ids, _ = detector.detectMarkers((image * 255).astype(np.uint8))
    assert sorted(ids.ravel()) == sorted(sheet.ids)
    where = dict(zip(sheet.ids, sheet.corners, strict=True))
    for number, found in zip(ids.ravel(), corners, strict=True):
        pixels = found[0] + 0.5  # OpenCV counts from a pixel's middle
        at = [sheet.page[0], sheet.page[3]] + pixels / resolution * [1, -1]
        assert np.abs(at - where[number]).max() < 1.5 / resolution  # the corners of whole pixels
        assert np.abs((at - where[number]).mean(0)).max() < 0.75 / resolution


def test_the_picture_keeps_its_ink_at_any_resolution():
    sheet = capture_sheet(Rig())
    ink = [PAPER - draw_sheet(sheet, r).mean(dtype=float) for r in (5000, 1234.5, 700)]
    assert ink[1:] == pytest.approx([ink[0], ink[0]], rel=1e-5)


def test_sheets_of_different_rigs_are_told_apart_and_scale_with_the_rig():
    families = {int(capture_sheet(replace(Rig(), screen_size=s)).ids[0]) for s in (0.15, 0.18, 0.2)}
    assert len(families) == 3
    sheet = capture_sheet(Rig())
    assert capture_sheet(replace(Rig(), screen_height=0.3, fov=50)).ids[0] == sheet.ids[0]
    with pytest.raises(InputError, match="fits on none of A4 or Letter"):
        capture_sheet(Rig(screen_size=180, screen_height=153, camera_offset=17, ball_radius=9.5))
