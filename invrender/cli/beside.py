"""Calls in a process beside this one."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # which takes `invrender --help` a third of its time
    from concurrent.futures import Future

    Submit = Callable[..., Future[Any]]


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def load(*modules: str) -> None:
    """Load modules in a thread, while this one reads a photo, for what imports them later."""

    def imports() -> None:
        with suppress(Exception):  # told where they are needed
            for module in modules:
                import_module(module)

    threading.Thread(target=imports, daemon=True).start()


@contextmanager
def beside(processes: int = 1) -> Iterator[Submit]:
    """Processes of their own; what is yielded submits a call to one, which must be importable, and
    returns the call's future. They end with the block, at once where an error ends it."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    before = set(multiprocessing.active_children())
    # A copy of this process has what is loaded; with threads of Dr.Jit or torch it might hang.
    copied = sys.platform == "linux" and not {"drjit", "torch"} & sys.modules.keys()
    context = multiprocessing.get_context("fork" if copied else "spawn")
    pool = ProcessPoolExecutor(processes, context, _leave_ctrl_c)
    try:
        yield pool.submit
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _leave_ctrl_c() -> None:
    """Ctrl-C is the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
