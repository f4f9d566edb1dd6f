"""What a process does, by the stack of one thread every few milliseconds.

The file is in Chrome's trace format, which https://ui.perfetto.dev, https://www.speedscope.app and
chrome://tracing open.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from invrender.files.output import check_output
from invrender.files.write import atomic_path
from invrender.types import InputError

EVERY = 0.005  # seconds between samples; a trace of a run has some megabytes


@contextmanager
def traced(path: Path) -> Iterator[None]:
    """Sample the calling thread while the block runs, and write its trace, also after an error.

    Raises `InputError`, before the block runs, where ``path`` is no .json file that can be written:
    no input is one.
    """
    if path.suffix.lower() != ".json":
        raise InputError(f"{path}: the trace is a JSON file; give it a name that ends in .json")
    check_output(path, file=True)
    samples: list[tuple[float, list[str]]] = []
    thread, ended = threading.get_ident(), threading.Event()

    def sample() -> None:
        while not ended.wait(EVERY):
            samples.append((time.perf_counter(), _stack(sys._current_frames().get(thread))))

    sampler = threading.Thread(target=sample, daemon=True)
    sampler.start()
    try:
        yield
    finally:
        ended.set()
        sampler.join()
        samples.append((time.perf_counter(), []))
        trace = {"traceEvents": _events(samples), "displayTimeUnit": "ms"}
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(trace), encoding="utf-8")


def _stack(frame: FrameType | None) -> list[str]:
    """Functions from the outermost in, by module; those of importing are left out."""
    names = []
    while frame is not None:
        module = frame.f_globals.get("__name__", "?")
        if not module.startswith("importlib"):
            names.append(f"{module}.{frame.f_code.co_qualname}")
        frame = frame.f_back
    return names[::-1]


def _events(samples: list[tuple[float, list[str]]]) -> list[dict[str, Any]]:
    """Each function from the first sample that meets it to the first that does not."""
    events: list[dict[str, Any]] = []
    before: list[str] = []
    for seconds, names in samples:
        same = 0
        while same < min(len(names), len(before)) and names[same] == before[same]:
            same += 1
        changes = [("E", n) for n in reversed(before[same:])] + [("B", n) for n in names[same:]]
        at = {"ts": seconds * 1e6, "pid": 1, "tid": 1}
        events += [{"ph": kind, "name": name, **at} for kind, name in changes]
        before = names
    return events
