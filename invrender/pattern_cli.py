"""``invrender pattern``: write the light pattern, or optimise one for another rig."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress

from invrender.errors import InputError


def add_parser(commands: Any) -> None:
    """Add the sub-command to argparse's sub-parsers."""
    parser = commands.add_parser(
        "pattern",
        help="write the light pattern for a display, or optimise one",
        description="Write the light pattern as an image. The capture's folder needs it as it is; "
        "the device must show it --mirrored, because the sample looks at the display from below.",
    )
    parser.add_argument("-o", "--out", type=Path, required=True, help="PNG (sRGB) or EXR (linear)")
    parser.add_argument("--size", type=int, default=1024, help="pixels a side (1024)")
    parser.add_argument("--mirrored", action="store_true", help="as the device must show it")
    parser.add_argument(
        "--optimise",
        action="store_true",
        help="search for the best pattern of a rig instead of taking the default (about a minute)",
    )
    parser.add_argument("--rig", type=Path, help="rig.toml of the rig to optimise for (default)")
    parser.add_argument("--seed", type=int, default=0, help="of the search (0)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the sub-command."""
    from invrender.images import write_exr, write_png
    from invrender.pattern import default_pattern, mirrored, resize_pattern
    from invrender.rig import Rig, read_rig

    suffix = args.out.suffix.lower()
    if suffix not in (".png", ".exr"):
        raise InputError(f"{args.out}: the pattern is written as .png or .exr")
    if not 1 <= args.size <= 8192:
        raise InputError("the pattern's size must be between 1 and 8192")
    if args.seed < 0:
        raise InputError("the seed must not be negative")
    if not args.out.resolve().parent.is_dir():
        raise InputError(f"{args.out.parent} is not a folder")
    if args.rig and not args.optimise:
        raise InputError("--rig is for --optimise; the default pattern is the same for all rigs")
    if args.optimise:
        import numpy as np

        from invrender.design import CELLS, NAMES, design

        rig = read_rig(args.rig)[0] if args.rig else Rig()
        compare: dict[str, Any] = {
            "white": np.ones((CELLS, CELLS, 3)),
            "default": resize_pattern(default_pattern(), CELLS),
        }
        with Progress(console=console, transient=True) as bar:
            task = bar.add_task("optimising", total=1.0)
            found = design(
                rig, compare, seed=args.seed, progress=lambda f: bar.update(task, completed=f)
            )
        for name, errors in found.errors.items():
            parts = ", ".join(f"{m} {errors[m]:.4f}" for m in NAMES)
            console.print(
                f"  {name:>9}: expected error {parts}; criterion {errors['criterion']:.3f}",
                highlight=False,
                soft_wrap=True,
            )
        pattern = resize_pattern(found.pattern, args.size)
    else:
        pattern = default_pattern(args.size)
    image = mirrored(pattern) if args.mirrored else pattern
    (write_png if suffix == ".png" else write_exr)(args.out, image)
    console.print(f"wrote {args.out}", highlight=False)
    return 0
