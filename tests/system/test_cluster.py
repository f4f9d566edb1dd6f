"""Mapping tasks: every item reported once, whatever fails; on a cluster a worker may die."""

import os
import signal
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest

from invrender import tasks as cluster
from invrender.tasks import map_tasks
from invrender.types import InputError


def halve(x):
    if x % 2:
        raise InputError(f"{x} is odd")
    return x // 2


def die_at_first(job):
    """Item 2 kills its process the first time, item 3 every time."""
    folder, index = job
    with (Path(folder) / f"{index}.log").open("a") as f:
        f.write("x")
    tries = (Path(folder) / f"{index}.log").stat().st_size
    if index == 3 or (index == 2 and tries == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return index


def slow_write(job):
    folder, index = job
    time.sleep(0.2)
    part = Path(folder) / f".{index}.{os.getpid()}"
    part.write_text(str(index))
    part.replace(Path(folder) / str(index))
    return index


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_stay_with_their_items(workers):
    done = sorted(map_tasks(halve, range(6), workers=workers), key=lambda d: d.index)
    assert [d.index for d in done] == list(range(6))
    assert [d.result for d in done] == [0, None, 1, None, 2, None]
    with pytest.raises(InputError, match="3 is odd"):
        done[3].unwrap()


def test_a_process_may_die(tmp_path, monkeypatch):
    """Nothing lost, nothing twice; an item that kills every process is reported with its error."""
    monkeypatch.setattr(cluster, "RETRIES", 1)
    jobs = [(str(tmp_path), i) for i in range(6)]
    done = sorted(map_tasks(die_at_first, jobs, workers=2), key=lambda d: d.index)
    assert [d.result for d in done] == [0, 1, 2, None, 4, 5]
    with pytest.raises(BrokenProcessPool):
        done[3].unwrap()
    tries = [(tmp_path / f"{i}.log").stat().st_size for i in range(6)]
    assert tries == [1, 1, 2, 2, 1, 1]


@pytest.mark.slow
def test_a_worker_may_die(tmp_path):
    """Two workers, one killed half-way: nothing lost, nothing twice."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as local:
        jobs = [(str(tmp_path), i) for i in range(30)]
        seen = []
        for done in map_tasks(slow_write, jobs, scheduler=local.scheduler_address):
            seen.append(done.unwrap())
            if len(seen) == 10:
                next(iter(local.workers.values())).process.process.kill()
    assert sorted(seen) == list(range(30))
    assert {p.name for p in tmp_path.iterdir() if p.name[0] != "."} == {str(i) for i in range(30)}


def test_no_scheduler():
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="scheduler"):
        list(map_tasks(halve, [1], scheduler="nonsense://x"))
