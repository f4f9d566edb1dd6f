"""Mapping tasks: every item reported once, whatever fails; on a cluster a worker may die."""

import os
import time
from pathlib import Path

import pytest

from invrender.cluster import map_tasks
from invrender.errors import InputError


def halve(x):
    if x % 2:
        raise InputError(f"{x} is odd")
    return x // 2


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


@pytest.mark.slow
def test_a_worker_may_die(tmp_path):
    """Two workers, one killed half-way: nothing lost, nothing twice."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        jobs = [(str(tmp_path), i) for i in range(30)]
        seen = []
        for done in map_tasks(slow_write, jobs, scheduler=cluster.scheduler_address):
            seen.append(done.unwrap())
            if len(seen) == 10:
                next(iter(cluster.workers.values())).process.process.kill()
    assert sorted(seen) == list(range(30))
    assert {p.name for p in tmp_path.iterdir() if p.name[0] != "."} == {str(i) for i in range(30)}


def test_no_scheduler():
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="scheduler"):
        list(map_tasks(halve, [1], scheduler="nonsense://x"))
