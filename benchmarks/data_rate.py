"""Training captures a second, at 128² and 256², with the share of each part.

One process, one thread; what counts is its own processor time, so that other work on the machine
matters little. Shards are made by independent processes: n free cores make n times as many.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from benchmarks.common.results import bar, benchmark_parser, table, write_results
from invrender.render.backend import dr
from nets.training import dataset as data

WARM = 16  # captures before the clock starts: kernels of a first run are compiled once a machine
BARS = {128: 8.0, 256: 2.0}  # captures a second on two cores
PARTS = {  # timed inside `make_group`
    "materials": "draw_material",
    "rooms": "draw_environment",
    "light inputs, clues": "light_inputs",
    "tables": "Fast",
    "sensor": "sensor",
}


def rate(size: int, count: int, materials: str, envs: str) -> dict[str, Any]:
    """Processor seconds a capture, those of each part, and what `PARTS` leaves: the renders."""
    options = data.Options(size=size, seed=5, materials=materials, envs=envs)
    stream = data.captures(options, 0)
    for _ in range(WARM):
        next(stream)
    spent = dict.fromkeys(PARTS, 0.0)
    originals = {name: getattr(data, name) for name in PARTS.values()}

    def timed(part: str, f: Any) -> Any:
        def run(*args: Any, **keywords: Any) -> Any:
            start = time.process_time()
            out = f(*args, **keywords)
            dr.sync_thread()
            spent[part] += time.process_time() - start
            return out

        return run

    for part, name in PARTS.items():
        setattr(data, name, timed(part, originals[name]))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.process_time()
        for _ in range(count):
            next(stream)
        total = time.process_time() - start
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    for name, f in originals.items():
        setattr(data, name, f)
    compiling = sum(k["backend_time"] for k in kernels) / 1e3
    out = {part: seconds / count for part, seconds in spent.items()}
    out["renders and the rest"] = (total - compiling - sum(spent.values())) / count
    return {"seconds": (total - compiling) / count, "compiling": compiling / count, "parts": out}


def parser() -> argparse.ArgumentParser:
    p = benchmark_parser(__doc__, "few captures")
    p.add_argument("--materials", default="", help="folder of real materials")
    p.add_argument("--envs", default="", help="folder of real environments")
    return p


def main(args: argparse.Namespace) -> None:
    data._single_thread()
    counts = {128: 8, 256: 4} if args.quick else {128: 96, 256: 48}
    found = {size: rate(size, count, args.materials, args.envs) for size, count in counts.items()}
    bars = [
        bar(f"captures a second at {size}², two cores", 2 / r["seconds"], BARS[size], True)
        for size, r in found.items()
    ]
    rows = [["all", *(r["seconds"] for r in found.values())]]
    rows += [[k, *(r["parts"][k] for r in found.values())] for k in found[128]["parts"]]
    parts = table(["processor seconds a capture", *(f"{size}²" for size in found)], rows)
    results = {"rates": {str(k): v for k, v in found.items()}, "bars": bars}
    write_results(args.out, results, {"parts": parts})
