"""``invrender pattern``: the light pattern, for a device or for another rig, and the guide."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invrender.cli import arguments

if TYPE_CHECKING:
    from rich.console import Console


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "pattern",
        help="write the light pattern for a display, the capture guide, or optimise a pattern",
        description="Write the light pattern: as an image for the capture's folder (PNG, EXR); as "
        "a page that a tablet's browser shows at its real size (HTML); as a PNG for a display of "
        "known --ppi. The sample looks at the display from below, so that devices must show it "
        "mirrored; the last two are. A PDF is the guide: the rig drawn to scale, and the capture "
        "sheet.",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        help="PNG (sRGB), EXR, HTML, PDF; TOML with --device",
    )
    parser.add_argument("--size", type=int, help="pixels a side of an image (1024)")
    parser.add_argument(
        "--ppi",
        type=float,
        help="pixels an inch of the device: the image, or the page, has the rig's size on it",
    )
    parser.add_argument(
        "--device",
        help="a common tablet by name, e.g. 'iPad Pro 11', for its display's size and --ppi; -o "
        "FILE.toml writes its rig.toml",
    )
    parser.add_argument(
        "--set",
        type=int,
        dest="count",
        metavar="N",
        help="a set of 2, 3, 5 or 8 patterns, one photo under each: pattern_1.png and so on in the "
        "folder that -o names, and pattern.html, which shows one after another",
    )
    parser.add_argument("--mirrored", action="store_true", help="as the device must show it")
    parser.add_argument(
        "--optimise",
        action="store_true",
        help="search for the best pattern of a rig instead of taking the default (about a minute)",
    )
    parser.add_argument("--rig", type=Path, help="rig.toml, for the sizes (the default rig)")
    seed = arguments.whole(0, arguments.GREATEST_SEED)
    parser.add_argument("--seed", type=seed, default=0, help="of the search (0)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the subcommand."""
    from rich.progress import Progress

    from invrender.data.tablets import find_tablet, tablet_rig
    from invrender.files.output import check_output
    from invrender.files.rig_toml import FOUND_IN_PHOTO, read_rig, write_rig
    from invrender.files.write import atomic_path, write_exr, write_png
    from invrender.pattern.default import default_pattern, mirrored
    from invrender.pattern.display import pattern_page, write_display_png
    from invrender.pattern.guide import write_guide
    from invrender.rig import Rig
    from invrender.sampling import resize_pattern
    from invrender.types import InputError

    if args.count is not None:
        return _write_set(args, console)
    suffix = args.out.suffix.lower()
    tablet, others = find_tablet(args.device) if args.device is not None else (None, [])
    if suffix == ".toml" and tablet is None:
        raise InputError("a rig.toml is written for a --device")
    if tablet and (args.rig or args.ppi is not None):
        raise InputError("--device gives what --rig and --ppi would: leave these out")
    if suffix not in (".png", ".exr", ".html", ".pdf", ".toml"):
        raise InputError(f"{args.out}: the pattern is a .png, .exr or .html, the guide a .pdf")
    size = 1024 if args.size is None else args.size
    if not 1 <= size <= 8192:
        raise InputError("the pattern's size must be between 1 and 8192")
    real = suffix == ".html" or args.ppi is not None or (tablet is not None and suffix == ".png")
    if args.ppi is not None and suffix not in (".png", ".html"):
        raise InputError("--ppi is for .png and .html")
    if args.size is not None and (real or suffix == ".pdf"):
        raise InputError("--size is for images without --ppi; real sizes are those of the rig")
    if not args.out.resolve().parent.is_dir():
        raise InputError(f"{args.out.parent} is not a folder")
    check_output(args.out, [args.rig] if args.rig else [], file=True)
    if args.rig and not (args.optimise or real or suffix == ".pdf"):
        raise InputError(
            "--rig is for --optimise, --ppi, .html and .pdf; the default pattern is the same for "
            "all rigs"
        )
    rig = read_rig(args.rig).rig if args.rig else Rig()
    ppi = args.ppi
    if tablet:
        rig, ppi = tablet_rig(tablet), tablet.ppi
        console.print(f"taken as {tablet.name}, {tablet.long} × {tablet.short} pixels")
        if others:
            console.print(f"not as {', '.join(t.name for t in others)}")
    if suffix == ".toml":
        write_rig(args.out, rig, "pattern.png", leave=FOUND_IN_PHOTO | {"fov"})
        console.print(f"wrote {args.out}")
        return 0
    if suffix == ".pdf":
        if args.optimise or args.mirrored:
            raise InputError("the guide has no pattern: leave out --optimise and --mirrored")
        write_guide(args.out, rig)
        console.print(f"wrote {args.out}")
        return 0
    if args.optimise:
        import numpy as np

        from invrender.pattern.design import NAMES, PATTERN_CELLS, design

        compare: dict[str, Any] = {
            "white": np.ones((PATTERN_CELLS, PATTERN_CELLS, 3)),
            "default": resize_pattern(default_pattern(), PATTERN_CELLS),
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
            )
        pattern = found.pattern
    else:
        pattern = default_pattern()
    if suffix == ".html":
        page = pattern_page(pattern, rig.screen_sides, ppi)
        with atomic_path(args.out) as path:
            path.write_text(page, encoding="utf-8")
    elif real:
        write_display_png(args.out, pattern, rig.screen_sides, ppi)
    else:
        image = resize_pattern(pattern, size)
        image = mirrored(image) if args.mirrored else image
        (write_png if suffix == ".png" else write_exr)(args.out, image)
    console.print(f"wrote {args.out}")
    return 0


def _write_set(args: argparse.Namespace, console: Console) -> int:
    """The images of a set for the photos' folder, and the page that shows them."""
    from invrender.data.tablets import find_tablet, tablet_rig
    from invrender.files.output import check_output
    from invrender.files.rig_toml import read_rig
    from invrender.files.write import atomic_path, write_png
    from invrender.pattern.display import pattern_page
    from invrender.pattern.sets import pattern_set
    from invrender.rig import Rig
    from invrender.types import InputError

    if args.optimise or args.mirrored or args.size is not None or args.out.suffix:
        raise InputError("--set writes into a folder, and takes --rig, --device or --ppi alone")
    if args.rig and args.device:
        raise InputError("--device gives what --rig would: leave it out")
    patterns = pattern_set(args.count)
    rig, ppi = read_rig(args.rig).rig if args.rig else Rig(), args.ppi
    if args.device is not None:
        tablet, _ = find_tablet(args.device)
        rig, ppi = tablet_rig(tablet), tablet.ppi
    check_output(args.out, [args.rig] if args.rig else [])
    page = pattern_page(patterns[0], rig.screen_sides, ppi, rest=patterns[1:])
    args.out.mkdir(parents=True, exist_ok=True)
    for i, pattern in enumerate(patterns, 1):
        write_png(args.out / f"pattern_{i}.png", pattern)
    with atomic_path(args.out / "pattern.html") as path:
        path.write_text(page, encoding="utf-8")
    console.print(f"wrote {len(patterns)} patterns and pattern.html to {args.out}")
    return 0
