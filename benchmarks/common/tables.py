"""Tables of results in Markdown, and the marked blocks of the docs that hold them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from benchmarks.common.results import Table, markdown, table
from invrender.data.simulate_setup import ranges_table
from invrender.types import InputError

# Tables that the code holds, by "NAME/TABLE" as `filled` reads it: (header, rows).
OF_THE_CODE = {"simulate/ranges": ranges_table}
RESULTS = Path(__file__).parents[1] / "results"
BLOCK = re.compile(r"<!-- (table|number): (.*?) -->(.*?)<!-- end -->", re.DOTALL)
MARK = re.compile(r"<!-- (?:table|number): .*?-->")


def bars_table(bars: list[dict[str, Any]]) -> Table:
    """Measured values beside their bars."""
    rows = [[b["name"], b["value"], b["bar"], "yes" if b["ok"] else "**no**"] for b in bars]
    return {"header": ["", "measured", "bar", "reached"], "rows": rows}


def read_results(name: str, folder: Path = RESULTS) -> dict[str, Any]:
    """The committed results ``folder``/NAME.json. Raises `InputError` where there are none."""
    try:
        return dict(json.loads((folder / f"{name}.json").read_text("utf-8")))
    except FileNotFoundError:
        known = ", ".join(sorted(p.stem for p in folder.glob("*.json")))
        raise InputError(f"there are no results {name!r}; there are: {known}") from None


def look_up(path: str, folder: Path = RESULTS) -> Any:
    """What stands in the results at "NAME/key/key": dictionaries by key, lists by index or, where
    they hold dictionaries with a ``name`` (as ``bars`` does), by that. Raises `InputError`."""
    name, *keys = path.split("/")
    value: Any = read_results(name, folder)
    for key in keys:
        if isinstance(value, list):
            named = {item["name"]: item for item in value if isinstance(item, dict)}
            value = named or {str(i): item for i, item in enumerate(value)}
        if not isinstance(value, dict) or key not in value:
            known = ", ".join(value) if isinstance(value, dict) else "nothing"
            raise InputError(f"{path}: there is no {key!r}; there is: {known}")
        value = value[key]
    return value


def filled(text: str, folder: Path = RESULTS) -> str:
    """The text with every marked block's content made anew from the results.

    ``<!-- table: NAME/TABLE -->`` up to ``<!-- end -->`` holds a table of ``tables``, or with
    ``NAME/bars`` the bars, or one of `OF_THE_CODE`; ``<!-- number: FORMAT
    NAME/key/key -->`` a number, inline, for example
    ``<!-- number: .0% refine/summaries/photographs/network/improved -->``. Raises
    `InputError` for a block that names nothing, or that does not end.
    """

    def content(match: re.Match[str]) -> str:
        kind, argument = match[1], match[2].strip()
        start = f"<!-- {kind}: {argument} -->"
        if MARK.search(match[3]):
            raise InputError(f"{start} has no <!-- end -->")
        if kind == "number":
            form, _, path = argument.partition(" ")
            value = look_up(path, folder)
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise InputError(f"{start}: {path} is no number")
            try:
                return f"{start}{value:{form}}<!-- end -->"
            except ValueError:
                raise InputError(f"{start}: {form!r} is no format of a number") from None
        name, _, which = argument.partition("/")
        if argument in OF_THE_CODE:
            found = table(*OF_THE_CODE[argument]())
        elif which == "bars":
            found = bars_table(read_results(name, folder)["bars"])
        else:
            found = look_up(f"{name}/tables/{which}", folder)
        return f"{start}\n{markdown(found)}<!-- end -->"

    new = BLOCK.sub(content, text)
    if left := MARK.search(BLOCK.sub("", text)):
        raise InputError(f"{left[0]} has no <!-- end -->")
    return new
