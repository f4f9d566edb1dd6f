"""What the benchmark of real set-ups counts."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import device
from benchmarks.common.captures import OTHERS, PHOTOGRAPHS
from invrender.lights import Device, Lights
from invrender.report.advice import screen_light
from invrender.rig import Rig

ROWS = [
    {"capture": "000", "kind": "raw", "sheet": False, "error": 0.05, "ideal": 0.05, "notices": [],
     "true lights": 0.06},
    {"capture": "001", "kind": "raw", "sheet": True, "error": 0.15, "ideal": 0.05,
     "notices": ["ball-reflectance-measured"]},
    {"capture": "002", "kind": "jpeg", "sheet": True, "error": 0.15, "ideal": 0.05,
     "notices": ["screen-saturated"]},
    {"capture": "003", "kind": "jpeg", "sheet": False, "refused": "no ball", "ideal": 0.05},
]  # fmt: skip


def test_bars_count_what_was_read_and_what_nobody_warned_of():
    """Of two raw captures both were read, at 1 and 3 times the ideal error; that a reflectance was
    measured is no warning. Of two JPEGs one was refused, the other spoilt but warned of."""
    bars = {b["name"]: b["value"] for b in device.bars(ROWS, [{"tilt": 0.2}, {"tilt": 1.5}])}
    assert bars["raw: read"] == 1 and bars["jpeg: read"] == 0.5
    assert bars["raw: error over the ideal device's, median"] == pytest.approx(2)
    assert bars["raw: the same with sheet"] == pytest.approx(3)
    assert bars["raw: twice the error unwarned"] == 0.5
    assert bars["jpeg: twice the error unwarned"] == 0
    assert bars["tilts believed of 2 straight cameras"] == 1
    assert device.refused_table(ROWS)["rows"] == [["003", "jpeg", "no ball"]]
    rows = {row[0]: row[1:] for row in device.captures_table(ROWS)["rows"]}
    assert rows["raw"] == pytest.approx([1, 1, 0.05, 0.05, 1, 1.2])
    assert rows["jpeg"] == [1, 0, None, 0.05, None, None]


def test_its_captures_are_its_own():
    seeds = [s.first_seed for s in (device.FINAL, device.DEVELOPMENT, PHOTOGRAPHS, OTHERS)]
    assert np.diff(sorted(seeds)).min() >= 10_000
    assert device.FINAL.split != device.DEVELOPMENT.split


def test_tilt_is_that_of_the_axis():
    assert Rig(camera_tilt=(0.0, 0.0, 30.0)).off_nadir == pytest.approx(0, abs=1e-6)
    assert Rig(camera_tilt=(0.6, -0.8, 0.0)).off_nadir == pytest.approx(1)


def test_an_ignored_display_is_believed_to_be_as_bright():
    """A display that dims is less bright at the sample than its white straight ahead."""
    ideal = Lights(Rig(), np.full((64, 64, 3), 0.5, np.float32), gain=2.0)
    ratio = screen_light(replace(ideal, device=Device(falloff=1.0))) / screen_light(ideal)
    assert 0.7 < ratio < 0.95
    assert screen_light(replace(ideal, gain=4.0)) == pytest.approx(2 * screen_light(ideal))


def test_cameras_leave_grey_what_is_grey():
    photo = np.linspace(0.1, 1.0, 64 * 64 * 1).reshape(64, 64, 1) * np.ones(3)
    for name, image in device.photo_effects(photo.astype(np.float32), Rig()).items():
        assert np.ptp(image, axis=-1).max() < 2e-3 * photo.max(), name
        assert np.abs(image / photo - 1).max() > 0.03 or "P3" in name, name
