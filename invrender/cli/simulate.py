"""``invrender simulate``: a synthetic capture with its ground truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invrender.cli import arguments

if TYPE_CHECKING:
    from rich.console import Console


LAMP_PHOTOS = 6  # without a tablet


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "simulate",
        help="render a synthetic capture with its ground truth",
        description="Path-trace a whole photograph (sample, mirror ball, table) of a material "
        "under the pattern, and write it as a capture folder.",
    )
    light = arguments.number(0, arguments.LIGHTEST)
    size = arguments.whole(1, arguments.GREATEST_SIDE)
    width = arguments.whole(64, arguments.GREATEST_SIDE)
    seed = arguments.whole(0, arguments.GREATEST_SEED)
    samples = arguments.whole(1, arguments.GREATEST_SAMPLES)
    parser.add_argument("-o", "--out", type=Path, required=True, help="new folder to write")
    parser.add_argument("--maps", type=Path, help="folder with a material's maps")
    parser.add_argument("--kind", help="procedural material instead, e.g. bricks or rusty_metal")
    parser.add_argument("--environment", type=Path, help="equirectangular EXR or HDR file")
    parser.add_argument("--pattern", type=Path, help="pattern image (the default one)")
    parser.add_argument("--irradiance", type=light, default=0.5, help="of the room (0.5)")
    parser.add_argument("--gain", type=light, default=2.0, help="radiance of white (2)")
    parser.add_argument("--size", type=size, default=256, help="pixels a side of the maps (256)")
    parser.add_argument("--width", type=width, default=1280, help="of the photo, pixels (1280)")
    parser.add_argument("--spp", type=samples, default=64, help="path tracer's samples (64)")
    parser.add_argument(
        "--noise", type=arguments.number(0, 1), default=0.005, help="of the sensor (0.005)"
    )
    parser.add_argument("--seed", type=seed, default=0, help="of everything random (0)")
    parser.add_argument(
        "--displaced", action="store_true", help="a surface with heights, not with normals alone"
    )
    real = parser.add_argument_group(
        "real set-ups", "with --device real display, ball, camera and hands are drawn by the seed"
    )
    real.add_argument("--device", choices=("ideal", "real"), default="ideal", help="(ideal)")
    real.add_argument(
        "--exposures", type=int, choices=(1, 2, 3), help="JPEGs of one or more exposures, not EXR"
    )
    real.add_argument("--sheet", action="store_true", help="with the printed capture sheet")
    real.add_argument("--sphere", action="store_true", help="a whole ball")
    real.add_argument("--camera-height", type=float, metavar="METRES", help="above the table")
    alone = parser.add_argument_group("without a tablet")
    alone.add_argument(
        "--no-screen", action="store_true", help="a lamp that is moved about lights the sample"
    )
    alone.add_argument("--photos", type=int, help="so many, each under its own lamp (6)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    from invrender.data.environments import procedural_environment, read_environment
    from invrender.data.materials import procedural_material, read_material
    from invrender.data.simulate import simulate, simulate_real
    from invrender.data.simulate_setup import draw_lamps, draw_setup, without_screen
    from invrender.files.capture import MOST_PHOTOS
    from invrender.files.images import read_image
    from invrender.files.output import check_output
    from invrender.lights import NO_PATTERN
    from invrender.maps import resize_maps
    from invrender.pattern.default import default_pattern
    from invrender.rig import Rig
    from invrender.sphere import scale_environment
    from invrender.types import InputError

    if args.no_screen and (args.pattern or args.exposures not in (None, 1)):
        raise InputError("--no-screen has neither a pattern nor a bracket of exposures")
    if args.photos is not None and not (args.no_screen and 1 <= args.photos <= MOST_PHOTOS):
        raise InputError(f"--photos is for --no-screen, 1 to {MOST_PHOTOS}")
    photos = (args.photos or LAMP_PHOTOS) if args.no_screen else 0
    setup = None
    if args.device == "real":
        setup = draw_setup(
            args.seed,
            {None: "raw", 1: "jpeg"}.get(args.exposures, "bracket"),
            exposures=args.exposures or 2,
            sheet=args.sheet,
            sphere=args.sphere or None,
            camera_height=args.camera_height,
            lamps=photos,
        )
    elif args.exposures or args.sheet or args.sphere or args.camera_height is not None:
        raise InputError(
            "--exposures, --sheet, --sphere and --camera-height belong to --device real"
        )
    given = [path for path in (args.maps, args.environment, args.pattern) if path]
    check_output(args.out, given, megabytes=20e-6 * args.width**2 * max(photos, 1) + 5)
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
    rig = Rig()
    if args.no_screen:
        pattern, rig = NO_PATTERN, without_screen(rig)
    with console.status("path tracing …"):
        quality: dict[str, Any] = {
            "width": args.width, "spp": args.spp, "seed": args.seed, "displaced": args.displaced,
        }  # fmt: skip
        if setup is None:
            simulate(
                args.out, maps, environment, pattern, rig,
                gain=args.gain, noise=args.noise, lamps=draw_lamps(args.seed, photos), **quality,
            )  # fmt: skip
        else:
            simulate_real(args.out, maps, environment, pattern, setup, **quality)
    console.print(f"wrote {args.out}")
    return 0
