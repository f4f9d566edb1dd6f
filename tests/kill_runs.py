"""Runs killed at random moments: `python tests/kill_runs.py COUNT [SEED]`.

``invrender refine`` of one capture, of a batch of three with two processes, and ``invrender
export`` are killed with SIGKILL, all their processes at once: half of them after a random share of
the processor time that a whole run takes, half within half a second of the first file that they
write. After each: the inputs are as they were, and what lies under the results' names is whole or
not there. After every tenth, and at the end, the same command runs through: what was finished
before is not made again, and nothing is left beside the results.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import invrender
from invrender.files.images import read_image
from invrender.files.maps import read_maps
from invrender.types import InputError

EXAMPLE = Path(invrender.__file__).parent / "data" / "example"
PATIENCE = 600.0  # seconds, after which a run hangs
WRITING = 0.5  # seconds that the writing of a small result takes, at most
TICK = 0.002  # seconds between two looks at a process


def hashes(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


def processor_seconds(group: int) -> float:
    """Of all living processes of a group."""
    ticks = 0
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[2]) == group:
                ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def start(command: list[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "invrender", *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def killed(command: list[str], out: Path, moment: Callable[[float, float | None], bool]) -> bool:
    """Whether the run was still alive when its moment came: of its processor seconds, and of the
    seconds since something appeared in the folder of its results."""
    process, writing = start(command), None
    before = set(out.parent.rglob("*"))
    began = time.monotonic()
    while process.poll() is None:
        if writing is None and set(out.parent.rglob("*")) - before:
            writing = time.monotonic()
        if moment(
            processor_seconds(process.pid), None if writing is None else time.monotonic() - writing
        ):
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return True
        if time.monotonic() - began > PATIENCE:
            os.killpg(process.pid, signal.SIGKILL)
            raise AssertionError(f"{command} hangs")
        time.sleep(TICK)
    process.communicate()
    return False


def whole(out: Path) -> bool:
    """Whether a result is there; a folder with a report that cannot be loaded is an error."""
    if not (out / "report.json").exists():
        return False
    invrender.Result.load(out)
    for image in out.glob("*.png"):
        read_image(image)
    return True


def whole_export(out: Path) -> bool:
    """Whether an export is there: all of its files or none."""
    if not out.exists():
        return False
    assert (out / "material.json").exists(), f"{out} is half written"
    for image in out.glob("*.png"):
        read_image(image)
    return True


def main() -> None:
    count, seed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    rng, seen = random.Random(seed), Counter[str]()
    place = Path(tempfile.mkdtemp(prefix="kill-runs-"))
    captures = [place / "captures" / name for name in ("a", "b", "c")]
    for c in captures:
        shutil.copytree(EXAMPLE, c)
    result = place / "result"
    quick = ["--init", "flat", "--size", "32", "-q"]
    subprocess.run(
        [sys.executable, "-m", "invrender", "refine", str(captures[0]), "-o", str(result), *quick],
        check=True,
    )
    jobs: dict[str, tuple[list[str], Callable[[Path], bool], list[str]]] = {
        "refine": (["refine", str(captures[0]), *quick], whole, [""]),
        "batch": (
            ["refine", *map(str, captures), "--workers", "2", *quick],
            whole,
            ["a", "b", "c"],
        ),
        "export": (["export", str(result), "--to", "unity", "--height", "-q"], whole_export, [""]),
    }
    inputs = hashes(place / "captures") | hashes(result)
    took: dict[str, float] = {}
    for kind, (command, _, _) in jobs.items():
        most = [0.0]

        def watch(cpu: float, writing: float | None, most: list[float] = most) -> bool:
            most[0] = max(most[0], cpu)
            return False

        first = place / "out" / kind / "first"
        first.parent.mkdir(parents=True)
        assert not killed([*command, "-o", str(first)], first, watch)
        took[kind] = most[0]
        shutil.rmtree(first.parent)
    for k in range(count):
        kind = ("refine", "batch", "export", "refine")[k % 4]
        command, check, parts = jobs[kind]
        out = place / "out" / kind / "result"
        out.parent.mkdir(parents=True, exist_ok=True)
        share, delay = rng.random() * took[kind], rng.random() * WRITING
        early = rng.random() < 0.5

        def moment(
            cpu: float,
            writing: float | None,
            early: bool = early,
            share: float = share,
            delay: float = delay,
        ) -> bool:
            return cpu >= share if early else writing is not None and writing >= delay

        before = {p: hashes(out / p) for p in parts if check(out / p)}
        alive = killed([*command, "-o", str(out)], out, moment)
        assert hashes(place / "captures") | hashes(result) == inputs, "an input has changed"
        now = [p for p in parts if check(out / p)]
        seen[f"{kind}: {'killed' if alive else 'ended before'}"] += 1
        seen[f"{kind}: results there after it"] += len(now)
        if kind == "batch":
            assert all(hashes(out / p) == before[p] for p in before), "made again"
        if k % 10 in (8, 9) or k >= count - 4:
            end = start([*command, "-o", str(out)])
            _, error = end.communicate(timeout=PATIENCE)
            assert end.returncode == 0, error.decode()
            assert all(check(out / p) for p in parts), "a result is missing"
            seen[f"{kind}: run to its end"] += 1
            if kind == "batch":
                assert all(hashes(out / p) == before[p] for p in before), "made again"
            left = [p for p in (*out.parent.iterdir(), *out.rglob(".*")) if p != out]
            seen[f"{kind}: leftovers of killed runs"] += len(left)
            shutil.rmtree(out.parent)
        print(f"{k + 1}/{count}", dict(seen), flush=True)
    read_maps(result)
    shutil.rmtree(place)
    print("nothing lost, nothing half-written")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"a result that is there cannot be read: {error}")
