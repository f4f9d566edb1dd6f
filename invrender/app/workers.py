"""Work in a process of its own: it may be killed, and a file that crashes it takes nothing along.

A worker does one thing at a time, and ends with the process that made it.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any

from invrender.types import InputError

ENDING = 10.0  # seconds that a killed process gets to end
CONTEXT = multiprocessing.get_context("spawn")


class Died(Exception):
    """The worker's process ended in the middle of its work."""


class Worker:
    """A process that runs functions of `invrender.app.work` by name."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._process: Any = None
        self._connection: Connection | None = None

    async def run(
        self,
        name: str,
        *arguments: Any,
        progress: Callable[[Any], None] = lambda message: None,
        seconds: float | None = None,
    ) -> Any:
        """Call a function and return what it returns; its first argument tells ``progress``.

        It is killed after that many seconds. Raises `InputError` as the function does, `Died`
        where the process ended, `RuntimeError` with the trace for anything else.
        """
        async with self._lock:
            connection = self._ready()
            connection.send((name, arguments))
            loop = asyncio.get_running_loop()
            end = None if seconds is None else loop.call_later(seconds, self.kill)
            try:
                while True:
                    kind, value = await asyncio.to_thread(_receive, connection)
                    if kind == "progress":
                        progress(value)
                    elif kind == "done":
                        return value
                    elif kind == "input":
                        raise InputError(value)
                    elif kind == "died":
                        await asyncio.to_thread(self._process.join, ENDING)
                        self._process = None
                        raise Died
                    else:
                        raise RuntimeError(value)
            except asyncio.CancelledError:  # nobody waits for what it would still say
                self.kill()
                self._process = None
                raise
            finally:
                if end is not None:
                    end.cancel()

    def kill(self) -> None:
        """End the process; the next call makes a new one."""
        if self._process is not None:
            self._process.kill()

    def _ready(self) -> Connection:
        if self._process is None or not self._process.is_alive() or self._connection is None:
            self._connection, theirs = CONTEXT.Pipe()
            self._process = CONTEXT.Process(target=_serve, args=(theirs,), daemon=True)
            self._process.start()
            theirs.close()
        return self._connection


def _receive(connection: Connection) -> tuple[str, Any]:
    try:
        return connection.recv()  # type: ignore[no-any-return]
    except (EOFError, OSError):
        return "died", None


def _serve(connection: Connection) -> None:
    """The worker's process: calls come, progress and results go."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the server's
    from invrender.app import work

    while True:
        try:
            name, arguments = connection.recv()
        except EOFError:
            return
        try:
            told = lambda message: connection.send(("progress", message))  # noqa: E731
            connection.send(("done", getattr(work, name)(told, *arguments)))
        except InputError as error:
            connection.send(("input", str(error)))
        except MemoryError:
            connection.send(("input", "the memory does not suffice for this photo"))
        except Exception:
            connection.send(("error", traceback.format_exc()))
