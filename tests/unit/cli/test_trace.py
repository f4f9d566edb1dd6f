"""A trace: what was running, and for how long, in the format that viewers read."""

import json
import time

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
