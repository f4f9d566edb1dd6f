"""Time, memory and error of whole processes against the size of the maps, beside another checkout.

Every run is a process of its own, as people start it: seconds, processor seconds and peak memory
are the process's. ``--against DIR`` names a checkout of the commit to compare with; the two take
turns, and ratios are medians of the rounds' (ours over theirs). Captures have photos of one size
(`benchmarks.common.captures`); the first one's maps are asked for at all sizes. Error is that of
the average map up to 1024², of all captures: shrunk to 256², against the truth at 256²; and, above
256², of the band of details that 256² do not hold, over that of having none. A first run has an
empty cache of kernels. From `ONCE` pixels a side there is one round. A batch is of copies of one
capture; ``inspect`` looks at a JPEG of 48 megapixels.

What is measured is kept in runs.json: interrupted, the same command goes on where it was, unless a
checkout's commit has changed. On two quiet cores of a Xeon it takes half an hour, of which 4096² at
92290c8 is a third, and five minutes more for each capture that is not there yet.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.captures import PHOTOGRAPHS, arguments, make_captures
from benchmarks.common.jpeg import jpeg
from benchmarks.common.photos import make_shot
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import Bar, bar, table, write_results
from invrender.files.capture import load_capture
from invrender.files.maps import read_maps
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.maps import Maps, map_errors, resize_maps
from invrender.types import Array

HERE = Path(__file__).parents[1]
SMALL = 256  # pixels a side at which maps of all sizes are compared
SIZES = (256, 512, 1024, 2048, 4096)
ONCE = 512  # pixels a side from which there is one round
JUDGED = 1024  # pixels a side up to which errors are measured
PHOTO = 3840  # pixels wide
BATCH = 20  # captures
HUGE, QUALITY = 8000, 90  # pixels wide, of 48 megapixels; of its JPEG
SEED = 2994  # of the large photo
INVRENDER = ("-m", "invrender")
EXAMPLE = (*INVRENDER, "refine", "example", "-o", "OUT")
COMMANDS = {
    "import invrender": ("-c", "import invrender"),
    "invrender --help": (*INVRENDER, "--help"),
    "refine example": EXAMPLE,
}
FIRST = "refine example, first run"
# Seconds over those of the other checkout, and peak GB.
TIME_BARS = {FIRST: 0.6, "refine example": 0.35, "invrender --help": 0.3,
             "1024²": 0.3, "2048²": 0.25, "4096²": 0.15, "batch": 0.5, "inspect": 0.5}  # fmt: skip
MEMORY_BARS = {"1024²": 1.2, "2048²": 2.0, "4096²": 4.0, "inspect": 1.0}

QUANTITIES = ("seconds", "processor seconds", "GB")
Cost = dict[str, float]  # of each of these


# A process inherits its parent's peak memory until its own is greater: this one is small.
STARTER = """
import os, subprocess, sys, time
start = time.perf_counter()
process = subprocess.Popen(sys.argv[2:], stdin=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
took = time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 2**20
with open(sys.argv[1], "w") as file:
    print(*took, file=file)
os._exit(os.waitstatus_to_exitcode(status) & 255)
"""


def run(checkout: Path, command: Sequence[str], out: Path, home: Path | None = None) -> Cost:
    """Run ``python COMMAND`` with a checkout's code, OUT in it being a name; what it took.

    home: another home folder, where Dr.Jit finds no compiled kernels. Raises `RuntimeError` with
    the process's last words where it fails.
    """
    words = [sys.executable, *(word.replace("OUT", str(out)) for word in command)]
    env = {**os.environ, "PYTHONPATH": str(checkout), **({"HOME": str(home)} if home else {})}
    with tempfile.TemporaryDirectory() as name:
        took = Path(name) / "took"
        start = [sys.executable, "-S", "-c", STARTER, str(took), *words]
        done = subprocess.run(start, cwd=checkout, env=env, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{' '.join(words)}: {(done.stdout + done.stderr)[-500:]}")
        return dict(zip(QUANTITIES, map(float, took.read_text().split()), strict=True))


def detail(maps: Maps, size: int) -> dict[str, Array]:
    """What maps (n, n) hold beyond ``size``² pixels, encoded, by map."""
    n = maps.shape[0]
    coarse = resize_maps(resize_maps(maps, size, size), n, n).encoded()
    return {name: image - coarse[name] for name, image in maps.encoded().items()}


def detail_error(maps: Maps, truth: Maps, size: int = SMALL) -> float:
    """RMS error of the details beyond ``size``² over that of having none, mean of the four maps.

    A map without details of its own does not count.
    """
    found, true = detail(maps, size), detail(truth, size)
    ratios = []
    for name, t in true.items():
        nothing = float(np.mean(t.astype(np.float64) ** 2))
        if nothing > 1e-10:
            ratios.append(np.sqrt(np.mean((found[name] - t).astype(np.float64) ** 2) / nothing))
    return float(np.mean(ratios))


def errors(out: Path, truth: Maps) -> dict[str, float]:
    """Average map RMSE of a result at `SMALL`², and of its details where it is larger."""
    maps = read_maps(out)
    n = maps.shape[0]
    small = [resize_maps(m, min(n, SMALL), min(n, SMALL)) for m in (maps, truth)]
    found = {"shrunk": map_errors(*small)["average"]}
    if n > SMALL:
        found["details"] = detail_error(maps, resize_maps(truth, n, n))
    return found


def huge_photo(folder: Path, width: int) -> Path:
    """A capture whose photo is a JPEG of so many pixels, made if it is not there."""
    if (folder / "rig.toml").exists():
        return folder
    shot = make_shot(SEED, kind="jpeg", width=width)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "photo.jpg").write_bytes(jpeg(shot.photo.image, QUALITY))
    write_exr(folder / "pattern.exr", shot.pattern)
    write_rig(folder / "rig.toml", shot.nominal, "pattern.exr")
    return folder


def parser() -> argparse.ArgumentParser:
    p = arguments(__doc__, "one small procedural capture at 128² and 512²", 3)
    p.add_argument("--against", type=Path, help="a checkout of the commit to compare with")
    p.add_argument("--rounds", type=int, default=3, help="runs of each process (3)")
    p.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="pixels a side of the maps")
    return p


@dataclass
class Runs:
    """What was measured so far, by process and checkout, kept in a file."""

    file: Path
    commits: dict[str, str]
    costs: dict[str, dict[str, list[Cost]]]
    errors: dict[str, dict[str, list[dict[str, float]]]]

    @classmethod
    def of(cls, file: Path, checkouts: dict[str, Path]) -> Runs:
        """Those of the file, if they are of the same commits."""
        head = ["git", "rev-parse", "HEAD"]
        commits = {
            name: subprocess.run(head, cwd=path, capture_output=True, text=True).stdout.strip()
            for name, path in checkouts.items()
        }
        kept = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        same = kept.get("commits") == commits
        return cls(file, commits, *(kept[k] if same else {} for k in ("costs", "errors")))

    def add(self, what: str, checkout: str, cost: Cost, error: dict[str, float] | None) -> None:
        self.costs.setdefault(what, {}).setdefault(checkout, []).append(cost)
        if error is not None:
            self.errors.setdefault(what, {}).setdefault(checkout, []).append(error)
        self.write()

    def write(self) -> None:
        content = {k: v for k, v in vars(self).items() if k != "file"}
        new = self.file.with_suffix(".new")
        new.write_text(json.dumps(content, indent=1), encoding="utf-8")
        new.replace(self.file)


def main(args: argparse.Namespace) -> None:
    sizes, rounds = ((128, 512), 1) if args.quick else (args.sizes, args.rounds)
    shape = (512, 960, 8) if args.quick else (1024, PHOTO, 32)
    real = (None, None) if args.quick else (args.materials, args.envs)
    count = 1 if args.quick else args.count
    folders = make_captures(args.out / "captures", PHOTOGRAPHS, count, *shape, *real)
    huge = huge_photo(args.out / "huge", 1200 if args.quick else HUGE)
    first = str(folders[0].resolve())
    checkouts = {"this checkout": HERE}
    if args.against:
        checkouts["the other"] = args.against.resolve()
    runs = Runs.of(args.out / "runs.json", checkouts)
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)

        def turns(
            what: str, command: Sequence[str], rounds: int, fresh: bool = False, judge: bool = False
        ) -> None:
            """Run a command with each checkout in turns, until there are so many rounds."""
            for k in range(rounds):
                for c, checkout in checkouts.items():
                    if len(runs.costs.get(what, {}).get(c, [])) > k:
                        continue
                    place = out / f"{c} {what}"
                    home = Path(tempfile.mkdtemp(dir=out)) if fresh else None
                    cost = run(checkout, command, place, home)
                    print(what, c, {q: round(v, 2) for q, v in cost.items()}, flush=True)
                    error = errors(place, truth_of(folders[0])) if judge and k == 0 else None
                    runs.add(what, c, cost, error)
                    shutil.rmtree(place, ignore_errors=True)

        for checkout in checkouts.values():
            run(checkout, EXAMPLE, out / "warm")  # fills the caches
        for what, command in COMMANDS.items():
            turns(what, command, rounds)
        turns(FIRST, EXAMPLE, rounds, fresh=True)
        turns("inspect", (*INVRENDER, "inspect", str(huge.resolve()), "-o", "OUT"), rounds)
        batch = [out / f"capture {k:02}" for k in range(2 if args.quick else BATCH)]
        for copy in batch:
            shutil.copytree(folders[0], copy)
        turns("batch", (*INVRENDER, "refine", *map(str, batch), "-o", "OUT"), 1)
        for n in sizes:
            words = (*INVRENDER, "refine", first, "-o", "OUT", "--size", str(n))
            turns(f"{n}²", words, rounds if n < ONCE else 1, judge=n <= JUDGED)
        for n in (n for n in sizes if n <= JUDGED):
            judged = runs.errors[f"{n}²"]["this checkout"]
            for folder in folders[len(judged) :]:
                command = (
                    *INVRENDER,
                    "refine",
                    str(folder.resolve()),
                    "-o",
                    "OUT",
                    "--size",
                    str(n),
                )
                run(HERE, command, out / "judged")
                judged.append(errors(out / "judged", truth_of(folder)))
                print(f"{n}²", folder.name, judged[-1], flush=True)
                runs.write()
    report(args.out, runs.costs, runs.errors)


def truth_of(folder: Path) -> Maps:
    truth = load_capture(folder).truth
    assert truth is not None
    return truth


def median(costs: list[Cost], what: str) -> float:
    return statistics.median(cost[what] for cost in costs)


def report(out: Path, costs: dict[str, dict[str, list[Cost]]], found: dict[str, Any]) -> None:
    """Write tables, plot and bars. found: errors by size and checkout, of captures."""
    checkouts = list(next(iter(costs.values())))
    ours = "this checkout"
    medians = {
        what: {c: {q: median(some, q) for q in QUANTITIES} for c, some in by.items()}
        for what, by in costs.items()
    }
    ratios, processor = (
        {
            what: statistics.median(a[q] / b[q] for a, b in zip(*by.values(), strict=True))
            for what, by in costs.items()
            if len(by) == 2
        }
        for q in QUANTITIES[:2]
    )
    means = {
        size: {e: float(np.mean([f[e] for f in by[ours]])) for e in by[ours][0]}
        for size, by in found.items()
    }
    rows = [
        [
            what,
            *(by[c][q] for c in checkouts for q in QUANTITIES),
            *([ratios[what], processor[what]] if ratios else []),
        ]
        for what, by in medians.items()
    ]
    header = ["", *(f"{q}, {c}" for c in checkouts for q in QUANTITIES)]
    both = ["seconds, ratio", "processor seconds, ratio"] if ratios else []
    shown = {"shrunk": "shrunk to 256²", "details": "details"}
    tables = {
        "processes": table([*header, *both], rows),
        "errors": table(
            [
                "maps of",
                "captures",
                *shown.values(),
                *(f"{e}, the first one, {c}" for c in checkouts for e in shown.values()),
            ],
            [
                [
                    size,
                    len(found[size][ours]),
                    *(of.get(e) for e in shown),
                    *(found[size][c][0].get(e) for c in checkouts for e in shown),
                ]
                for size, of in means.items()
            ],
        ),
    }
    sizes = [int(size[:-1]) for size in costs if size.endswith("²")]
    panels: dict[str, Any] = {
        q: {c: (sizes, [medians[f"{n}²"][c][q] for n in sizes]) for c in checkouts}
        for q in QUANTITIES
    }
    panels["average map RMSE, shrunk to 256²"] = {
        ours: ([int(size[:-1]) for size in means], [of["shrunk"] for of in means.values()])
    }
    plot_error_over_time(out / "size.png", panels, x="pixels a side", y="", columns=2)
    results = {"medians": medians, "ratios": ratios, "errors": means}
    kept = {"processor_ratios": processor, "costs": costs, "errors_of_captures": found}
    write_results(out, {**results, **kept, "bars": bars(results)}, tables)


def bars(results: dict[str, Any]) -> list[Bar]:
    """What was measured beside its bar; ratios only where there was another checkout."""
    medians, means = results["medians"], results["errors"]
    found = [
        bar(f"{what}: seconds over the other checkout's", results["ratios"][what], most, False)
        for what, most in TIME_BARS.items()
        if what in results["ratios"]
    ]
    ours = {what: by["this checkout"] for what, by in medians.items()}
    found += [bar(f"{what}: GB", ours[what]["GB"], most, False)
              for what, most in MEMORY_BARS.items() if what in ours]  # fmt: skip
    small, large = (means.get(f"{n}²") for n in (SMALL, 1024))
    if small and large:
        ratio = large["shrunk"] / small["shrunk"]
        found.append(bar("average error at 1024², shrunk, over that at 256²", ratio, 1.03, False))
    if large:
        found.append(bar("details at 1024² over none", large["details"], 0.8, False))
    return found
