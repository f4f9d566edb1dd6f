"""The benchmark of several photos: what it draws and what it reports."""

import numpy as np
import pytest

from benchmarks.several import FOUND, KINDS, RATIOS, bars, error_table, hand_held
from invrender.data.simulate_setup import hides
from invrender.rig import Rig


def test_hands_differ_and_leave_the_camera_its_view():
    rigs = [hand_held(np.random.default_rng(k)) for k in range(3)]
    assert len({r.camera_shift for r in rigs}) == 3 and not any(map(hides, rigs))
    assert hand_held(np.random.default_rng(0)) == rigs[0] != Rig()


def test_errors_are_pooled_over_samples_and_compared_with_one_photo():
    def row(error):
        return dict.fromkeys(KINDS, error)

    results = {FOUND: {1: [row(0.3), row(0.4)], 5: [row(0.06), row(0.08)]}}
    lines = error_table(results)["rows"]
    assert lines[0][:2] == [FOUND, 1] and lines[0][2:] == pytest.approx([1] * len(KINDS))
    assert lines[1][2:] == pytest.approx([0.2] * len(KINDS))
    reached = {b["name"]: b for b in bars(results, 0.9)}
    assert all(reached[f"{kind}, set over one photo"]["ok"] for kind in RATIOS)
    assert not reached["patterns recognised"]["ok"]
