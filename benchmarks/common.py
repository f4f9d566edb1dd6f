"""What every benchmark writes: a table, and results with the machine and versions behind them."""

from __future__ import annotations

import csv
import json
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Processor, cores and versions: a number means nothing without them."""
    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        processor = names[0].split(":")[1].strip() if names else processor
    versions = {}
    for name in ("invrender", "drjit", "mitsuba", "numpy", "torch"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": versions,
    }


def save_results(
    out: Path, name: str, rows: list[dict[str, Any]], bars: list[dict[str, Any]], **more: Any
) -> None:
    """Write ``name.csv`` and ``results.json``, and print the bars."""
    out.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with open(out / f"{name}.csv", "w", newline="") as f:
        writer = csv.DictWriter(f, columns)
        writer.writeheader()
        writer.writerows(rows)
    results = {"benchmark": name, "bars": bars, "machine": machine(), "rows": rows, **more}
    (out / "results.json").write_text(json.dumps(results, indent=2, default=float) + "\n")
    for bar in bars:
        mark = "ok" if bar["ok"] else "MISSED"
        print(f"{mark:>6}  {bar['name']}: {bar['value']:.4g} (bar {bar['bar']:g})")
