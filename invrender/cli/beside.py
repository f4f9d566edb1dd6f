"""Calls in a process beside this one. This module loads nothing heavy: it is used early."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

Submit = Callable[..., Future[Any]]


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def beside() -> Iterator[Submit]:
    """A process of its own; what is yielded submits a call to it, which must be importable, and
    returns the call's future. The process ends with the block, at once where an error ends it."""
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _leave_ctrl_c)
    try:
        yield pool.submit
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def prepare(*arguments: Any) -> Any:
    """`invrender.pipeline.prepare`, for a process that need not load it in order to ask for it."""
    from invrender.pipeline import prepare

    return prepare(*arguments)


def _leave_ctrl_c() -> None:
    """Ctrl-C is the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
