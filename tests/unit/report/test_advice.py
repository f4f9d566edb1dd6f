"""What inspect draws, and what it advises, of captures that are made up."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import ImageColor

from invrender.capture.lights import FoundLights
from invrender.capture.mirror import make_ball
from invrender.capture.sheet import FoundSheet
from invrender.capture.sheet_layout import capture_sheet
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.pattern.default import default_pattern
from invrender.report.advice import WANTED, advice
from invrender.report.inspection import COLOURS, INSET, annotate, deviations
from invrender.rig import Rig

RIG = Rig()
SIZE = (1500, 2000)


def sheet_of(rig, count):
    sheet = capture_sheet(rig)
    corners = rig.project(np.pad(sheet.corners, ((0, 0), (0, 0), (0, 1))), *SIZE)
    empty = np.zeros((0, 3))
    return FoundSheet(
        sheet.ids[:count], corners[:count], 0.02, 73.7, 0.3, (5e-4, 5e-4, 8e-4), (0.0, 0.0),
        (1e-3, 1e-3), 0.0, 1e-3, 0.1, empty, empty, empty > 0, np.zeros(0), np.zeros((0, 2)),
    )  # fmt: skip


def found(*, rig=RIG, level=0.3, size=SIZE, clip=1.0, coverage=0.8, markers=24, gain=2.0, **fit):
    photo = Photo(np.full((*size, 3), level, np.float32), clip)
    capture = Capture(photo, rig, default_pattern(16), fov_from="sheet")
    lights = Lights(
        rig, default_pattern(16), np.full((8, 16, 3), 0.02), np.full(3, gain),
        np.full((8, 16), coverage), fit=fit,
    )  # fmt: skip
    ball = make_ball(rig, rig.ball_centre, rig.ball_radius, size)
    return FoundLights(capture, lights, ball, (), sheet_of(rig, markers) if markers else None)


def codes(one):
    return [said.code for said in advice(one)]


def test_a_good_capture_needs_no_advice():
    assert codes(found()) == []


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"level": 0.02}, ["expose-longer", "take-raw"]),
        ({"level": 0.02, "clip": None}, []),  # nothing tells what such a file can hold
        ({"saturated": 0.2}, ["take-raw"]),
        ({"size": (450, 600)}, ["go-closer", "larger-ball"]),
        ({"gain": 0.05}, ["darken-room"]),
        ({"coverage": 0.3}, ["free-the-ball"]),
        ({"ball_reflectance_deviation": 0.06}, ["state-reflectance"]),
        ({"rig": replace(RIG, camera_tilt=(0, 7, 0))}, ["hold-level"]),
        ({"screen_tilt": 6.0}, ["level-display"]),
        ({"screen_shift": 0.03}, ["measure-display"]),
        ({"markers": 0}, ["use-sheet"]),
        ({"markers": WANTED.markers - 1}, ["show-markers"]),
    ],
)
def test_advice_names_what_can_be_bettered(change, expected):
    assert codes(found(**change)) == expected


def test_how_much_longer_is_said():
    (text, *_) = (said.text for said in advice(found(level=0.03)))
    assert "about 10 times longer" in text


def test_the_picture_shows_everything():
    dark = found()
    bright = dark.capture.photo.image.copy()
    bright[700:720, 700:720] = 1.0
    picture = np.asarray(annotate(replace(dark, capture=replace(
        dark.capture, photo=Photo(bright, 1.0)))))  # fmt: skip
    assert picture.shape == (750, 1000, 3)
    for name, colour in COLOURS.items():
        assert (picture == ImageColor.getrgb(colour)).all(-1).sum() > 20, name
    # The enlarged ball lies in the lower right corner, its outline whole.
    inset = picture[-round(INSET * 750) :, -round(INSET * 750) :]
    lime = np.argwhere((inset == ImageColor.getrgb("lime")).all(-1))
    assert np.ptp(lime, 0) == pytest.approx([INSET * 750 / 1.3] * 2, rel=0.05)


def test_deviations_say_where_they_come_from():
    assert deviations(found(gain_deviation=0.04)) == {
        "camera_tilt": 0.02, "camera_height": 8e-4, "fov": 0.3, "gain": 0.04,
        "ball_reflectance": None, "paper_gain": None,
    }  # fmt: skip
    without = found(markers=0)
    without = replace(without, capture=replace(without.capture, fov_from="unknown"))
    assert deviations(without)["fov"] is None and deviations(without)["camera_tilt"] is None
