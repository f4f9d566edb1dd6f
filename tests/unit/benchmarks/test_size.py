"""What the benchmark of sizes measures."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import size
from invrender.files.maps import write_maps
from invrender.maps import constant_maps, resize_maps


def test_a_process_has_its_own_time_and_memory(tmp_path):
    work = "import sys, pathlib; x = bytearray(300 << 20); pathlib.Path(sys.argv[1]).touch()"
    large = size.run(tmp_path, ("-c", work, "OUT"), tmp_path / "made")
    small = size.run(tmp_path, ("-c", "pass"), tmp_path)
    assert (tmp_path / "made").exists()
    assert large["GB"] - small["GB"] == pytest.approx(0.29, abs=0.05)
    assert small["processor seconds"] > 0 and small["seconds"] > 0
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        size.run(tmp_path, ("-c", "1/0"), tmp_path)


def test_the_checkout_that_is_named_runs(tmp_path):
    package = tmp_path / "invrender"
    package.mkdir()
    (package / "__init__.py").write_text("raise SystemExit(f'here: {__file__}')")
    with pytest.raises(RuntimeError, match=str(package)):
        size.run(tmp_path, size.COMMANDS["import invrender"], tmp_path)
    assert Path(sys.executable).exists() and (size.HERE / "benchmarks" / "size.py").is_file()


def test_details_are_what_shrinking_loses():
    rng = np.random.default_rng(0)
    truth = constant_maps(64, 64, 0.4, 0.04, 0.5)
    truth.diffuse += rng.uniform(-0.2, 0.2, truth.diffuse.shape).astype(np.float32)
    blurred = resize_maps(resize_maps(truth, 16, 16), 64, 64)
    assert size.detail_error(truth, truth, 16) == 0
    assert size.detail_error(blurred, truth, 16) == pytest.approx(1, abs=0.1)
    half = constant_maps(64, 64, 0.4, 0.04, 0.5)
    half.diffuse[:] = (truth.diffuse + blurred.diffuse) / 2
    assert size.detail_error(half, truth, 16) == pytest.approx(0.5, abs=0.05)
    brighter = constant_maps(64, 64, 0.4, 0.04, 0.5)
    brighter.diffuse[:] = truth.diffuse + 0.1  # wrong at large, right in its details
    assert size.detail_error(brighter, truth, 16) == pytest.approx(0, abs=1e-3)


def test_errors_of_a_result_are_at_the_small_size(tmp_path):
    truth, found = constant_maps(32, 32, 0.4, 0.04, 0.5), constant_maps(32, 32, 0.5, 0.04, 0.5)
    found.diffuse[::2] += 0.05
    found.diffuse[1::2] -= 0.05
    write_maps(tmp_path, found)
    assert set(size.errors(tmp_path, truth)) == {"shrunk"}
    expected = np.sqrt(0.1**2 + 0.05**2) / 4  # no shrinking below 256²
    assert size.errors(tmp_path, truth)["shrunk"] == pytest.approx(expected, rel=1e-3)


def test_what_was_measured_is_kept_for_the_same_commits(tmp_path):
    file, checkouts = tmp_path / "runs.json", {"this checkout": size.HERE}
    cost = {"seconds": 4.0, "processor seconds": 5.0, "GB": 1.0}
    size.Runs.of(file, checkouts).add("256²", "this checkout", cost, {"shrunk": 0.05})
    again = size.Runs.of(file, checkouts)
    assert again.costs == {"256²": {"this checkout": [cost]}}
    assert again.errors["256²"]["this checkout"] == [{"shrunk": 0.05}]
    assert size.Runs.of(file, {**checkouts, "the other": size.HERE}).costs == {}


def test_bars_need_another_checkout_for_ratios(tmp_path):
    cost = {"seconds": 4.0, "processor seconds": 5.0, "GB": 1.0}
    costs = {what: {"this checkout": [cost]} for what in ("refine example", "256²", "1024²")}
    found = {
        "256²": {"this checkout": [{"shrunk": 0.05}]},
        "1024²": {"this checkout": [{"shrunk": 0.06, "details": 0.7}]},
    }
    size.report(tmp_path, costs, found)
    names = {b["name"]: b for b in _bars(tmp_path)}
    assert not any("other" in name for name in names)
    assert names["average error at 1024², shrunk, over that at 256²"]["value"] == pytest.approx(1.2)
    assert names["details at 1024² over none"]["ok"] and names["1024²: GB"]["ok"]
    for by in costs.values():
        by["the other"] = [{**cost, "seconds": 10.0}]
    for by in found.values():
        by["the other"] = by["this checkout"]
    size.report(tmp_path, costs, found)
    ratio = next(b for b in _bars(tmp_path) if b["name"].startswith("1024²: seconds"))
    assert ratio["value"] == pytest.approx(0.4) and not ratio["ok"]


def _bars(folder):
    import json

    return json.loads((folder / "results.json").read_text())["bars"]
