"""The command line: a module a subcommand, which loads what it needs when it runs.

Results and JSON go to standard output, everything else to standard error, in colour on terminals
only. Exit codes: 0 done; 1 some of several captures failed, or ``doctor`` found a fault; 2 bad
input; 130 interrupted; 141 whoever reads the output has closed it.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import NoReturn

from invrender.cli import app, compare, doctor, export, inspect, pattern, refine, simulate
from invrender.cli.beside import cores

COMMANDS = (app, refine, simulate, pattern, inspect, compare, export, doctor)
SHELLS = ("bash", "zsh", "tcsh")  # shtab's


def run(*argv: str) -> NoReturn:
    """Run a command, with the arguments of the process where none are given, and end the process.

    At once: to take PyTorch and LLVM apart takes some tenths of a second, in which nothing is done
    for anybody. What must end in order (files, other processes) has ended when `main` returns.
    """
    code = main(argv or None)
    with suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code, see the module."""
    # Threads of torch that wait for each other sleep: where other processes want the processors,
    # turning in circles takes twelve times the time.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # The networks are asked at two sizes at once. On two processors a thread for each takes 0.9 s
    # of a photo at 256², two threads one after the other 1.5 s.
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores() // 2)))
    try:
        code = _run(_parser().parse_args(argv))
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # What is left in the buffers would be tried again, and told, at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _run(args: argparse.Namespace) -> int:
    from rich.console import Console

    from invrender.cli.trace import traced
    from invrender.types import InputError

    # Paths and names are printed as they are: nothing that a person typed is markup.
    plain = {"stderr": True, "markup": False, "highlight": False, "emoji": False}
    console = Console(**plain, quiet=args.quiet, soft_wrap=True)  # type: ignore[arg-type]
    errors = Console(**plain, soft_wrap=True)  # type: ignore[arg-type]
    _log(args.verbose)
    try:
        with traced(args.profile) if args.profile else nullcontext():
            return int(args.run(args, console))
    except InputError as error:
        errors.print(f"invrender: {error}")
        return 2
    except KeyboardInterrupt as stop:
        errors.print(f"invrender: {str(stop) or 'interrupted, nothing was written'}")
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="invrender",
        description="One photo under a tablet's light pattern in, relightable material maps out.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        command.add_parser(commands)
    completion = commands.add_parser(
        "completion",
        help="print a shell's completion script",
        description="Print a completion script; for bash: "
        'eval "$(invrender completion bash)" in ~/.bashrc',
    )
    completion.add_argument("shell", choices=SHELLS)
    completion.set_defaults(run=lambda args, console: _complete(parser, args.shell))
    for added in commands.choices.values():
        added.add_argument(
            "--profile", type=Path, metavar="FILE",
            help="write what the time went into, for https://ui.perfetto.dev; in one process",
        )  # fmt: skip
        loudness = added.add_mutually_exclusive_group()
        loudness.add_argument("-q", "--quiet", action="store_true", help="print only errors")
        loudness.add_argument("-v", "--verbose", action="store_true", help="tell every step")
    return parser


def _complete(parser: argparse.ArgumentParser, shell: str) -> int:
    import shtab

    print(shtab.complete(parser, shell))
    return 0


def _log(verbose: bool) -> None:
    """Warnings of the log "invrender", or all of it, to standard error."""
    import logging

    from rich.console import Console
    from rich.logging import RichHandler

    log = logging.getLogger("invrender")
    log.handlers[:] = [RichHandler(console=Console(stderr=True), show_path=False, show_time=False)]
    log.setLevel(logging.INFO if verbose else logging.WARNING)


if __name__ == "__main__":
    sys.exit(main())
