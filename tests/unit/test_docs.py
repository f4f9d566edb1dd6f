"""The documentation: how long it is, and whether what it names exists."""

from __future__ import annotations

import argparse
import contextlib
import doctest
import importlib
import io
import os
import re
import runpy
import shlex
import sys
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

ROOT = Path(__file__).parents[2]
LOG = ROOT / "docs" / "research-log"
TOP = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "nets/weights/README.md"]
PAGES = [ROOT / name for name in TOP]
GENERATED = ROOT / "docs" / "benchmarks.md"
PAGES += sorted(p for p in (ROOT / "docs").rglob("*.md") if LOG not in p.parents and p != GENERATED)
ENTRIES = sorted(LOG.glob("2*.md"))
ALL = [*PAGES, GENERATED, *ENTRIES, LOG / "README.md"]

BLOCK = re.compile(r"<!-- (?:table|number): .*?-->.*?<!-- end -->", re.DOTALL)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)")
# What stands for a value in the docs' commands, and a value that argparse takes.
PLACEHOLDERS = {"N": "4", "X,Y,R": "1,2,3", "R,G,B": "1,1,1", "METRES": "0.1", "TARGET": "gltf"}


EXAMPLES = sorted(p for p in (ROOT / "invrender").rglob("*.py") if ">>> " in p.read_text("utf-8"))


def identity(path: Path) -> str:
    return str(path.relative_to(ROOT))


def words(path: Path) -> int:
    """Words of a page as a person writes them: without what the benchmarks fill in."""
    text = re.sub(r"<!--.*?-->", "", BLOCK.sub("", path.read_text("utf-8")), flags=re.DOTALL)
    return sum(bool(re.search(r"\w", word)) for word in text.split())  # not a table's rules


def test_readme_has_at_most_800_words():
    assert len((ROOT / "README.md").read_text("utf-8").split()) <= 800


@pytest.mark.parametrize("page", sorted((ROOT / "docs/explain").glob("*.md")), ids=identity)
def test_explanations_have_at_most_900_words(page):
    assert words(page) <= 900


def test_all_pages_outside_the_log_have_at_most_8000_words():
    model_card = ROOT / "nets/weights/README.md"  # it goes with the weights
    assert sum(words(page) for page in PAGES if page != model_card) <= 8000


def heading_anchors(path: Path) -> set[str]:
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", path.read_text("utf-8")), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", h.lower()) for h in headings)
    return {h.strip().replace(" ", "-") for h in plain}


@pytest.mark.parametrize("page", ALL, ids=identity)
def test_links_lead_somewhere(page):
    for link in LINK.findall(FENCE.sub("", page.read_text("utf-8"))):
        if link.startswith(("http://", "https://")):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in heading_anchors(target), link


def inline(page: Path) -> list[str]:
    return re.findall(r"`([^`\n]+)`", FENCE.sub("", page.read_text("utf-8")))


def commands() -> Iterator[tuple[str, str]]:
    """(page, command) of every command line that the docs show."""
    for page in ALL:
        fenced = [body for kind, body in FENCE.findall(page.read_text("utf-8")) if kind == "sh"]
        lines = [line for body in fenced for line in body.splitlines()] + inline(page)
        for line in lines:
            for part in re.split(r"&&|[|;]", line):
                part = part.split(" #")[0].strip().removeprefix(".venv/bin/")
                part = re.sub(r'^(?:eval )?"?\$\((.*?)\)"?$', r"\1", part)
                if re.match(r"invrender [a-z]|python -m (invrender|nets|benchmarks)\b", part):
                    yield identity(page), part


class Parsed(Exception):
    """Raised once argparse has taken a command line; its argument is the parser."""


def parse(command: str) -> set[str]:
    """Let a command's own argparse read it, and nothing more; returns all options there are.

    Raises SystemExit if argparse refuses the command.
    """
    command = re.sub(r"\$(\w|\{\w\})", "1", command)  # a shell's loop variable
    arguments = [PLACEHOLDERS.get(a, a) for a in shlex.split(command) if a not in ("...", "…")]
    if arguments[0] == "python":
        module, arguments = arguments[2], arguments[3:]
    else:
        module, arguments = "invrender", arguments[1:]
    if module == "benchmarks" and arguments[:1] in ([], ["NAME"]):
        return set()
    parse_args = argparse.ArgumentParser.parse_args

    def only_parse(self, args=None, namespace=None):
        parse_args(self, args, namespace)
        raise Parsed(self)

    with (
        warnings.catch_warnings(action="ignore"),  # runpy's, of modules that are loaded already
        mock.patch.object(argparse.ArgumentParser, "parse_args", only_parse),
        mock.patch.object(sys, "argv", [module, *arguments]),
        pytest.raises(Parsed) as parsed,
    ):
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    return options(parsed.value.args[0])


def options(parser: argparse.ArgumentParser) -> set[str]:
    """All options of a parser and its sub-commands."""
    found = set()
    for action in parser._actions:
        found.update(action.option_strings)
        if isinstance(action, argparse._SubParsersAction):
            found.update(*map(options, action.choices.values()))
    return found


def test_commands_and_options_exist():
    wrong, known = [], {"-c", "--extra-index-url"}  # pip's
    for command, page in sorted({command: page for page, command in commands()}.items()):
        message = io.StringIO()
        try:
            with contextlib.redirect_stderr(message):
                known |= parse(command)
        except SystemExit:
            # An inline mention may leave out what is required, but nothing may be wrong.
            if "arguments are required" not in message.getvalue():
                wrong.append(f"{page}: {command}: {message.getvalue().splitlines()[-1]}")
    for page in ALL:
        named = {code.split()[0] for code in inline(page) if code.startswith("-")}
        wrong += [f"{identity(page)}: {option}" for option in sorted(named - known)]
    assert not wrong, "\n".join(wrong)


def test_modules_and_files_exist():
    wrong = []
    for page in ALL:
        if page.name == "CHANGELOG.md":  # it names what was
            continue
        for code in inline(page):
            name = code.removesuffix("()")
            if re.fullmatch(r"(invrender|nets|benchmarks)(\.\w+)+", name) and "_NAME" not in name:
                found = exists(name)
            elif re.fullmatch(r"(invrender|nets|benchmarks|tests|docs|examples)/[\w./-]*", code):
                found = "NAME" in code or (ROOT / code).exists()
            elif re.match(r"pytest .*tests/", code):
                found = all((ROOT / p).exists() for p in code.split() if p.startswith("tests/"))
            else:
                continue
            if not found:
                wrong.append(f"{identity(page)}: {code}")
    assert not wrong, "\n".join(wrong)


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or something in one."""
    head, *tail = name.split(".")
    thing = importlib.import_module(head)
    for i, part in enumerate(tail):
        if not hasattr(thing, part):
            try:
                importlib.import_module(".".join([head, *tail[: i + 1]]))
            except ImportError:
                return False
        thing = getattr(thing, part)
    return True


@pytest.mark.parametrize("page", ALL, ids=identity)
def test_toml_and_python_blocks_parse(page):
    for kind, body in FENCE.findall(page.read_text("utf-8")):
        if kind == "toml":
            tomllib.loads(body)
        elif kind == "python":
            compile(body, str(page), "exec")


def test_the_guides_rig_is_read(tmp_path):
    from invrender.files.rig_toml import read_rig
    from invrender.rig import Rig

    guide = (ROOT / "docs/guide/capture.md").read_text("utf-8")
    (body,) = [body for kind, body in FENCE.findall(guide) if kind == "toml"]
    (tmp_path / "rig.toml").write_text(body)
    assert read_rig(tmp_path / "rig.toml").rig == Rig()


def test_the_guides_python_runs(tmp_path):
    guide = (ROOT / "docs/guide/python.md").read_text("utf-8")
    names: dict[str, object] = {"__name__": "guide"}
    here = os.getcwd()
    os.chdir(tmp_path)
    try:
        for kind, body in FENCE.findall(guide):
            if kind == "python":
                exec(compile(body, "docs/guide/python.md", "exec"), names)
    finally:
        os.chdir(here)


@pytest.mark.parametrize("entry", ENTRIES, ids=identity)
def test_entries_of_the_log_are_whole(entry):
    text = entry.read_text("utf-8")
    assert re.match(r"\d{4}-\d\d-\d\d-[a-z0-9-]+\.md", entry.name)
    for part in ("Question", "Command", "Result", "Decision"):
        assert f"- **{part}.**" in text, part
    assert (LOG / "README.md").read_text("utf-8").count(f"]({entry.name})") == 1


@pytest.mark.parametrize("page", PAGES, ids=identity)
def test_no_private_terms(page):
    text = FENCE.sub("", page.read_text("utf-8"))
    assert not re.findall(r"\b(told|untold|as usual)\b", text, re.IGNORECASE)


@pytest.mark.parametrize("path", EXAMPLES, ids=identity)
def test_examples_in_docstrings_run(path):
    module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    found = doctest.testmod(module)
    assert found.attempted and not found.failed
