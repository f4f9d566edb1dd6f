"""What the benchmarks share: bars, tables, the docs' marked blocks, timings, plot, commands."""

import json
from importlib import import_module

import numpy as np
import pytest
from PIL import Image

from benchmarks import __main__ as command
from benchmarks import tables as tables_command
from benchmarks.common import tables, timing
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import bar, cell, markdown, table, write_results
from invrender.types import InputError

NEEDED = {"probes": ["--folder", "x"]}


@pytest.fixture
def results(tmp_path):
    """A folder of results with one run in it."""
    run = {
        "shares": {"flat": {"better": 0.875}},
        "bars": [bar("time, median", 0.5, 0.4, at_least=False)],
    }
    write_results(tmp_path, run, {"errors": table(["", "RMSE"], [["normal", 0.04321]])})
    (tmp_path / "results.json").rename(tmp_path / "made.json")
    return tmp_path


@pytest.mark.parametrize(("value", "at_least", "ok"), [
    (0.9, True, True), (0.8, True, True), (0.7, True, False), (0.9, False, False),
    (0.7, False, True), (float("nan"), True, False), (float("nan"), False, False),
])  # fmt: skip
def test_bar_is_reached_at_its_value(value, at_least, ok):
    assert bar("x", value, 0.8, at_least)["ok"] is ok


def test_results_hold_bars_tables_command_and_machine(results):
    found = json.loads((results / "made.json").read_text())
    assert found["bars"] == [{"name": "time, median", "value": 0.5, "bar": 0.4, "ok": False}]
    assert found["tables"]["errors"]["rows"] == [["normal", 0.04321]]
    assert found["command"].startswith("python -m benchmarks")
    assert found["machine"]["versions"]["numpy"] == np.__version__


def test_results_are_strict_json(tmp_path):
    found = {"seconds": np.array([1.5, np.inf]), "n": np.int64(3), "a": (float("nan"), True)}
    write_results(tmp_path, {**found, "bars": [bar("late", float("inf"), 1, False)]})
    text = (tmp_path / "results.json").read_text()
    read = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert (read["seconds"], read["n"], read["a"]) == ([1.5, None], 3, [None, True])
    assert read["bars"] == [{"name": "late", "value": None, "bar": 1, "ok": False}]
    assert "| late |  | 1 | **no** |" in markdown(tables.bars_table(read["bars"]))


def test_table_refuses_rows_of_another_length():
    with pytest.raises(ValueError, match="2 cells under 1 columns"):
        table(["a"], [[1, 2]])


@pytest.mark.parametrize(("value", "text"), [
    (0.04321, "0.0432"), (3188.4, "3188"), (5.48e7, "5.48e+07"), (7, "7"), (None, ""),
    (float("nan"), ""), (True, "yes"), ("0.1 → 0.2", "0.1 → 0.2"),
])  # fmt: skip
def test_cells(value, text):
    assert cell(value) == text


def test_marked_blocks_are_filled_and_stay_so(results):
    text = "a\n<!-- table: made/errors -->\n| stale |\n<!-- end -->\nb, "
    text += "<!-- number: .1% made/shares/flat/better -->7%<!-- end --> of it, "
    text += "<!-- number: .2f made/bars/time, median/value --><!-- end --> s\n"
    new = tables.filled(text, results)
    assert "|  | RMSE |\n| --- | --- |\n| normal | 0.0432 |\n<!-- end -->\nb, " in new
    assert "better -->87.5%<!-- end --> of it" in new
    assert "value -->0.50<!-- end --> s" in new
    assert tables.filled(new, results) == new
    bars = tables.filled("<!-- table: made/bars --><!-- end -->", results)
    assert "| time, median | 0.5 | 0.4 | **no** |" in bars


@pytest.mark.parametrize(("text", "words"), [
    ("<!-- table: none/errors --><!-- end -->", "no results 'none'; there are: made"),
    ("<!-- table: made/none --><!-- end -->", "no 'none'; there is: errors"),
    ("<!-- number: .0% made/shares/flat --><!-- end -->", "is no number"),
    ("<!-- number: x made/shares/flat/better --><!-- end -->", "'x' is no format of a number"),
    ("<!-- table: made/errors -->", "has no <!-- end -->"),
    ("<!-- table: made/errors --><!-- table: made/bars --><!-- end -->", "has no <!-- end -->"),
])  # fmt: skip
def test_wrong_blocks_are_named(results, text, words):
    with pytest.raises(InputError, match=words):
        tables.filled(text, results)


def test_committed_docs_are_those_of_the_results(capsys):
    assert command.main(["tables", "--check"]) == 0, capsys.readouterr().out


def test_check_tells_which_text_is_stale_and_writes_nothing(tmp_path, monkeypatch, capsys):
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("<!-- table: capture/bars -->x<!-- end -->")
    monkeypatch.setattr(tables_command, "ROOT", tmp_path)
    monkeypatch.setattr(tables_command.texts, "__defaults__", (tmp_path,))
    assert command.main(["tables", "--check"]) == 1
    assert "docs/benchmarks.md, README.md" in capsys.readouterr().out
    assert not (tmp_path / "docs" / "benchmarks.md").exists()
    assert command.main(["tables"]) == 0
    assert command.main(["tables", "--check"]) == 0


def test_times_are_medians_and_ratios_of_pairs(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])

    def lasting(*seconds):
        """A call that lasts the next of these seconds every time."""
        left = iter(seconds)

        def run():
            now[0] += next(left)

        return run

    assert timing.timed(lasting(5, 1, 3, 2), repeats=3) == (5, 2)
    f, baseline = lasting(9, 6, 4, 5), lasting(9, 2, 2, 1)  # after a warm-up, ratios of 3, 2, 5
    assert timing.paired(f, baseline, 3) == (5, 2, 3)


def test_plot_has_a_panel_for_each_title(tmp_path):
    curve = ([0, 0.1, 1], [0.3, 0.2, 0.1])
    panels = {f"scene {i}": {"ours": curve, "baseline": ([2, 20], [0.3, 0.2])} for i in range(4)}
    thin = {"scene 0": {"ours": [curve, ([1, 2], [0, 1])]}}
    plot_error_over_time(tmp_path / "a.png", panels, thin, levels=(0.02,))
    plot_error_over_time(tmp_path / "b.png", {"one": panels["scene 0"]})
    wide, narrow = (Image.open(tmp_path / name).size for name in ("a.png", "b.png"))
    assert wide[0] == 3 * narrow[0] and wide[1] == 2 * narrow[1]


def test_list_of_benchmarks_names_each_with_its_question(capsys):
    assert command.main([]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed and question in listed for name, question in command.names().items())
    assert all(command.names().values())
    assert command.main(["none"]) == 2


@pytest.mark.parametrize("name", [n for n in command.names() if n != "tables"])
def test_every_benchmark_takes_quick_and_out(name):
    module = import_module(f"benchmarks.{name}")
    args = module.parser().parse_args(["--quick", "--out", "x", *NEEDED.get(name, [])])
    assert args.quick and args.out.name == "x" and callable(module.main)
