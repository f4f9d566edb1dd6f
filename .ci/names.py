"""Counts names with two meanings and numbers without a name; fails where there are too many.

- Constants: a name in capitals that two modules of the packages define. Whoever needs another
  module's constant imports it.
- Numbers: floats written inside functions between photo and maps. 0, 0.5, 1 and 2, defaults of
  parameters (the parameter is their name) and integers do not count.
"""

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

SHARED_CONSTANTS = 0  # names
UNNAMED_FLOATS = 40  # at most

ROOT = Path(__file__).parents[1]
PACKAGES = ("invrender", "nets")
PHOTO_TO_MAPS = ("invrender/capture", "invrender/refine", "invrender/sampling.py", "nets")
NOT_PHOTO_TO_MAPS = ("nets/training",)
PLAIN = (0.0, 0.5, 1.0, 2.0)


def modules(parts: tuple[str, ...]) -> Iterator[tuple[str, ast.Module]]:
    """Path and syntax tree of each module in folders, or of single files."""
    for part in parts:
        for path in sorted((ROOT / part).rglob("*.py")) or [ROOT / part]:
            yield str(path.relative_to(ROOT)), ast.parse(path.read_text(encoding="utf-8"))


def constants(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Names in capitals that a module assigns at its top, and their lines."""
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            for name in names:
                if isinstance(name, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]+", name.id):
                    yield name.id, name.lineno


def unnamed_floats(tree: ast.AST) -> Iterator[tuple[float, int]]:
    """Floats in the bodies of functions, and their lines."""
    seen = set()
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.Lambda):
            body = function.body if isinstance(function.body, list) else [function.body]
            for node in (n for statement in body for n in floats(statement)):
                if id(node) not in seen:
                    seen.add(id(node))
                    yield node.value, node.lineno


def floats(tree: ast.AST) -> Iterator[ast.Constant]:
    """The float constants below a node that count, but for parameters' defaults."""
    if isinstance(tree, ast.arguments):
        return
    if isinstance(tree, ast.Constant) and type(tree.value) is float and tree.value not in PLAIN:
        yield tree
    for child in ast.iter_child_nodes(tree):
        yield from floats(child)


def main() -> int:
    """Print both lists and counts; 1 where a count is above its ceiling."""
    homes: dict[str, list[str]] = defaultdict(list)
    for path, tree in modules(PACKAGES):
        for name, line in constants(tree):
            homes[name].append(f"{path}:{line}")
    shared = {name: places for name, places in sorted(homes.items()) if len(places) > 1}
    for name, places in shared.items():
        print(f"{name}: {' '.join(places)}")
    numbers = [
        f"{path}:{line}: {value:g}"
        for path, tree in modules(PHOTO_TO_MAPS)
        if not path.startswith(NOT_PHOTO_TO_MAPS)
        for value, line in sorted(unnamed_floats(tree), key=lambda found: found[1])
    ]
    print(*numbers, sep="\n")
    print(f"{len(shared)} constants' names in several modules, at most {SHARED_CONSTANTS}")
    print(f"{len(numbers)} unnamed floats between photo and maps, at most {UNNAMED_FLOATS}")
    return int(len(shared) > SHARED_CONSTANTS or len(numbers) > UNNAMED_FLOATS)


if __name__ == "__main__":
    sys.exit(main())
