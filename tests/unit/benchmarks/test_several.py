"""The benchmark of several photos: what it draws and what it reports."""

import numpy as np
import pytest

from benchmarks.common.results import write_results
from benchmarks.several import FOUND, KINDS, RATIOS, bars, error_table, hand_held, kept
from invrender.data.simulate_setup import hides
from invrender.rig import Rig


def test_hands_differ_and_leave_the_camera_its_view():
    rigs = [hand_held(np.random.default_rng(k)) for k in range(3)]
    assert len({r.camera_shift for r in rigs}) == 3 and not any(map(hides, rigs))
    assert hand_held(np.random.default_rng(0)) == rigs[0] != Rig()


def row(sample, error):
    return {"sample": sample, **dict.fromkeys(KINDS, error)}


RESULTS = {
    FOUND: {
        1: [row("000", 0.3), row("001", 0.4)],
        2: [row("001", 0.2)],
        5: [row("000", 0.06), row("001", 0.08)],
    }
}


def test_errors_are_pooled_and_compared_with_one_photo_of_the_same_samples():
    lines = error_table(RESULTS)["rows"]
    assert [line[:3] for line in lines] == [[FOUND, 1, 2], [FOUND, 2, 1], [FOUND, 5, 2]]
    for line, ratio in zip(lines, (1, 0.5, 0.2), strict=True):
        assert line[3:] == pytest.approx([ratio] * len(KINDS))
    reached = {b["name"]: b for b in bars(RESULTS, 0.9)}
    assert all(reached[f"{kind}, set over one photo"]["ok"] for kind in RATIOS)
    assert not reached["patterns recognised"]["ok"]


def test_a_run_goes_on_with_the_rows_of_the_one_before(tmp_path):
    assert kept(tmp_path) == ({}, {})
    write_results(tmp_path, {"rows": RESULTS, "recognised": {"000": [True, False]}})
    assert kept(tmp_path) == (RESULTS, {"000": [True, False]})
