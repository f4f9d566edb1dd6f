"""One way to map a function over many items: in this process, in a few, or on a Dask cluster.

The function must be importable, and safe to run again on the same item: a worker that dies takes
the results with it that nobody has fetched yet, and its items are run again elsewhere. Every item
is reported exactly once.
"""

from __future__ import annotations

import multiprocessing
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from invrender.types import InputError

RETRIES = 10  # workers that may die over one item


@dataclass(frozen=True)
class Done:
    """An item's index, and the function's result or the error it raised."""

    index: int
    result: Any = None
    error: Exception | None = None
    trace: str = ""

    def unwrap(self) -> Any:
        """The result; raises the error if there was one."""
        if self.error is not None:
            raise self.error
        return self.result


def map_tasks(
    function: Callable[[Any], Any],
    items: Iterable[Any],
    scheduler: str | None = None,
    workers: int = 1,
) -> Iterator[Done]:
    """Apply a function to every item; yields each item's `Done` as it comes, in any order. Of one
    process, each item is asked for when the one before it is done.

    scheduler: the address of a Dask scheduler; needs the extra ``cluster``. Without one, a number
    of ``workers`` other than 1 means that many processes, and 1 this one. An error of one item does
    not stop the others, nor does a process that dies. Raises `InputError` if no scheduler answers.
    """
    if scheduler:
        yield from _on_cluster(function, items, scheduler)
    elif workers == 1:
        for index, item in enumerate(items):
            yield _guarded(function, index, item)
    else:
        yield from _in_processes(function, items, workers)


def _guarded(function: Callable[[Any], Any], index: int, item: Any) -> Done:
    try:
        return Done(index, function(item))
    except Exception as error:  # reported with its item; the others go on
        return Done(index, error=error, trace=traceback.format_exc())


def _in_processes(
    function: Callable[[Any], Any], items: Iterable[Any], workers: int
) -> Iterator[Done]:
    # A pool a process: where one dies, only its own item is lost, and known.
    context = multiprocessing.get_context("spawn")
    idle: SimpleQueue[ProcessPoolExecutor] = SimpleQueue()
    for _ in range(workers):
        idle.put(ProcessPoolExecutor(1, context))

    def run(index: int, item: Any) -> Done:
        pool = idle.get()
        try:
            for _ in range(RETRIES + 1):
                try:
                    return pool.submit(_guarded, function, index, item).result()
                except BrokenProcessPool as error:
                    died = error
                    pool = ProcessPoolExecutor(1, context)
            return Done(index, error=died)
        finally:
            idle.put(pool)

    with ThreadPoolExecutor(workers) as threads:
        jobs = [threads.submit(run, i, item) for i, item in enumerate(items)]
        try:
            for job in as_completed(jobs):
                yield job.result()
        finally:
            threads.shutdown(cancel_futures=True)
            for _ in range(workers):
                idle.get().shutdown()


def _on_cluster(
    function: Callable[[Any], Any], items: Iterable[Any], scheduler: str
) -> Iterator[Done]:
    try:
        import distributed
    except ImportError:
        raise InputError("a cluster needs Dask: pip install 'invrender[cluster]'") from None
    try:
        client = distributed.Client(scheduler, timeout=10)
    except (OSError, ValueError, TimeoutError):
        raise InputError(f"no Dask scheduler answers at {scheduler}") from None
    with client:
        version = client.run_on_scheduler(lambda: distributed.__version__)
        if version != distributed.__version__:
            raise InputError(f"the cluster runs Dask {version}, this is {distributed.__version__}")
        jobs = [
            client.submit(_guarded, function, i, item, pure=False, retries=RETRIES)
            for i, item in enumerate(items)
        ]
        numbers = {job.key: i for i, job in enumerate(jobs)}
        # Results are fetched as they come, so that a dying worker takes few with it.
        for job, done in distributed.as_completed(jobs, with_results=True, raise_errors=False):
            if job.status == "finished":
                yield done
            else:  # its workers died too often
                error = job.exception()
                yield Done(numbers[job.key], error=RuntimeError(f"{type(error).__name__}: {error}"))
