"""What the benchmarks share: the machine, timings, results.json and tables."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = ("drjit", "mitsuba", "numpy", "torch")


def machine() -> dict[str, Any]:
    """Processor, cores, and versions of what the numbers depend on."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    flags: list[str] = []
    mhz = 0.0
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            key, _, value = line.partition(":")
            key, value = key.strip(), value.strip()
            if key == "model name":
                name = value
            elif key == "flags":
                flags = value.split()
            elif key == "cpu MHz":
                mhz = max(mhz, float(value))
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return {
        "cpu": name,
        "cores": os.cpu_count(),
        "mhz": mhz,
        "simd_floats": 16 if "avx512f" in flags else 8 if "avx2" in flags else 4,
        "python": platform.python_version(),
        "versions": versions,
    }


def timed(f: Callable[[], Any], repeats: int = 3) -> tuple[float, float]:
    """(first call's seconds, median seconds of the calls after it)."""

    def once() -> float:
        start = time.perf_counter()
        f()
        return time.perf_counter() - start

    cold = once()
    return cold, statistics.median(once() for _ in range(repeats))


def bar(name: str, value: float, target: float, at_least: bool) -> dict[str, Any]:
    """One line of ``bars``: whether a measured value reaches its target."""
    ok = value >= target if at_least else value <= target
    return {"name": name, "value": value, "bar": target, "ok": bool(ok)}


def write_results(out: Path, results: dict[str, Any]) -> None:
    """results.json with the machine beside the results; prints the bars."""
    out.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"machine": machine(), **results}, indent=1)
    (out / "results.json").write_text(text + "\n")
    for b in results.get("bars", []):
        print(f"{'ok  ' if b['ok'] else 'MISS'} {b['name']}: {b['value']:.4g} (bar {b['bar']:g})")


def markdown(header: list[str], rows: list[list[Any]]) -> str:
    """A Markdown table."""
    text = [header, ["---"] * len(header)]
    text += [[f"{c:.3g}" if isinstance(c, float) else str(c) for c in row] for row in rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in text) + "\n"
