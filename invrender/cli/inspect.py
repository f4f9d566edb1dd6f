"""``invrender inspect``: what is found in a photo, before anything is recovered from it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from invrender.cli import arguments

if TYPE_CHECKING:
    from rich.console import Console

PICTURE_MEGABYTES = 10  # of the picture and the lights


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "inspect",
        help="show what is found in a photo: ball, screen, sample, lights",
        description="Find the mirror ball and read the lights as 'refine' does, and say how sure "
        "that is. A lone photo is taken with the default rig and pattern.",
    )
    parser.add_argument(
        "capture", type=arguments.capture, help="a capture's folder, or a photo alone"
    )
    parser.add_argument("-o", "--out", type=Path, help="folder for inspect.png and the lights")
    parser.add_argument(
        "--ball",
        type=arguments.ball,
        metavar="X,Y,R",
        help="the ball's centre and radius in photo pixels",
    )
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the subcommand."""
    import numpy as np

    from invrender.cli.beside import load
    from invrender.files.capture import Capture, check_photo, holds_set, load_capture
    from invrender.files.images import read_photo
    from invrender.files.output import check_output
    from invrender.files.rig_toml import FOUND_IN_PHOTO
    from invrender.files.write import atomic_path, write_exr
    from invrender.pattern.default import default_pattern
    from invrender.rig import Rig

    if args.out is not None:
        check_output(args.out, [args.capture], megabytes=PICTURE_MEGABYTES)
    if args.capture.is_dir() and holds_set(args.capture):
        return _inspect_set(args, console)
    load("invrender.capture.lights", "invrender.report.inspection")
    if args.capture.is_dir():
        capture = load_capture(args.capture)
    else:
        photo = read_photo(args.capture)
        check_photo(photo, str(args.capture))
        rig = Rig() if photo.fov is None else Rig(fov=photo.fov)
        capture = Capture(
            photo,
            rig,
            default_pattern(),
            fov_from="rig" if photo.fov is None else "exif",
            warnings=photo.warnings,
            unknown=FOUND_IN_PHOTO,
        )
    from invrender.capture.lights import find_lights
    from invrender.report.inspection import annotate, camera_place, summary

    nominal = capture.rig
    found = find_lights(capture, ball=args.ball)
    capture, ball, lights = found.capture, found.ball, found.lights
    assert ball is not None and lights.coverage is not None
    numbers = summary(found)
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        with atomic_path(args.out / "inspect.png") as path:
            annotate(found).save(path, format="PNG", compress_level=1)
        write_exr(args.out / "environment.exr", lights.environment)
        write_exr(args.out / "coverage.exr", lights.coverage)
        if lights.pattern_captured is not None:
            write_exr(args.out / "pattern_captured.exr", lights.pattern_captured)
    if args.json:
        print(json.dumps(numbers))
        return 0
    x, y = ball.centre
    gain = ", ".join(f"{g:.3g}" for g in lights.gain)
    fit = lights.fit
    by = {"rig": "as the rig says", "exif": "by EXIF", "sheet": "by the capture sheet"}
    known, sheet = numbers["deviations"], found.sheet

    def within(name: str, unit: str = "°", scale: float = 1.0) -> str:
        value = known[name]
        return "" if not value else f" ± {scale * value:.2g}{unit}"

    gained = "paper_gain" if fit.get("gain_by_paper") else "gain"
    camera = camera_place(nominal, capture.rig)
    if sheet is not None:
        camera += f", by {len(sheet.ids)} of the sheet's markers{within('camera_tilt')}"
    elif capture.rig.camera_shift != nominal.camera_shift:
        camera += ", by the sample's square"
    lines = [
        f"photo   {capture.photo.width} × {capture.photo.height} pixels, field of view "
        f"{numbers['fov']:.1f}{within('fov') or '°'} {by.get(capture.fov_from, 'by the ball')}",
        f"camera  {camera}",
        f"ball    {lights.rig.ball_shape} at {x:.1f}, {y:.1f}, radius {ball.radius:.1f} pixels, "
        + ("given by hand" if args.ball else f"confidence {ball.confidence:.2f}")
        + f"; reflects {np.mean(lights.rig.ball_reflectance):.0%}"
        + within("ball_reflectance", " % of that", 100),
    ]
    room = f"{numbers['coverage']:.0%} of the sky seen, {numbers['room_saturated']:.1%} of it "
    room += "saturated"
    if lights.rig.has_screen:
        lines.append(
            f"screen  radiance of white {gain}{within(gained, '%', 100)}; pattern fits to "
            f"{fit['residual']:.1%}, display's gamma {fit['gamma']:.2f}, {fit['saturated']:.0%} "
            "saturated"
        )
        room += f"; the pattern gives {numbers['pattern_share']:.0%} of the light on the sample"
    lines.append(f"room    {room}")
    if "paper_gain" in fit:
        lines.append(
            f"paper   {fit['paper_gain']:.2f} times the light that the ball explains"
            + within("paper_gain", "%", 100)
        )
    for line in lines:
        console.print(line)
    for warning in numbers["warnings"]:
        console.print(f"warning: {warning['text']}")
    for said in numbers["advice"]:
        console.print(f"next time: {said['text']}")
    return 0


def _inspect_set(args: argparse.Namespace, console: Console) -> int:
    """What each photo of a set shows, a line each; what is left out, and why."""
    from invrender.capture.photos import see_each
    from invrender.files.capture import load_set
    from invrender.files.write import atomic_path
    from invrender.report.inspection import annotate, summary
    from invrender.types import InputError

    if args.ball:
        raise InputError("--ball is for one photo: inspect that one by itself")
    captures, patterns = load_set(args.capture)
    photos: dict[str, Any] = {}
    for seen in see_each([(c, patterns) for c in captures], {}):
        name = seen.capture.name.split("/")[-1]
        if seen.found is None:
            photos[name] = {"left_out": str(seen.error)}
            continue
        shown = {} if seen.pattern is None else {"pattern": seen.pattern + 1}
        photos[name] = {**shown, **summary(seen.found)}
        if args.out is not None:
            args.out.mkdir(parents=True, exist_ok=True)
            with atomic_path(args.out / f"inspect_{name}.png") as path:
                annotate(seen.found).save(path, format="PNG", compress_level=1)
    if args.json:
        print(json.dumps(photos))
    for name, told in photos.items() if not args.json else ():
        if "left_out" in told:
            console.print(f"{name}  left out: {told['left_out']}")
            continue
        text = f"{name}  ball with confidence {told['ball_confidence']:.2f}"
        if "pattern" in told:
            gain = ", ".join(f"{g:.3g}" for g in told["gain"])
            text += (
                f", pattern {told['pattern']} of {len(patterns)}, radiance of white {gain}, "
                f"pattern fits to {told['fit']['residual']:.1%}"
            )
        else:
            text += f", {told['room_saturated']:.1%} of the room saturated"
        console.print(text)
        for warning in told["warnings"]:
            console.print(f"  warning: {warning['text']}")
    if all("left_out" in told for told in photos.values()):
        raise InputError("no photo of the set can be used; the lines above tell why")
    return 0
