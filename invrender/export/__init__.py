"""Maps in the forms that other programs read, each with what the conversion costs.

A target states what a reader will see in its files; that is compared with the maps that went in, as
maps and re-rendered with our BRDF under nine point lights.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from invrender.data.materials import read_material
from invrender.export.folders import (
    write_ambientcg,
    write_blender,
    write_godot,
    write_polyhaven,
    write_unity,
    write_unreal,
)
from invrender.export.gltf import move_glb, write_gltf
from invrender.export.material import Material, height_range
from invrender.export.materialx import write_materialx
from invrender.export.mitsuba import write_mitsuba
from invrender.export.textures import safe_name, whole_folder, write_zip
from invrender.export.tileable import make_tileable
from invrender.export.usd import write_usd, write_usdz
from invrender.files.images import read_image
from invrender.maps import Maps, map_errors
from invrender.render.height import height_from_normals
from invrender.rig import Rig
from invrender.types import Array, InputError

__all__ = ["TARGETS", "Exported", "Target", "export", "export_maps", "rerender_error"]

CONVENTIONS = ("opengl", "directx")
CHECKED = 256  # pixels a side that are re-rendered at most


@dataclass(frozen=True)
class Target:
    """What writes a target's files into a folder, and what they can hold, the defaults first.

    height: there is a place for one. single: the ending of the file of its own that it can be, if
    any; folder: it can also be a folder. Every target can be a ``.zip``.
    """

    write: Callable[[Material, Path, str, str], dict[str, Maps]]
    formats: tuple[str, ...] = ("png16", "png8", "exr", "jpeg")
    conventions: tuple[str, ...] = CONVENTIONS
    height: bool = True
    single: str | None = None
    folder: bool = True


TARGETS = {
    "gltf": Target(
        write_gltf, ("png8", "jpeg"), ("opengl",), height=False, single=".glb", folder=False
    ),
    "usd": Target(write_usd, conventions=("opengl",), single=".usdz"),
    "materialx": Target(write_materialx, ("exr", "png16", "png8", "jpeg"), ("opengl",)),
    "blender": Target(write_blender),
    "unreal": Target(write_unreal, conventions=("directx", "opengl")),
    "unity": Target(write_unity, ("png16", "png8", "exr")),
    "godot": Target(write_godot, conventions=("opengl",)),
    "ambientcg": Target(write_ambientcg),
    "polyhaven": Target(write_polyhaven),
    "mitsuba": Target(write_mitsuba, ("exr",), ("opengl",), height=False),
}


# What becomes of the folder of files for an output of each ending.
PACKERS = {".glb": move_glb, ".usdz": write_usdz, ".zip": write_zip}


@dataclass
class Exported:
    """What was written and what it cost.

    errors: for each way of reading the files, the RMSE of each map, their ``average``, and
    ``rerender``, the RMS difference over the mean of the re-rendered images. height: metres of
    black and white, the share of slopes that no surface explains, and their RMS. seams: see
    `invrender.export.tileable.Seams`.
    """

    target: str
    path: str
    name: str
    format: str
    normal_convention: str
    width: float
    errors: dict[str, dict[str, float]]
    height: dict[str, float] | None
    seams: dict[str, float] | None
    seconds: dict[str, float]


def export(source: Path, out: Path, target: str, **options: Any) -> Exported:
    """`export_maps` of a result folder of ``invrender refine``, or of any material folder.

    The width is taken from the result's report, else it is the default rig's sample size. Raises
    `InputError` for bad input.
    """
    source = Path(source)
    maps = read_material(source)
    report = _report(source / "report.json")
    room = source / "environment.exr"
    options = {
        "name": report.get("capture") or source.resolve().name,
        "environment": read_image(room) if target == "mitsuba" and room.is_file() else None,
        **{k: v for k, v in options.items() if v is not None},
    }
    size = report.get("sample_size")
    if isinstance(size, int | float) and math.isfinite(size) and size > 0:
        options.setdefault("width", float(size))
    return export_maps(maps, out, target, **options)


def export_maps(
    maps: Maps,
    out: Path,
    target: str,
    *,
    name: str = "material",
    format: str | None = None,
    normal_convention: str | None = None,
    width: float | None = None,
    tileable: bool = False,
    height: bool = False,
    licence: str | None = None,
    environment: Array | None = None,
) -> Exported:
    """Write maps for a target of `TARGETS` to ``out``: a .glb file for glTF, a .usdz file or a
    folder for USD, a folder for the others, or a .zip file for any.

    width: of the sample, metres. tileable: make the maps seamless. height: integrate the normals
    to a height map, and that to ambient occlusion. licence: for ``material.json``, which stands
    beside the files of a folder or .zip and holds the sizes. Raises `InputError` for what the
    target cannot hold; nothing is written then.
    """
    kind = TARGETS.get(target)
    if kind is None:
        raise InputError(f"no export target '{target}'; there are {', '.join(TARGETS)}")
    out, width = Path(out), width or Rig().sample_size
    format = _one_of(target, "format", format, kind.formats)
    convention = _one_of(target, "normal convention", normal_convention, kind.conventions)
    if height and not kind.height:
        raise InputError(f"{target} has no place for a height map; export to materialx or blender")
    if not (math.isfinite(width) and width > 0):
        raise InputError(f"the sample's width must be positive, got {width:g}")
    _check_out(out, kind, target)

    seconds: dict[str, float] = {}
    start = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal start
        seconds[stage], start = time.perf_counter() - start, time.perf_counter()

    seams = relief = None
    if tileable:
        maps, quality = make_tileable(maps)
        seams = asdict(quality)
        lap("tileable")
    if height:
        relief = height_from_normals(maps.normal, width / maps.shape[1], periodic=tileable)
        lap("height")
    material = Material(
        safe_name(name), maps, width, relief.height if relief else None, environment
    )
    suffix = out.suffix.lower()
    with whole_folder(out, PACKERS.get(suffix)) as folder:
        seen = kind.write(material, folder, format, convention)
        if suffix not in (".glb", ".usdz"):
            facts = _facts(material, target, format, convention, licence)
            (folder / "material.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
    lap("write")
    known = _rerendered(maps)
    errors = {
        key: {**map_errors(back, maps), "rerender": _difference(_rerendered(back), known)}
        for key, back in seen.items()
    }
    lap("check")
    heights = None
    if relief:
        black, white = height_range(relief.height)
        heights = {"black": black, "white": white, "outliers": relief.outliers,
                   "residual": relief.residual}  # fmt: skip
    return Exported(
        target, str(out), material.name, format, convention, width, errors, heights, seams, seconds
    )  # fmt: skip


def rerender_error(maps: Maps, truth: Maps) -> float:
    """RMS difference over the mean of nine re-rendered images, at `CHECKED`² pixels or fewer."""
    return _difference(_rerendered(maps), _rerendered(truth))


def _rerendered(maps: Maps) -> Array:
    from invrender.render.point_lights import rerender

    step = -(-max(maps.shape) // CHECKED)
    return rerender(Maps(*(m[::step, ::step] for m in maps.__dict__.values())))


def _difference(image: Array, truth: Array) -> float:
    rms = np.sqrt(np.mean(np.square(image - truth), dtype=np.float64))
    return float(rms / max(float(truth.mean()), 1e-12))


def _one_of(target: str, what: str, value: str | None, known: tuple[str, ...]) -> str:
    value = value or known[0]
    if value not in known:
        raise InputError(f"the {what} of {target} is {' or '.join(known)}, not {value}")
    return value


def _check_out(out: Path, kind: Target, target: str) -> None:
    endings = [ending for ending in (kind.single, ".zip") if ending]
    if out.suffix.lower() in endings:
        if out.is_dir():
            raise InputError(f"{out} is a folder; choose a file")
        if not out.resolve().parent.is_dir():
            raise InputError(f"{out.parent} is not a folder")
    elif not kind.folder:
        raise InputError(f"{out}: {target} is written as one {' or '.join(endings)} file")
    elif out.suffix.lower() in PACKERS:
        raise InputError(f"{out}: {target} cannot be written as a {out.suffix} file")
    elif out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; choose a folder")


def _facts(
    material: Material, target: str, format: str, convention: str, licence: str | None
) -> dict[str, Any]:
    """What the textures alone do not tell; lengths in metres."""
    facts: dict[str, Any] = {
        "name": material.name,
        "licence": licence,
        "generator": f"invrender {version('invrender')}",
        "target": target,
        "format": format,
        "normal_convention": convention,
        "sides": list(material.sides),
    }
    if material.height is not None:
        facts["height"] = dict(zip(("black", "white"), height_range(material.height), strict=True))
    return facts


def _report(path: Path) -> dict[str, Any]:
    """A result's report, or nothing where there is none that can be read."""
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    capture = report.get("capture") if isinstance(report, dict) else None
    if not isinstance(capture, str):
        return {}
    return dict(report)
