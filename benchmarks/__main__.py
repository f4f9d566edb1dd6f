"""`python -m benchmarks`: the list of benchmarks; `python -m benchmarks NAME ...`: run one."""

from __future__ import annotations

import ast
import sys
from importlib import import_module
from pathlib import Path


def names() -> dict[str, str]:
    """Every benchmark's name and the first line of its docstring, found without importing it."""
    files = sorted(Path(__file__).parent.glob("[!_]*.py"))
    docs = {file.stem: ast.get_docstring(ast.parse(file.read_text("utf-8"))) for file in files}
    return {name: (doc or "").split("\n")[0] for name, doc in docs.items()}


def main(arguments: list[str]) -> int:
    """Run the named benchmark with the rest of the arguments; without a name, list them all."""
    known = names()
    if not arguments or arguments[0] in ("-h", "--help"):
        print("python -m benchmarks NAME [--quick] --out DIR [...]; NAME --help tells more.\n")
        print("\n".join(f"{name:18}{question}" for name, question in known.items()))
        return 0
    name, *rest = arguments
    if name not in known:
        print(f"there is no benchmark {name!r}: python -m benchmarks lists them", file=sys.stderr)
        return 2
    module = import_module(f"benchmarks.{name}")
    parser = module.parser()
    parser.prog = f"python -m benchmarks {name}"
    return module.main(parser.parse_args(rest)) or 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
