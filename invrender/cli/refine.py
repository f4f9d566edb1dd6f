"""``invrender refine``: the maps of one capture, of several, or of several photos together."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invrender.cli import arguments

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from rich.console import Console

    from invrender.cli.batch import Outcome


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "refine",
        help="recover the material maps of a capture",
        description="Find the mirror ball in the capture's photo, read the light from it, and "
        "recover the sample's normal, diffuse, roughness and specular maps.",
    )
    parser.add_argument(
        "capture",
        type=arguments.capture,
        nargs="+",
        help="a folder with photo.*, rig.toml and the pattern; 'example' is the one that comes "
        "with invrender. The results of several go to OUT/NAME; those that are there are skipped",
    )
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--size", type=int, default=256, help="pixels a side of the maps (256)")
    parser.add_argument(
        "--init",
        choices=["network", "flat"],
        default="network",
        help="where refinement starts: the network's maps (default), or a flat sample's",
    )
    parser.add_argument(
        "--samples",
        type=arguments.whole(1, arguments.GREATEST_SAMPLES),
        default=64,
        help="samples a pixel of the specular lobe (64)",
    )
    parser.add_argument(
        "--ball",
        type=arguments.ball,
        metavar="X,Y,R",
        help="the ball's centre and radius in photo pixels, if it is not found by itself",
    )
    parser.add_argument(
        "--environment",
        metavar="FILE",
        help="the room's light instead of the ball's: an equirectangular image in the photo's unit "
        "of radiance, or 'none' for a dark room",
    )
    parser.add_argument(
        "--gain",
        type=arguments.gain,
        metavar="R,G,B",
        help="the screen's radiance for white, one number or three, instead of the ball's; with "
        "--environment the photo needs no ball",
    )
    parser.add_argument(
        "--joint",
        action="store_true",
        help="the captures show the same square of one sample (another pattern or room, the sample "
        "turned): one result from all, in the frame of the first",
    )
    parser.add_argument("--workers", type=int, default=1, help="processes for several captures (1)")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask scheduler for several captures (extra cluster)"
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    from invrender.cli.beside import beside, cores

    folders = args.capture
    known = {"ball": args.ball, "environment": _room(args.environment), "gain": args.gain}
    options = {"size": args.size, "init": args.init, "samples": args.samples, **known}
    if len(folders) > 1 and not args.joint:
        return _refine_several(args, folders, options, console)
    # Where all is loaded already there is nothing to do beside finding the lights.
    if "drjit" in sys.modules or cores() == 1 or args.profile:
        return _refine_one(args, folders, options, console)
    from invrender.pipeline import prepare

    with beside() as submit:
        prepared = submit(prepare, folders, known, args.size)
        return _refine_one(args, folders, {**options, "prepared": prepared}, console)


def _refine_one(
    args: argparse.Namespace, folders: list[Path], options: dict[str, Any], console: Console
) -> int:
    from rich.text import Text

    from invrender.pipeline import refine_capture

    with console.status("") as status:
        progress = lambda stage: status.update(Text(f"{stage} …"))  # noqa: E731
        first, *more = folders
        report = refine_capture(first, args.out, more=more, progress=progress, **options)
    if args.json:
        print(json.dumps(report.to_dict()))
        return 0
    total = sum(report.seconds.values())
    slowest = sorted(report.seconds.items(), key=lambda kv: -kv[1])[:4]
    console.print(f"{report.capture} → {args.out} in {total:.1f} s")
    console.print("  " + ", ".join(f"{k} {v:.1f} s" for k, v in slowest))
    error = report.photo_error
    console.print(
        f"  photo error {error['initial']:.4f} → {error['refined']:.4f}"
        f" ({'converged' if report.converged else 'not converged'})",
    )
    if report.map_error is not None:
        for name, before in report.map_error["initial"].items():
            after = report.map_error["refined"][name]
            console.print(f"  {name:>9} error {before:.4f} → {after:.4f}")
    for warning in report.warnings:
        console.print(f"  warning: {warning.text}")
    return 0


def _refine_several(
    args: argparse.Namespace, folders: list[Path], options: dict[str, Any], console: Console
) -> int:
    from rich.console import Console
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
        table.add_row(o.name, o.status, *cells)
    if args.json:
        print(json.dumps([_outcome(o) for o in outcomes]))
    else:
        console.print(table)
    for o in outcomes:
        if o.error:
            Console(stderr=True, markup=False, highlight=False).print(f"{o.name}: {o.error}")
    return 1 if any(o.status == "failed" for o in outcomes) else 0


def _outcome(outcome: Outcome) -> dict[str, Any]:
    report = None if outcome.report is None else outcome.report.to_dict()
    return {**asdict(outcome), "report": report}


def _room(name: str | None) -> NDArray[Any] | None:
    """The environment that the option names; noughts for "none", None without the option."""
    if name is None:
        return None
    if name == "none":
        import numpy as np

        return np.zeros((8, 16, 3), np.float32)
    from invrender.data.environments import read_environment

    return read_environment(Path(name), 256)
