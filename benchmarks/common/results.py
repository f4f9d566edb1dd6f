"""The command line of a benchmark, and its results.json with the machine and the bars."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = ("drjit", "mitsuba", "numpy", "torch")
Bar = dict[str, Any]
Table = dict[str, list[Any]]


def benchmark_parser(doc: str | None, quick: str) -> argparse.ArgumentParser:
    """The arguments that every benchmark has; ``quick`` tells what --quick leaves."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for results.json and plots")
    parser.add_argument("--quick", action="store_true", help=f"{quick}: ends within a minute")
    return parser


def machine() -> dict[str, Any]:
    """Processor, cores, their load, and versions of what the numbers depend on."""
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
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "mhz": mhz,
        "simd_floats": 16 if "avx512f" in flags else 8 if "avx2" in flags else 4,
        "python": platform.python_version(),
        "versions": versions,
    }


def commit() -> str | None:
    """The checked out commit, None outside of a clone."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def bar(name: str, value: float, target: float, at_least: bool) -> Bar:
    """One line of ``bars``: whether a measured value reaches its target."""
    ok = value >= target if at_least else value <= target
    return {"name": name, "value": value, "bar": target, "ok": bool(ok)}


def table(header: list[str], rows: list[list[Any]]) -> Table:
    """A table of ``tables``: names of columns, and rows of as many numbers and words."""
    if wrong := [row for row in rows if len(row) != len(header)]:
        raise ValueError(f"a row of {len(wrong[0])} cells under {len(header)} columns")
    return {"header": list(header), "rows": [list(row) for row in rows]}


def cell(value: Any) -> str:
    """A number or word as the tables show it: three digits, nothing where there is no value."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if math.isnan(value):
            return ""
        return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


def markdown(table: Table) -> str:
    """A Markdown table."""
    lines = [table["header"], ["---"] * len(table["header"]), *table["rows"]]
    return "".join("| " + " | ".join(map(cell, line)) + " |\n" for line in lines)


def write_results(
    out: Path, results: dict[str, Any], tables: dict[str, Table] | None = None
) -> None:
    """Write ``out``/results.json with command, machine, tables and bars; print these.

    results: ``bars`` (a list of `bar`) and whatever else was measured. tables: by name, what
    ``python -m benchmarks tables`` shows of the results once they are in benchmarks/results.
    """
    out.mkdir(parents=True, exist_ok=True)
    words = ["python -m benchmarks", *sys.argv[1:]]
    about = {"command": " ".join(words), "commit": commit(), "machine": machine()}
    content = {**about, "bars": [], "tables": tables or {}, **results}
    new = out / ".results.json"
    new.write_text(json.dumps(_plain(content), indent=1, allow_nan=False) + "\n")
    os.replace(new, out / "results.json")
    for name, t in (tables or {}).items():
        print(f"\n{name}\n\n{markdown(t)}")
    for b in content["bars"]:
        print(f"{'ok  ' if b['ok'] else 'MISS'} {b['name']}: {b['value']:.4g} (bar {b['bar']:g})")


def _plain(value: Any) -> Any:
    """What JSON can hold: numpy's numbers and arrays as Python's, no value for what is infinite."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
