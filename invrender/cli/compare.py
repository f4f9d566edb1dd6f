"""``invrender compare``: how far one result, set of maps or image is from another."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "compare",
        help="measure how far a result, maps or an image are from a reference",
        description="Compare two folders of maps (results of refine, or captures with ground "
        "truth) or two images of one size: RMSE, PSNR, SSIM and FLIP. Of maps, the metrics "
        "are of the maps and of nine images relit by point lights.",
    )
    parser.add_argument("a", type=Path, metavar="A", help="folder or image")
    parser.add_argument("b", type=Path, metavar="B", help="the reference, of the same kind")
    parser.add_argument("--json", action="store_true", help="print the metrics as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the subcommand."""
    from invrender.report.metrics import FLIP_MISSING, map_metrics
    from invrender.types import InputError

    for path in (args.a, args.b):
        if not path.exists():
            raise InputError(f"{path} does not exist")
    if args.a.is_dir() != args.b.is_dir():
        raise InputError("compare two folders of maps, or two images, not one of each")
    notes: list[str] = []
    if args.a.is_dir():
        (maps, rig_a), (truth, rig_b) = (_maps(path) for path in (args.a, args.b))
        maps, truth, note = _same_size(maps, truth)
        notes += [note] if note else []
        table = map_metrics(maps, truth, rig_b or rig_a)
    else:
        table = {"image": _images(args.a, args.b)}
    if all(group.get("flip") is None for group in table.values()):
        notes.append(FLIP_MISSING)
    if args.json:
        print(json.dumps({**table, "notes": notes}))
        return 0
    for title, group in table.items():
        print(title)
        for name, value in group.items():
            print(f"  {name:>9}  {'-' if value is None else format(value, '.4f')}")
    for note in notes:
        console.print(f"  {note}")
    return 0


def _maps(folder: Path) -> tuple[Any, Any]:
    """(Maps, its rig or None) of a folder of maps, or of a capture with ground truth."""
    from invrender.files.capture import load_capture
    from invrender.files.maps import read_maps
    from invrender.files.rig_toml import read_rig
    from invrender.types import InputError

    rig = folder / "rig.toml"
    if (folder / "normal.exr").is_file() or not rig.is_file():
        return read_maps(folder), read_rig(rig).rig if rig.is_file() else None
    capture = load_capture(folder)
    if capture.truth is None:
        raise InputError(f"{folder} is a capture without ground truth: there are no maps in it")
    return capture.truth, capture.rig


def _same_size(a: Any, b: Any) -> tuple[Any, Any, str]:
    """Two sets of maps of one shape at the smaller one's size, and what was done to get there."""
    from invrender.maps import resize_maps

    (height_a, width_a), (height_b, width_b) = a.shape, b.shape
    if a.shape == b.shape or height_a * width_b != height_b * width_a:
        return a, b, ""
    height, width = min(a.shape, b.shape)
    note = f"the larger maps were averaged down to {width} × {height} pixels"
    return resize_maps(a, height, width), resize_maps(b, height, width), note


def _images(a: Path, b: Path) -> dict[str, float | None]:
    """Metrics of two files: linear radiance if either is an EXR or HDR, else as displayed."""
    from invrender.files.images import read_image
    from invrender.report.metrics import image_metrics

    hdr = any(path.suffix.lower() in (".exr", ".hdr", ".pic") for path in (a, b))
    # Display values are compared as they are stored.
    return image_metrics(*(read_image(p, linear=not hdr) for p in (a, b)), hdr=hdr)
