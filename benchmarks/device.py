"""Captures as people make them: how often they are read, and their error over an ideal device's.

Path-traced photographs of set-ups that `invrender.data.simulate_setup` draws, all of it at once: in
turn a linear EXR that no lens correction has seen, a bracket of two JPEGs, one JPEG; every second
sample lies in the capture sheet. Beside each stands the same sample under an ideal device with its
true lights. Then noisy photographs of a perfectly straight camera: is a tilt believed? And each
effect alone, with all else known: modelled, ignored (at the right mean brightness), absent; and
what modelling it costs, in processor time of a pixel's Jacobian.

Photographs are kept in DIR/captures; with --resume the results of earlier runs are too, in
DIR/rows: only for the same code. The materials and rooms that count are those of
holdout_families.txt; --development takes others, with other seeds. Without folders, and with
--quick, materials and rooms are procedural.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.common.captures import (
    GAIN,
    CaptureSet,
    arguments,
    make_capture,
    sample_and_room,
    true_lights,
)
from benchmarks.common.results import Bar, Table, bar, table, write_results
from invrender.capture.lights import FoundLights, find_lights
from invrender.capture.sample import Sample
from invrender.colour import PRIMARIES, linear_to_srgb, srgb_to_linear, to_rec709
from invrender.data.simulate import SAMPLE_LEVEL, simulate_real
from invrender.data.simulate_camera import Camera, seen, toned
from invrender.data.simulate_setup import PHOTO_KINDS, draw_setup
from invrender.files.capture import Capture, load_capture
from invrender.files.rig_toml import read_rig
from invrender.lights import IDEAL, Device, Lights
from invrender.maps import map_errors, resize_maps
from invrender.pattern.default import default_pattern
from invrender.pipeline import Stages, estimate_maps, reconstruct
from invrender.render.path_traced import path_traced, sample_scene
from invrender.render.renderer import Material
from invrender.render.scene import make_view
from invrender.report.advice import screen_light
from invrender.rig import Rig
from invrender.types import Array, InputError

FINAL = CaptureSet("families", 290_000)
DEVELOPMENT = CaptureSet("holdout", 280_000)
READ = {"raw": 0.98, "bracket": 0.97, "jpeg": 0.90}
OVER_IDEAL = {"raw": 1.08, "bracket": 1.15, "jpeg": 1.35}
WITH_SHEET = {"raw": 1.05, "bracket": 1.08, "jpeg": 1.20}
SILENT = {"raw": 0.02, "bracket": 0.02, "jpeg": 0.05}
SPOILT = 2.0  # times the ideal error: to be warned of
FALSE_TILT = 0.5  # degrees, of a camera that is straight
# Notices that say what was measured, not that something is wrong.
TELLS = {
    "ball-reflectance-measured",
    "fov-measured",
    "pattern-turned",
    "photo-turned",
    "photo-vignetting",
}
NOISY = 0.02  # of the photographs of a straight camera, relative

Row = dict[str, Any]


@dataclass(frozen=True)
class Size:
    """Pixels a side of the maps, width of the photos, samples of the path tracer."""

    maps: int
    photo: int
    spp: int


# --- everything at once ---------------------------------------------------------------------------


def make_real(
    folder: Path, k: int, drawn: CaptureSet, size: Size, given: argparse.Namespace
) -> str:
    """Simulate the k-th capture where it is not there yet; the kind of its photo."""
    kind, i = PHOTO_KINDS[k % 3], k // 3
    if not folder.exists():
        maps, room, _ = sample_and_room(i, drawn, size.maps, given.materials, given.envs)
        setup = draw_setup(drawn.first_seed + k, kind, sheet=i % 2 == 1)
        simulate_real(
            folder, maps, room, default_pattern(), setup, width=size.photo, spp=size.spp, seed=k
        )
    return kind


def make_ideal(
    folder: Path, i: int, drawn: CaptureSet, size: Size, given: argparse.Namespace,
    noise: float = 0.005,
) -> None:  # fmt: skip
    """Simulate the i-th sample under an ideal device where it is not there yet."""
    if not folder.exists():
        maps, room, _ = sample_and_room(i, drawn, size.maps, given.materials, given.envs)
        make_capture(
            folder, maps, room, Rig(), default_pattern(), size.photo, size.spp, i, noise=noise
        )


def lights_of_truth(folder: Path, capture: Capture) -> Lights:
    """The lights that a real set-up was simulated with, in its first photo's unit."""
    told = json.loads((folder / "truth" / "setup.json").read_text("utf-8"))
    rig = read_rig(folder / "truth" / "rig.toml")
    assert capture.true_environment is not None
    room = np.asarray(capture.true_environment, np.float32)
    gain = np.asarray(told["gain"], np.float32)
    return Lights(rig.rig, capture.pattern, room, gain, device=rig.device or IDEAL)


def error_of(sample: Sample, truth: Any) -> float:
    """Average map RMSE of the refined maps."""
    size = len(sample.photo)
    _, refined, _ = estimate_maps([sample], Stages())
    return map_errors(refined.maps, resize_maps(truth, size, size))["average"]


def measure(folder: Path, size: int) -> Row:
    """Read and refine a capture from its files alone: its error, or why it was refused."""
    row: Row = {"capture": folder.name}
    start = time.process_time()
    try:
        found = find_lights(load_capture(folder))
        row["tilt"] = found.lights.rig.off_nadir
        report = reconstruct(found, size=size).report
        assert report.map_error is not None
        row["notices"] = [notice.code for notice in report.warnings]
        row["error"] = report.map_error["refined"]["average"]
    except InputError as error:
        row["refused"] = str(error)
    row["processor_seconds"] = time.process_time() - start
    return row


def measure_true(folder: Path, size: int, lights: Callable[[Path, Capture], Lights]) -> Row:
    """Refine a capture under its true lights, cropped where the sample truly is."""
    capture = load_capture(folder)
    true = lights(folder, capture)
    found = FoundLights(replace(capture, rig=true.rig), true, None, ())
    return {"error": error_of(Sample.of(found, size), capture.truth)}


def kept(file: Path, resume: bool, make: Callable[[], Row]) -> Row:
    """A row of results, as a file has it where it may."""
    if resume and file.exists():
        return dict(json.loads(file.read_text("utf-8")))
    row = make()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(row), encoding="utf-8")
    return row


# --- each effect alone ----------------------------------------------------------------------------

MIXED = ((0.94, 0.04, 0.02), (0.03, 0.94, 0.03), (0.01, 0.05, 0.94))
# What displays and rigs that are not ideal do, each in the middle of its range or beyond.
DISPLAYS: dict[str, tuple[Rig, Device]] = {
    "dims to the sides, exponent 1": (Rig(), Device(falloff=1.0)),
    "mixes 6% of the colours": (Rig(), Device(mixing=MIXED)),
    "black emits 0.8%": (Rig(), Device(black=0.008)),
    "curve's exponent 1.12": (Rig(), Device(gamma=(1.12, 1.12, 1.12))),
    "12 mm bezel": (Rig(screen_bezel=0.012), IDEAL),
    "camera 5 cm higher": (Rig(camera_height=0.203), IDEAL),
}


def photo_effects(photo: Array, rig: Rig) -> dict[str, Array]:
    """The sample's photo (N, N, 3) as a camera makes it, in the unit of ``photo``."""
    n = len(photo)
    level = np.float32(SAMPLE_LEVEL / max(float(np.percentile(photo, 99)), 1e-9))
    values = np.clip(photo * level, 0, 1)
    curve = srgb_to_linear(toned(Camera(shoulder=0.75, contrast=0.15), values))
    height, width = 960, 1280
    field = seen(Camera(vignetting=0.3), np.ones((height, width, 3), np.float32), height, width)
    at = rig.project(rig.sample_points(n, n), height, width).astype(int)
    p3 = np.clip(values @ np.linalg.inv(to_rec709(PRIMARIES["p3d65"])).T, 0, 1)
    return {
        "tone curve of a JPEG": curve / level,
        "Display P3 read as sRGB": srgb_to_linear(linear_to_srgb(p3)) / level,
        "corners 30% darker": photo * field[at[..., 1], at[..., 0]],
        "ball of 0.7 believed to be 0.9": photo * np.float32(0.9 / 0.7),
    }


def effects(i: int, drawn: CaptureSet, size: Size, given: argparse.Namespace) -> Row:
    """Errors of one sample: by effect, modelled, ignored and absent."""
    maps, room, _ = sample_and_room(i, drawn, size.maps, given.materials, given.envs)
    maps = resize_maps(maps, size.maps, size.maps)
    unclipped = np.zeros(maps.shape, bool)
    pattern = default_pattern(256)

    def photo_of(rig: Rig, device: Device) -> Array:
        scene = sample_scene(rig, maps, pattern, room, GAIN, device=device)
        return path_traced(scene, rig, *maps.shape, 4 * size.spp, seed=i)

    def error(photo: Array, lights: Lights) -> float:
        return error_of(Sample(photo, unclipped, lights), maps)

    ideal = Lights(Rig(), pattern, room, GAIN)
    plain = photo_of(Rig(), IDEAL)
    absent = error(plain, ideal)
    row: Row = {"absent": absent, "modelled": {}, "ignored": {}}
    for name, (rig, device) in DISPLAYS.items():
        photo = photo_of(rig, device)
        true = replace(ideal, rig=rig, device=device)
        believed = replace(ideal, gain=GAIN * screen_light(true) / screen_light(ideal))
        row["modelled"][name] = error(photo, true)
        row["ignored"][name] = error(photo, believed)
    for name, photo in photo_effects(plain, Rig()).items():
        row["ignored"][name] = error(np.asarray(photo, np.float32), ideal)
    return row


def cost(size: int, repeats: int = 5) -> dict[str, float]:
    """Processor time of a pixel's Jacobian with each effect modelled over that without any."""
    from invrender.maps import constant_maps
    from invrender.render.fast.estimator import Fast

    room = np.full((32, 64, 3), 0.3, np.float32)
    material = Material.from_maps(constant_maps(size, size, 0.3, 0.05, 0.4))

    def seconds(rig: Rig, device: Device) -> float:
        renderer = Fast.under(Lights(rig, default_pattern(256), room, GAIN, device=device))
        view = make_view(renderer.scene, size, size)
        renderer.pixel_jacobian(view, material, 64)
        spent = []
        for _ in range(repeats):
            start = time.process_time()
            np.asarray(renderer.pixel_jacobian(view, material, 64).radiance)
            spent.append(time.process_time() - start)
        return float(np.median(spent))

    none = seconds(Rig(), IDEAL)
    return {name: seconds(*case) / none for name, case in DISPLAYS.items()}


# --- the results ----------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    p = arguments(__doc__, "three small photographs, procedural", 60)
    p.add_argument("--resume", action="store_true", help="keep the rows of an earlier run")
    p.add_argument("--development", action="store_true", help="other materials, rooms and seeds")
    p.add_argument("--size", type=int, default=256, help="pixels a side of the maps (256)")
    p.add_argument("--width", type=int, default=1280, help="of the photos (1280)")
    p.add_argument("--spp", type=int, default=64, help="samples of the path tracer (64)")
    p.add_argument("--first", type=int, default=0, help="photograph to begin with (0)")
    p.add_argument("--straight", type=int, default=40, help="photos of a straight camera (40)")
    p.add_argument("--effects", type=int, default=6, help="samples to try each effect on (6)")
    return p


def main(args: argparse.Namespace) -> None:
    if args.quick:
        args.materials = args.envs = None
        args.count, args.straight, args.effects = 3, 1, 0
        args.size, args.width, args.spp = 32, 480, 8
    size = Size(args.size, args.width, args.spp)
    drawn = DEVELOPMENT if args.development else FINAL
    captures, rows_at = args.out / "captures", args.out / "rows"
    rows: list[Row] = []
    for k in range(args.first, args.first + args.count):
        folder, twin = captures / f"{k:03d}", captures / f"ideal-{k // 3:03d}"
        kind = make_real(folder, k, drawn, size, args)
        make_ideal(twin, k // 3, drawn, size, args)
        ideal = kept(
            rows_at / f"{twin.name}.json", args.resume or k % 3 > 0,
            lambda twin=twin: measure_true(twin, size.maps, true_lights),  # type: ignore[misc]
        )  # fmt: skip
        row = kept(
            rows_at / f"{folder.name}.json", args.resume,
            lambda folder=folder: measure(folder, size.maps),  # type: ignore[misc]
        )  # fmt: skip
        row |= {"kind": kind, "sheet": k // 3 % 2 == 1, "ideal": ideal["error"]}
        if kind == "raw":
            row["true lights"] = kept(
                rows_at / f"{folder.name}-true.json", args.resume,
                lambda folder=folder: measure_true(folder, size.maps, lights_of_truth),  # type: ignore[misc]
            )["error"]  # fmt: skip
        rows.append(row)
        told = row.get("refused", f"{row.get('error', 0):.4f} over {row['ideal']:.4f}")
        print(k, kind, "sheet" if row["sheet"] else "", told, row.get("notices"), flush=True)
    straight = []
    for i in range(args.straight):
        folder = captures / f"straight-{i:03d}"
        make_ideal(folder, i, drawn, size, args, NOISY)
        straight.append(
            kept(
                rows_at / f"{folder.name}.json", args.resume,
                lambda folder=folder: read_tilt(folder),  # type: ignore[misc]
            )
        )  # fmt: skip
        print("straight", i, straight[-1], flush=True)
    alone = [
        kept(
            rows_at / f"effects-{i:03d}.json", args.resume,
            lambda i=i: effects(i, drawn, size, args),  # type: ignore[misc]
        )
        for i in range(args.effects)
    ]  # fmt: skip
    costs = cost(size.maps)
    results = {"rows": rows, "straight": straight, "effects": alone, "cost": costs}
    tables = {"captures": captures_table(rows), "refused": refused_table(rows)}
    if alone:
        tables["each effect alone, average map RMSE"] = effects_table(alone, costs)
    write_results(args.out, {"bars": bars(rows, straight), **results}, tables)
    plot(args.out / "device.png", rows)


def read_tilt(folder: Path) -> Row:
    """How far a straight camera is believed to be tilted, in degrees."""
    try:
        return {"tilt": find_lights(load_capture(folder)).lights.rig.off_nadir}
    except InputError as error:
        return {"refused": str(error)}


def ratios(rows: Sequence[Row]) -> list[float]:
    """Errors over those under an ideal device, of what was read."""
    return [r["error"] / r["ideal"] for r in rows if "error" in r]


def silent(rows: Sequence[Row]) -> float:
    """Share of captures that are spoilt without any notice that something is wrong."""
    bad = [r for r in rows if "error" in r and r["error"] > SPOILT * r["ideal"]]
    return sum(not set(r["notices"]) - TELLS for r in bad) / max(len(rows), 1)


def bars(rows: Sequence[Row], straight: Sequence[Row]) -> list[Bar]:
    found = []
    for kind in PHOTO_KINDS:
        some = [r for r in rows if r["kind"] == kind]
        if not some:
            continue
        read = float(np.mean(["error" in r for r in some]))
        found.append(bar(f"{kind}: read", read, READ[kind], True))
        for name, part, bars_of in (
            ("error over the ideal device's, median", some, OVER_IDEAL),
            ("the same with sheet", [r for r in some if r["sheet"]], WITH_SHEET),
        ):
            if over := ratios(part):
                found.append(bar(f"{kind}: {name}", float(np.median(over)), bars_of[kind], False))
        found.append(bar(f"{kind}: twice the error unwarned", silent(some), SILENT[kind], False))
    false = sum(r.get("tilt", 0.0) > FALSE_TILT for r in straight)
    if straight:
        found.append(bar(f"tilts believed of {len(straight)} straight cameras", false, 0, False))
    return found


def captures_table(rows: Sequence[Row]) -> Table:
    """By kind of photo and sheet: how many were read, and their errors."""
    lines: list[list[Any]] = []
    for kind in PHOTO_KINDS:
        for sheet in (False, True):
            some = [r for r in rows if r["kind"] == kind and r["sheet"] == sheet]
            if not some:
                continue
            errors = [r["error"] for r in some if "error" in r]
            over = ratios(some)
            true = [r["true lights"] / r["ideal"] for r in some if "true lights" in r]
            lines.append([
                kind + (", sheet" if sheet else ""), len(some), len(errors),
                *(float(np.median(x)) if x else None
                  for x in (errors, [r["ideal"] for r in some], over, true)),
            ])  # fmt: skip
    header = ["median", "captures", "read", "average map RMSE", "ideal device", "ratio",
              "ratio with true lights"]  # fmt: skip
    return table(header, lines)


def refused_table(rows: Sequence[Row]) -> Table:
    """Why captures were refused."""
    lines = [[r["capture"], r["kind"], r["refused"]] for r in rows if "refused" in r]
    return table(["capture", "kind", "why it was refused"], lines)


def effects_table(rows: Sequence[Row], costs: dict[str, float]) -> Table:
    """Medians over the samples; the last column is processor time over that without."""
    absent = float(np.median([r["absent"] for r in rows]))
    lines: list[list[Any]] = []
    for name in rows[0]["ignored"]:
        modelled, ignored = (
            [r[k][name] for r in rows if name in r[k]] for k in ("modelled", "ignored")
        )
        lines.append([
            name, float(np.median(modelled)) if modelled else None, float(np.median(ignored)),
            absent, costs.get(name),
        ])  # fmt: skip
    return table(["", "modelled", "ignored", "absent", "time"], lines)


def plot(path: Path, rows: Sequence[Row]) -> None:
    """Errors of captures over the ideal device's, sorted, by kind."""
    figure, axis = plt.subplots(figsize=(6, 3.5))
    for kind in PHOTO_KINDS:
        over = sorted(ratios([r for r in rows if r["kind"] == kind]))
        count = sum(r["kind"] == kind for r in rows)
        axis.semilogx(over, (np.arange(len(over)) + 1) / max(count, 1), marker=".", label=kind)
    axis.axvline(SPOILT, color="k", linestyle="--", linewidth=0.8)
    axis.set_xlabel("average map error over the ideal device's")
    axis.set_ylabel("share of captures")
    axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
