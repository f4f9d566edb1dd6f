"""Write docs/benchmarks.md and the marked tables of README and docs from benchmarks/results.

`python -m benchmarks tables` after new results were put into benchmarks/results: NAME.json is a
run's results.json, NAME.png its plot. ``--check`` writes nothing and fails where a text differs
from what the results say. The marks are described at `benchmarks.common.tables.filled`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from benchmarks.__main__ import names
from benchmarks.common.results import markdown
from benchmarks.common.tables import RESULTS, bars_table, filled, read_results
from invrender.types import InputError

ROOT = Path(__file__).parents[1]
HEAD = """# Benchmarks

This page is generated: `python -m benchmarks tables` writes it from `benchmarks/results`.
Times are medians on the machine that each part names; compare them only within one part.
"""


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--check", action="store_true", help="write nothing, fail where a text differs")
    return p


def page(folder: Path = RESULTS) -> str:
    """docs/benchmarks.md: every committed result with its question, tables, bars and plot."""
    questions = names()
    parts = [HEAD]
    for file in sorted(folder.glob("*.json")):
        results = read_results(file.stem, folder)
        benchmark = results["command"].split()[3]
        parts.append(f"## {file.stem}\n\n{questions[benchmark]}\n")
        version = f"commit {results['commit']}" if results["commit"] else "an earlier version"
        parts.append(f"`{results['command']}`, {version}, {_machine(results['machine'])}.\n")
        if "note" in results:
            parts.append(results["note"] + "\n")
        for name, table in results["tables"].items():
            parts.append(f"**{name}**\n\n{markdown(table)}")
        if results["bars"]:
            parts.append(markdown(bars_table(results["bars"])))
        if (folder / f"{file.stem}.png").is_file():
            parts.append(f"![{file.stem}](../benchmarks/results/{file.stem}.png)\n")
    return "\n".join(parts)


def _machine(machine: dict[str, Any] | None) -> str:
    if machine is None:
        return "on a machine that was not noted"
    versions = ", ".join(f"{k} {v}" for k, v in machine["versions"].items())
    return f"{machine['cpu']}, {machine['cores']} cores, {versions}"


def texts(root: Path = ROOT) -> dict[Path, str]:
    """Every file that holds results, and what should stand in it."""
    new = {root / "docs" / "benchmarks.md": page()}
    for file in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        if file in new:
            continue
        try:
            new[file] = filled(file.read_text("utf-8"))
        except InputError as error:
            raise InputError(f"{file.relative_to(root)}: {error}") from None
    return new


def main(args: argparse.Namespace) -> int:
    try:
        new = texts()
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    stale = [f for f, text in new.items() if not f.is_file() or f.read_text("utf-8") != text]
    if args.check and stale:
        which = ", ".join(str(f.relative_to(ROOT)) for f in stale)
        print(f"run python -m benchmarks tables; these differ from the results: {which}")
        return 1
    for file in [] if args.check else stale:
        file.write_text(new[file], "utf-8")
        print(file.relative_to(ROOT))
    return 0
