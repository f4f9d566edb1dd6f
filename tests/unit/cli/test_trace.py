"""A trace: what was running, and for how long, in the format that viewers read."""

import json
import time

import pytest

from invrender.cli.main import main
from invrender.cli.trace import traced


def busy(seconds):
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        pass


def outer():
    busy(0.2)
    time.sleep(0.2)


def test_durations_by_function(tmp_path):
    with traced(tmp_path / "trace.json"):
        outer()
    events = json.loads((tmp_path / "trace.json").read_text())["traceEvents"]
    open_, seconds = [], {}
    for e in events:
        if e["ph"] == "B":
            open_.append((e["name"], e["ts"]))
        else:
            name, began = open_.pop()
            assert name == e["name"] and e["ts"] >= began
            short = name.rpartition(".")[2]
            seconds[short] = seconds.get(short, 0) + (e["ts"] - began) / 1e6
    assert not open_
    assert 0.1 < seconds["busy"] < seconds["outer"]
    assert seconds["outer"] > 0.3


@pytest.mark.parametrize("name", ["missing/trace.json", "photo.exr"])
def test_a_trace_that_cannot_be_written_is_refused_before_the_work(tmp_path, name, capsys):
    (tmp_path / "photo.exr").write_text("an input")
    (tmp_path / "missing").write_text("a file, no folder")
    page = tmp_path / "page.html"
    assert main(["pattern", "-o", str(page), "--profile", str(tmp_path / name)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not page.exists() and (tmp_path / "photo.exr").read_text() == "an input"
