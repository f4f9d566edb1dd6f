"""Many captures, one after the other, in processes or on a cluster; one that fails stops none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invrender.cli.beside import beside, cores
from invrender.files.output import check_output
from invrender.report.report import Report
from invrender.tasks import map_tasks
from invrender.types import InputError

if TYPE_CHECKING:
    from invrender.cli.beside import Submit

# Captures whose lights are found while another is solved. Of a large photo they take as long as
# the rest, on one processor of two, of which the rest leaves a half.
AHEAD = 2


@dataclass(frozen=True)
class Outcome:
    """What became of one capture: "done", "skipped" (it was there already) or "failed".

    report: None where it failed, and ``error`` tells why in one sentence.
    """

    name: str
    status: str
    report: Report | None = None
    error: str = ""


def refine_captures(
    folders: Sequence[Path],
    out: Path,
    *,
    scheduler: str | None = None,
    workers: int = 1,
    **options: Any,
) -> Iterator[Outcome]:
    """Refine each capture into ``out``/NAME, the name of its folder; yields outcomes as they come.

    A result that is there already, whole and of the same size and start, is not made again.
    scheduler, workers: see `invrender.tasks.map_tasks`. options: those of
    `invrender.pipeline.refine_capture`. Raises `InputError` for two captures of one
    name, or no worker.
    """
    if workers < 1:
        raise InputError(f"the number of workers must be at least one, got {workers}")
    folders, out = [Path(f).resolve() for f in folders], Path(out)
    names = [f.name for f in folders]
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise InputError(f"two captures have the name '{twice[0]}'; rename one of the folders")
    for name in names:
        check_output(out / name, folders)
    jobs = []
    for folder, name in zip(folders, names, strict=True):
        report = finished(out / name, options.get("size", 256), options.get("init", "network"))
        if report is not None:
            yield Outcome(name, "skipped", report)
        else:
            jobs.append((folder, out / name, options))
    # One process solves a capture while others find the lights of the next.
    alone = len(jobs) < 2 or scheduler or workers > 1 or cores() == 1
    with nullcontext() if alone else beside(AHEAD) as submit:
        yield from _outcomes(jobs, _ahead(jobs, submit) if submit else jobs, scheduler, workers)


Job = tuple[Path, Path, dict[str, Any]]


def _ahead(jobs: Sequence[Job], submit: Submit) -> Iterator[Job]:
    """The jobs, each with what is prepared for it, which for the next `AHEAD` begins with it."""
    from invrender.pipeline import prepare

    def begin(job: Job) -> Any:
        options = job[2]
        known = {k: options.get(k) for k in ("ball", "environment", "gain")}
        with suppress(BrokenProcessPool):
            return submit(prepare, [job[0]], known, options.get("size", 256))

    begun = [begin(job) for job in jobs[:AHEAD]]
    for i, (folder, out, options) in enumerate(jobs):
        begun += [begin(job) for job in jobs[i + AHEAD : i + AHEAD + 1]]
        yield folder, out, {**options, "prepared": begun.pop(0)}


def _outcomes(
    jobs: Sequence[Job], items: Iterable[Job], scheduler: str | None, workers: int
) -> Iterator[Outcome]:
    for done in map_tasks(_refine, items, scheduler, workers):
        name = jobs[done.index][1].name
        if done.error is None:
            yield Outcome(name, "done", done.result)
        elif isinstance(done.error, InputError):
            yield Outcome(name, "failed", error=str(done.error))
        else:
            yield Outcome(name, "failed", error=f"{type(done.error).__name__}: {done.error}")


def finished(folder: Path, size: int, init: str) -> Report | None:
    """The report of a result that needs no second run, else None. It is the last file written."""
    try:
        report = Report.read(folder)
    except InputError:
        return None
    same = (report.size, report.init, report.status) == (size, init, "done")
    return report if same else None


def _refine(job: Job) -> Report:
    from invrender.pipeline import refine_capture

    folder, out, options = job
    return refine_capture(folder, out, **options)
