"""The command line; its sub-commands are in the modules whose names end in ``_cli``.

Results and JSON go to standard output, everything else to standard error, in colour on terminals
only. Exit codes: 0 done; 1 some of several captures failed, or ``doctor`` found a fault; 2 bad
input; 130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import shtab
from numpy.typing import NDArray
from rich.console import Console
from rich.logging import RichHandler
from rich.markup import escape

from invrender.cli import compare as compare_cli
from invrender.cli import doctor
from invrender.cli import export as export_cli
from invrender.cli import inspect as inspect_cli
from invrender.cli import pattern as pattern_cli
from invrender.types import InputError

EXAMPLE = Path(__file__).parents[1] / "data" / "example"


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code, see the module."""
    parser = _parser()
    args = parser.parse_args(argv)
    console = Console(stderr=True, quiet=args.quiet)
    _log(args.verbose)
    try:
        return int(args.run(args, console))
    except InputError as error:
        Console(stderr=True).print(f"invrender: {error}", markup=False, highlight=False)
        return 2
    except KeyboardInterrupt as stop:
        text = str(stop) or "interrupted, nothing was written"
        Console(stderr=True).print(f"invrender: {text}", markup=False, highlight=False)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="invrender",
        description="One photo under a tablet's light pattern in, relightable material maps out.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    refine = commands.add_parser(
        "refine",
        help="recover the material maps of a capture",
        description="Find the mirror ball in the capture's photo, read the light from it, and "
        "recover the sample's normal, diffuse, roughness and specular maps.",
    )
    refine.add_argument(
        "capture",
        type=Path,
        nargs="+",
        help="a folder with photo.*, rig.toml and the pattern; 'example' is the one that comes "
        "with invrender. The results of several go to OUT/NAME; those that are there are skipped",
    )
    refine.add_argument("-o", "--out", type=Path, required=True, help="folder for the results")
    refine.add_argument("--size", type=int, default=256, help="pixels a side of the maps (256)")
    refine.add_argument(
        "--init",
        choices=["network", "flat"],
        default="network",
        help="where refinement starts: the network's maps (default), or flat, which needs no torch",
    )
    refine.add_argument(
        "--samples", type=int, default=64, help="samples a pixel of the specular lobe (64)"
    )
    refine.add_argument(
        "--ball",
        type=_ball,
        metavar="X,Y,R",
        help="the ball's centre and radius in photo pixels, if it is not found by itself",
    )
    refine.add_argument(
        "--environment",
        metavar="FILE",
        help="the room's light instead of the ball's: an equirectangular image in the photo's unit "
        "of radiance, or 'none' for a dark room",
    )
    refine.add_argument(
        "--gain",
        type=_gain,
        metavar="R,G,B",
        help="the screen's radiance for white, one number or three, instead of the ball's; with "
        "--environment the photo needs no ball",
    )
    refine.add_argument(
        "--joint",
        action="store_true",
        help="the captures show the same square of one sample (another pattern or room, the sample "
        "turned by quarters): one result from all, in the frame of the first",
    )
    refine.add_argument("--workers", type=int, default=1, help="processes for several captures (1)")
    refine.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask scheduler for several captures (extra cluster)"
    )
    refine.add_argument("--json", action="store_true", help="print the report as JSON")
    refine.set_defaults(run=_refine)

    simulate = commands.add_parser(
        "simulate",
        help="render a synthetic capture with its ground truth",
        description="Path-trace a whole photograph (sample, mirror ball, table) of a material "
        "under the pattern, and write it as a capture folder.",
    )
    simulate.add_argument("-o", "--out", type=Path, required=True, help="new folder to write")
    simulate.add_argument("--maps", type=Path, help="folder with a material's maps")
    simulate.add_argument("--kind", help="procedural material instead, e.g. bricks or rust")
    simulate.add_argument("--environment", type=Path, help="equirectangular EXR or HDR file")
    simulate.add_argument("--pattern", type=Path, help="pattern image (the default one)")
    simulate.add_argument("--irradiance", type=float, default=0.5, help="of the room (0.5)")
    simulate.add_argument("--gain", type=float, default=2.0, help="radiance of white (2)")
    simulate.add_argument("--size", type=int, default=256, help="pixels a side of the maps (256)")
    simulate.add_argument("--width", type=int, default=1280, help="of the photo, pixels (1280)")
    simulate.add_argument("--spp", type=int, default=64, help="path tracer's samples (64)")
    simulate.add_argument("--noise", type=float, default=0.005, help="of the sensor (0.005)")
    simulate.add_argument("--seed", type=int, default=0, help="of everything random (0)")
    simulate.set_defaults(run=_simulate)

    pattern_cli.add_parser(commands)
    inspect_cli.add_parser(commands, _ball)
    compare_cli.add_parser(commands)
    export_cli.add_parser(commands)
    doctor.add_parser(commands)
    completion = commands.add_parser(
        "completion",
        help="print a shell's completion script",
        description="Print a completion script; for bash: "
        'eval "$(invrender completion bash)" in ~/.bashrc',
    )
    completion.add_argument("shell", choices=shtab.SUPPORTED_SHELLS)
    completion.set_defaults(
        run=lambda args, console: print(shtab.complete(parser, args.shell)) or 0
    )
    for command in commands.choices.values():
        loudness = command.add_mutually_exclusive_group()
        loudness.add_argument("-q", "--quiet", action="store_true", help="print only errors")
        loudness.add_argument("-v", "--verbose", action="store_true", help="tell every step")
    return parser


def _log(verbose: bool) -> None:
    """Warnings of the log "invrender", or all of it, to standard error."""
    log = logging.getLogger("invrender")
    log.handlers[:] = [RichHandler(console=Console(stderr=True), show_path=False, show_time=False)]
    log.setLevel(logging.INFO if verbose else logging.WARNING)


def _ball(text: str) -> tuple[float, float, float]:
    try:
        x, y, r = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError("expected three numbers: X,Y,R") from None
    return x, y, r


def _gain(text: str) -> tuple[float, ...]:
    try:
        values = tuple(float(v) for v in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (1, 3) or not all(0 < v < math.inf for v in values):
        raise argparse.ArgumentTypeError("expected one or three positive numbers: R,G,B")
    return values


def _refine(args: argparse.Namespace, console: Console) -> int:
    from invrender.pipeline import refine_capture

    folders = [EXAMPLE if str(c) == "example" else c for c in args.capture]
    options = {
        "size": args.size, "init": args.init, "samples": args.samples, "ball": args.ball,
        "environment": _room(args.environment), "gain": args.gain,
    }  # fmt: skip
    if len(folders) > 1 and not args.joint:
        return _refine_several(args, folders, options, console)
    with console.status("") as status:
        progress = lambda stage: status.update(f"{stage} …")  # noqa: E731
        first, *more = folders
        report = refine_capture(first, args.out, more=more, progress=progress, **options)
    if args.json:
        print(json.dumps(report.__dict__))
        return 0
    total = sum(report.seconds.values())
    slowest = sorted(report.seconds.items(), key=lambda kv: -kv[1])[:4]
    console.print(f"{report.capture} → {args.out} in {total:.1f} s", highlight=False)
    console.print("  " + ", ".join(f"{k} {v:.1f} s" for k, v in slowest), highlight=False)
    error = report.photo_error
    console.print(
        f"  photo error {error['initial']:.4f} → {error['refined']:.4f}"
        f" ({'converged' if report.converged else 'not converged'})",
        highlight=False,
    )
    if report.map_error is not None:
        for name, before in report.map_error["initial"].items():
            after = report.map_error["refined"][name]
            console.print(f"  {name:>9} error {before:.4f} → {after:.4f}", highlight=False)
    for warning in report.warnings:
        console.print(f"  warning: {warning}", markup=False, highlight=False)
    return 0


def _refine_several(
    args: argparse.Namespace, folders: list[Path], options: dict[str, Any], console: Console
) -> int:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Table

    from invrender.cli.batch import refine_captures

    last = TextColumn("{task.fields[last]}", markup=False)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), last)
    outcomes = []
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=len(folders), last="")
        for outcome in refine_captures(
            folders, args.out, scheduler=args.scheduler, workers=args.workers, **options
        ):
            outcomes.append(outcome)
            bar.update(task, advance=1, last=f"{outcome.name} {outcome.status}")
    outcomes.sort(key=lambda o: o.name)
    table = Table("capture", "", "seconds", "photo error", "map error")
    for o in outcomes:
        cells = ["", "", ""]
        if o.report is not None:
            before, after = (o.report.photo_error[k] for k in ("initial", "refined"))
            error = o.report.map_error
            cells = [
                f"{sum(o.report.seconds.values()):.1f}", f"{before:.4f} → {after:.4f}",
                f"{error['refined']['average']:.4f}" if error else "",
            ]  # fmt: skip
        table.add_row(escape(o.name), o.status, *cells)
    if args.json:
        print(json.dumps([asdict(o) for o in outcomes]))
    else:
        console.print(table)
    for o in outcomes:
        if o.error:
            Console(stderr=True).print(f"{o.name}: {o.error}", markup=False, highlight=False)
    return 1 if any(o.status == "failed" for o in outcomes) else 0


def _room(name: str | None) -> NDArray[np.floating[Any]] | None:
    """The environment that the option names; noughts for "none", None without the option."""
    if name is None:
        return None
    if name == "none":
        return np.zeros((8, 16, 3), np.float32)
    from invrender.data.environments import read_environment

    return read_environment(Path(name), 256)


def _simulate(args: argparse.Namespace, console: Console) -> int:
    from invrender.data.environments import procedural_environment, read_environment
    from invrender.data.materials import procedural_material, read_material
    from invrender.data.simulate import simulate
    from invrender.files.images import read_image
    from invrender.maps import resize_maps
    from invrender.pattern.default import default_pattern
    from invrender.rig import Rig
    from invrender.sphere import scale_environment

    if args.size < 1 or args.width < 64 or args.spp < 1:
        raise InputError("sizes and sample counts must be positive, the photo 64 pixels or wider")
    if args.maps:
        maps = resize_maps(read_material(args.maps), args.size, args.size)
    else:
        maps = procedural_material(args.seed, args.size, args.size, kind=args.kind)
    if args.environment:
        environment = read_environment(args.environment, 256)
    else:
        environment = procedural_environment(args.seed, 256)
    environment = scale_environment(environment, args.irradiance)
    pattern = read_image(args.pattern) if args.pattern else default_pattern()
    with console.status("path tracing …"):
        simulate(
            args.out, maps, environment, pattern, Rig(),
            gain=args.gain, width=args.width, spp=args.spp, noise=args.noise, seed=args.seed,
        )  # fmt: skip
    console.print(f"wrote {args.out}", highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
