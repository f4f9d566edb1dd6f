"""Random faults in the refinement, and whether its tests find them: `python tests/mutants.py COUNT
[SEED]`.

One place of one module of `invrender.refine` at a time is changed: a sum into a difference, a
product into a quotient, a comparison into its opposite, a constant into its double or half, a sign,
a clip left out. Then the module's own unit tests run, on a copy of the repository. A fault that
changes no result cannot be found: the list of those that were missed is to be read.
"""

from __future__ import annotations

import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MODULES = Path("invrender/refine")
TESTS = Path("tests/unit/refine")
OWN = {
    "groups": ("test_groups.py", "test_shared.py"),
    "mirrors": ("test_mirrors.py",),
    "plain": ("test_plain.py",),
    "posterior": ("test_posterior.py",),
    "several": ("test_several.py", "test_refine.py"),
    "shared": ("test_shared.py",),
    "shared_roughness": ("test_several.py",),
    "texture": ("test_texture.py",),
}
REST = ("test_refine.py", "test_posterior.py")  # tests of the other modules
ALL = ("test_fixed_results.py", "test_numbers.py")  # of every module
COPIED = ("invrender", "nets", "benchmarks", "tests", "pyproject.toml")
PATIENCE = 1800.0  # seconds, after which a fault counts as found: the tests hang
OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
}  # fmt: skip
COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.GtE: ast.Lt,
}  # fmt: skip
CLIPS = ("clip", "minimum", "maximum", "min", "max")


def places(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that can be changed; types and what stands in them are none."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.BinOp, ast.AugAssign)):
            known = type(node.op) in OPERATORS
        elif isinstance(node, ast.Compare):
            known = len(node.ops) == 1 and type(node.ops[0]) in COMPARISONS
        elif isinstance(node, ast.UnaryOp):
            known = isinstance(node.op, ast.USub) and not isinstance(node.operand, ast.Constant)
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            known = name in CLIPS and len(node.args) > 1
        else:
            known = isinstance(node, ast.Constant) and isinstance(node.value, float)
            known = known and node.value != 0
        if known:
            yield node


def changed(source: str, which: int, rng: random.Random) -> tuple[str, str]:
    """The module with its which-th place changed, and what was changed."""
    tree = ast.parse(source)
    node = list(places(tree))[which]
    before = ast.unparse(node)
    after: ast.AST = node
    if isinstance(node, (ast.BinOp, ast.AugAssign)):
        node.op = OPERATORS[type(node.op)]()
    elif isinstance(node, ast.Compare):
        node.ops = [COMPARISONS[type(node.ops[0])]()]
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd()
    elif isinstance(node, ast.Constant):
        node.value *= rng.choice((0.5, 2.0))
    elif isinstance(node, ast.Call):
        after = node.args[0]
        for parent in ast.walk(tree):
            for name, value in ast.iter_fields(parent):
                if value is node:
                    setattr(parent, name, after)
                elif isinstance(value, list):
                    value[:] = [after if v is node else v for v in value]
    return ast.unparse(tree), f"line {getattr(node, 'lineno', 0)}: {before} → {ast.unparse(after)}"


def found(copy: Path, module: str) -> bool:
    """Whether a test of a module fails."""
    files = [str(TESTS / name) for name in (*ALL, *OWN.get(module, REST))]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *files]
    environment = {**os.environ, "PYTHONPATH": str(copy)}
    try:
        return subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, timeout=PATIENCE
        ).returncode != 0  # fmt: skip
    except subprocess.TimeoutExpired:
        return True


def main(count: int, seed: int) -> int:
    rng = random.Random(seed)
    sources = {p: p.read_text() for p in sorted((ROOT / MODULES).glob("*.py"))}
    pool = [(p, i) for p, text in sources.items() for i, _ in enumerate(places(ast.parse(text)))]
    print(f"{len(pool)} places, seed {seed}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in COPIED:
            take = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            take(ROOT / name, copy / name)
        if any(found(copy, module) for module in (*OWN, "")):
            print("the tests fail without any fault")
            return 1
        caught = 0
        for path, which in rng.sample(pool, count):
            text, what = changed(sources[path], which, rng)
            place = copy / path.relative_to(ROOT)
            place.write_text(text)
            began = time.monotonic()
            is_found = found(copy, path.stem)
            place.write_text(sources[path])
            caught += is_found
            seconds = time.monotonic() - began
            print(f"{'found' if is_found else 'MISSED'} {path.stem}, {what} ({seconds:.0f} s)",
                  flush=True)  # fmt: skip
    print(f"{caught} of {count} found")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
