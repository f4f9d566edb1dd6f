"""``invrender export``: a result in the form that another program reads."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from invrender.export import Exported

FILES = (".glb", ".usdz", ".zip")  # else a folder is written
EXPORT_TARGETS = (
    "gltf", "usd", "materialx", "blender", "unreal", "unity", "godot", "ambientcg", "polyhaven",
    "mitsuba",
)  # fmt: skip


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "export",
        help="write a result for glTF, USD, MaterialX, Blender, game engines or Mitsuba",
        description="Write a result's maps in the form that another program reads, and say what "
        "the conversion costs: the error of the maps, and of their re-rendering, as a reader of "
        "the files sees them.",
    )
    parser.add_argument(
        "result", type=Path, help="a folder that refine wrote, or any folder of material maps"
    )
    parser.add_argument("--to", required=True, choices=EXPORT_TARGETS, help="what to write")
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        required=True,
        help="a .glb file for gltf, a .usdz file or a folder for usd, a folder for the rest; or "
        "a .zip file",
    )
    parser.add_argument(
        "--format",
        choices=("png8", "png16", "exr", "jpeg"),
        help="of the textures (gltf: png8, or jpeg; materialx and mitsuba: exr; the rest: png16)",
    )
    parser.add_argument(
        "--normal-convention",
        choices=("opengl", "directx"),
        help="whether green points up or down in normal maps (unreal: directx, else opengl)",
    )
    parser.add_argument("--tileable", action="store_true", help="make the maps seamless")
    parser.add_argument(
        "--height",
        action="store_true",
        help="add a height map, integrated from the normals, and ambient occlusion",
    )
    parser.add_argument("--name", help="of the material and its files (the capture's)")
    parser.add_argument(
        "--width", type=float, metavar="METRES", help="of the sample (what the result says)"
    )
    parser.add_argument("--licence", help="for material.json, beside the files")
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the subcommand."""
    from invrender.export import export
    from invrender.files.output import check_output

    check_output(args.out, [args.result], file=args.out.suffix.lower() in FILES)

    with console.status(f"exporting to {args.to} …"):
        done = export(
            args.result,
            args.out,
            args.to,
            format=args.format,
            normal_convention=args.normal_convention,
            name=args.name,
            width=args.width,
            tileable=args.tileable,
            height=args.height,
            licence=args.licence,
        )
    if args.json:
        print(json.dumps(asdict(done)))
    else:
        _print(done, console)
    return 0


def _print(done: Exported, console: Console) -> None:
    lines = [
        f"wrote {done.path}: {done.name}, {done.width * 100:.3g} cm wide, {done.format}, "
        f"{done.normal_convention} normals"
    ]
    for reader, errors in done.errors.items():
        lines.append(
            f"  {reader}: re-render error {errors['rerender']:.2%}, maps {errors['average']:.4f} "
            f"(diffuse {errors['diffuse']:.4f}, specular {errors['specular']:.4f})"
        )
    if done.seams:
        lines.append(
            "  seams, in steps between neighbours: at the border "
            f"{done.seams['before']:.2g} → {done.seams['after']:.2g}, along the cuts "
            f"{done.seams['cuts']:.2g}; {done.seams['replaced']:.0%} of the pixels replaced"
        )
    if done.height:
        lines.append(
            f"  height: black {done.height['black'] * 1000:.4g} mm, white "
            f"{done.height['white'] * 1000:.4g} mm; no surface explains "
            f"{done.height['outliers']:.1%} of the slopes"
        )
    for line in lines:
        console.print(line)
