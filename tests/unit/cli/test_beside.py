"""A process beside this one: results and errors come back, and it ends with the work."""

import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest

from invrender import InputError, load_capture, pipeline
from invrender.cli.beside import beside


def test_results_and_errors_come_back(tmp_path):
    with beside() as submit:
        assert submit(abs, -3).result() == 3
        with pytest.raises(InputError, match="not a folder"):
            submit(load_capture, tmp_path / "nowhere").result()


def test_an_error_ends_it_at_once():
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt), beside() as submit:
        submit(time.sleep, 100)
        raise KeyboardInterrupt
    assert time.monotonic() - began < 50


def test_what_a_killed_process_owes_is_done_here(tmp_path, monkeypatch):
    def here(*_):
        raise InputError("done here")

    monkeypatch.setattr(pipeline, "prepare", here)
    monkeypatch.setattr(pipeline, "load_networks", lambda init: None)
    lost = Future()
    lost.set_exception(BrokenProcessPool())
    with pytest.raises(InputError, match="done here"):
        pipeline.refine_capture(tmp_path, tmp_path.parent / "out", prepared=lost)
