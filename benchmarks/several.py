"""Several photos of one sample: their error over one photo's, and where the rest comes from.

Path-traced photographs of held-out materials under the patterns of a set, one after another; a hand
moves camera and display before each. The first 1, 2, 3, 5 and 8 of them are explained together,
with the lights that the ball shows and registered by the photos ("found"), with these lights at the
true places ("true places"), and with the true lights at the true places ("true lights"). Then the
same sample without a tablet: six photos, each under its own lamp, near and moved about.

Photographs are kept in DIR/captures and rows in DIR/results.json, so that a run that was stopped
goes on, and another of more samples or photos adds to it. Without folders, and with --quick,
materials and rooms are procedural.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import pyplot as plt
from scipy import ndimage

from benchmarks.common.captures import (
    GAIN,
    SHIFT,
    TILT,
    CaptureSet,
    arguments,
    sample_and_room,
    true_lights,
)
from benchmarks.common.results import Bar, Table, bar, table, write_results
from benchmarks.refine import rerender_error
from invrender.capture.lights import FoundLights, find_lights
from invrender.capture.sample import Sample
from invrender.capture.which_pattern import find_pattern
from invrender.data.simulate_setup import draw_lamps, hides, without_screen
from invrender.files.capture import Capture, load_capture
from invrender.files.maps import write_maps
from invrender.files.rig_toml import read_rig, write_rig
from invrender.files.write import write_exr
from invrender.lights import NO_PATTERN, Lamp, Lights
from invrender.maps import NAMES, Maps, crop_maps, map_errors, resize_maps
from invrender.pattern.sets import COUNTS, pattern_set
from invrender.pipeline import Stages, estimate_maps, load_networks
from invrender.rig import Rig
from invrender.types import Array, InputError, Vec3

if TYPE_CHECKING:
    from invrender.pipeline import Networks

SEVERAL = CaptureSet("holdout", 390_000)
NUMBERS = (1, *COUNTS)
CAMERA_SHIFT, CAMERA_TILT = 2e-3, 1.0  # standard deviations, metres and degrees, of a hand
NOISE = 0.005  # of the sensor
SAMPLES, FINER = 256, 3  # of a texel; a side of a photo pixel, of texels
LAMP_PHOTOS, LAMP_PATHS = 6, 256  # without a tablet: photos; paths of a texel
WHOLE = 0.95  # of the most that a row or column has of the sample
KINDS = (*NAMES, "average", "rerender")
FOUND, PLACED, TRUE = STAGES = ("found", "true places", "true lights")
NO_TABLET = "no tablet"
RATIOS = {"normal": 0.45, "diffuse": 0.5, "roughness": 0.75, "average": 0.6, "rerender": 0.5}
OF_A_SET = 5  # photos, whose errors the bars are for
WITHOUT = 1.0  # average error without a tablet over one photo's with one

Row = dict[str, Any]
Results = dict[str, dict[int, list[Row]]]  # by stage and number of photos


def hand_held(rng: np.random.Generator) -> Rig:
    """The default rig as a hand holds it, the sample in view and the display beside it."""

    def drawn(deviation: float) -> Vec3:
        x = np.clip(rng.normal(0, deviation, 3), -2 * deviation, 2 * deviation)
        return float(x[0]), float(x[1]), float(x[2])

    while True:
        rig = Rig(
            screen_shift=drawn(SHIFT), screen_tilt=drawn(TILT),
            camera_shift=drawn(CAMERA_SHIFT), camera_tilt=drawn(CAMERA_TILT),
        )  # fmt: skip
        at = rig.project(rig.sample_corners, 3, 4)
        if not hides(rig) and np.all((at > 0) & (at < [4, 3])):
            return rig


def photograph_set(
    rig: Rig, maps: Maps, lights: Lights, width: int, spp: int, seed: int, lamp: Lamp | None = None
) -> Array:
    """A photo (H, W, 3): ball and table path-traced, the sample at the maps' own resolution
    from the fast estimator, to which a lamp adds paths of its own, which have little noise: that of
    the rest would be a bad sensor's."""
    from invrender.render.fast.estimator import Fast
    from invrender.render.path_traced import path_traced, photograph, sample_scene
    from invrender.render.scene import scene_under

    height = width * 3 // 4
    photo = photograph(
        rig, maps, lights.pattern, lights.environment, lights.gain,
        height=height, width=width, spp=spp, seed=seed, lamp=lamp,
    )  # fmt: skip
    shown = Fast(scene_under(lights), detail=2).render(maps, SAMPLES)
    if lamp is not None:
        alone = sample_scene(rig, maps, None, None, lamp=lamp)
        shown += path_traced(alone, rig, *maps.shape, LAMP_PATHS, seed)
    corners = rig.project(rig.sample_corners, height, width)
    (x0, y0), (x1, y1) = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
    part = (np.arange(FINER) + 0.5) / FINER
    x = (np.arange(x0, x1)[:, None] + part).ravel()
    y = (np.arange(y0, y1)[:, None] + part).ravel()
    rays = rig.rays(np.stack(np.meshgrid(x, y), -1), height, width)
    at = (rig.camera - rays * (rig.camera[2] / rays[..., 2:]))[..., :2] / rig.sample_size + 0.5
    h, w = maps.shape
    row, column = np.floor((1 - at[..., 1]) * h).astype(int), np.floor(at[..., 0] * w).astype(int)
    inside = (row >= 0) & (row < h) & (column >= 0) & (column < w)
    fine = photo[y0:y1, x0:x1].repeat(FINER, 0).repeat(FINER, 1)
    fine[inside] = shown[row[inside], column[inside]]
    photo[y0:y1, x0:x1] = fine.reshape(y1 - y0, FINER, x1 - x0, FINER, 3).mean((1, 3))
    rng = np.random.default_rng(seed)
    sigma = NOISE * np.sqrt(np.maximum(photo, 0) * float(np.percentile(photo, 99)))
    return np.maximum(photo + sigma * rng.standard_normal(photo.shape), 0)


def make_set(
    out: Path, k: int, photos: int, lamps: int, size: int, width: int, spp: int,
    materials: Path | None, rooms: Path | None,
) -> tuple[list[Path], list[Path]]:  # fmt: skip
    """Captures ``out``/000/1 and so on of sample k under the patterns, and ``out``/000/lamp_1 and
    so on without a tablet, a photo each; simulates those that are not there yet."""
    shown = [out / f"{k:03d}" / str(i + 1) for i in range(photos)]
    lit = [out / f"{k:03d}" / f"lamp_{i + 1}" for i in range(lamps)]
    maps, room, _ = sample_and_room(k, SEVERAL, size, materials, rooms)
    moved = draw_lamps(SEVERAL.first_seed + k, lamps)
    patterns = pattern_set(max(COUNTS))
    pictures: list[tuple[int, Path, Array, Lamp | None]] = [
        *((i, folder, patterns[i], None) for i, folder in enumerate(shown)),
        *((len(patterns) + i, folder, NO_PATTERN, moved[i]) for i, folder in enumerate(lit)),
    ]
    for i, folder, pattern, lamp in pictures:
        if folder.exists():
            continue
        rig, nominal = hand_held(np.random.default_rng((SEVERAL.first_seed, k, i))), Rig()
        if lamp is not None:
            rig, nominal = without_screen(rig), without_screen(nominal)
        lights = Lights(rig, pattern, room, GAIN)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".") as name:
            new = Path(name) / "capture"
            (new / "truth").mkdir(parents=True)
            photo = photograph_set(rig, maps, lights, width, spp, 16 * k + i, lamp)
            write_exr(new / "photo.exr", photo, half=True)
            if lamp is None:
                write_exr(new / "pattern.exr", pattern, half=True)
            write_rig(new / "rig.toml", nominal, "pattern.exr", "truth/")
            write_rig(new / "truth" / "rig.toml", rig)
            write_maps(new / "truth", maps, half=True, width=rig.sample_size)
            write_exr(new / "truth" / "environment.exr", room, half=True)
            os.replace(new, folder)
    return shown, lit


def find(folder: Path, patterns: Sequence[Array], which: int) -> tuple[FoundLights | None, bool]:
    """The lights of a photo under one of several patterns, None where its ball is not found; and
    whether the pattern was recognised."""
    capture, found = load_capture(folder), -1
    if patterns:
        try:
            seen, found = find_pattern(capture, patterns)
        except InputError:
            found = -1
    try:
        return find_lights(seen if found == which and patterns else capture), found == which
    except InputError as error:
        print(f"{folder}: {error}", flush=True)
        return None, False


def known(found: FoundLights, folder: Path, stage: str) -> FoundLights:
    """What was found, with the true places of camera and display or the true lights instead."""
    if stage in (FOUND, NO_TABLET):
        return found
    if stage == TRUE:
        return replace(found, lights=true_lights(folder, found.capture))
    true, rig = read_rig(folder / "truth" / "rig.toml").rig, found.lights.rig
    rig = replace(rig, camera_shift=true.camera_shift, camera_tilt=true.camera_tilt)
    return replace(found, lights=replace(found.lights, rig=rig))


def shown_part(truth: Maps, found: FoundLights, folder: Path) -> tuple[Maps, tuple[int, ...]]:
    """The true maps where the found camera takes the sample to be, since errors are those of the
    material, not of the square's place; and the rectangle of them that is the sample."""
    true, rig = read_rig(folder / "truth" / "rig.toml").rig, found.lights.rig
    size, photo = len(truth.diffuse), found.capture.photo
    pixels = rig.project(rig.sample_points(size, size), photo.height, photo.width)
    rays = true.rays(pixels, photo.height, photo.width)
    at = (true.camera - rays * (true.camera[2] / rays[..., 2:])) / true.sample_size
    row, column = (0.5 - at[..., 1]) * size - 0.5, (at[..., 0] + 0.5) * size - 0.5
    inside = (row > -0.5) & (row < size - 0.5) & (column > -0.5) & (column < size - 0.5)
    at = np.stack([row, column])
    images = {
        name: np.stack([ndimage.map_coordinates(c, at, mode="nearest") for c in image], -1)
        for name, image in (
            ("diffuse", np.moveaxis(truth.diffuse, -1, 0)),
            ("specular", np.moveaxis(truth.specular, -1, 0)),
            ("roughness", truth.roughness[None]),
            ("normal", np.moveaxis(truth.normal, -1, 0)),
        )
    }
    images["roughness"] = images["roughness"][..., 0]
    images["normal"] /= np.linalg.norm(images["normal"], axis=-1, keepdims=True)
    shares = inside.mean(1), inside.mean(0)
    rows, columns = (np.flatnonzero(share > WHOLE * share.max()) for share in shares)
    top, left = int(rows[0]), int(columns[0])
    part = top, left, int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left
    return Maps(**images), part


def measure(
    found: Sequence[FoundLights], folders: Sequence[Path], size: int, stage: str,
    networks: Networks | None = None,
) -> Row:  # fmt: skip
    """The errors of the maps that so many photos give together."""
    stages = Stages()
    cpu = time.process_time()
    told = [known(f, p, stage) for f, p in zip(found, folders, strict=True)]
    crops = [Sample.of(f, size, whole=True) for f in told]
    if stage in (PLACED, TRUE):
        crops = [replace(c, place=np.eye(3)) for c in crops]
    _, result, _ = estimate_maps(crops, stages, networks=networks)
    cpu = time.process_time() - cpu
    k = next(i for i in range(len(told)) if i not in result.left_out)  # whose frame the maps have
    capture: Capture = told[k].capture
    assert capture.truth is not None
    truth, part = shown_part(resize_maps(capture.truth, size, size), told[k], folders[k])
    maps = crop_maps(result.maps, *part)
    truth = crop_maps(truth, *part)
    return {
        **map_errors(maps, truth),
        "rerender": rerender_error(maps, truth),
        "photos": result.photo_errors,
        "left_out": result.left_out,
        "processor_seconds": cpu,
        "seconds": sum(stages.seconds.values()),
    }


def pooled(rows: Sequence[Row], kind: str) -> float:
    """RMSE over all samples; ``average`` is the mean of the four maps'."""
    if kind == "average":
        return float(np.mean([pooled(rows, n) for n in NAMES]))
    return float(np.sqrt(np.mean([r[kind] ** 2 for r in rows])))


def over_one(results: Results, rows: Sequence[Row], kind: str) -> float:
    """Pooled error of rows over that of one photo, as it is found, of the same samples."""
    samples = {r["sample"] for r in rows}
    return pooled(rows, kind) / pooled(
        [r for r in results[FOUND][1] if r["sample"] in samples], kind
    )


def error_table(results: Results) -> Table:
    """Errors by stage and number of photos, each over that of one photo as it is found."""
    lines = [
        [stage, number, len(rows), *(over_one(results, rows, kind) for kind in KINDS)]
        for stage, by_number in results.items()
        for number, rows in by_number.items()
        if rows
    ]
    return table(["lights", "photos", "samples", *KINDS], lines)


def sample_table(results: Results) -> Table:
    """Errors of a set's photos and of those without a tablet, over one photo's, by sample."""
    lines = [
        [row["sample"], stage, number, *(over_one(results, [row], kind) for kind in KINDS)]
        for stage, number in ((FOUND, OF_A_SET), (NO_TABLET, LAMP_PHOTOS))
        for row in results.get(stage, {}).get(number, [])
    ]
    return table(["sample", "lights", "photos", *KINDS], lines)


def bars(results: Results, recognised: float) -> list[Bar]:
    several = results[FOUND].get(OF_A_SET) or results[FOUND][max(results[FOUND])]
    lines = [
        bar(f"{kind}, set over one photo", over_one(results, several, kind), most, False)
        for kind, most in RATIOS.items()
        if several
    ]
    for number, rows in results.get(NO_TABLET, {}).items():
        if rows:
            ratio = over_one(results, rows, "average")
            lines.append(bar(f"average, {number} photos without a tablet", ratio, WITHOUT, False))
    return [*lines, bar("patterns recognised", recognised, 1.0, True)]


def plot(results: Results, file: Path) -> None:
    """Errors over one photo's against the number of photos, and against processor time."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    for stage, by_number in results.items():
        known = {n: rows for n, rows in by_number.items() if rows}
        errors = [over_one(results, rows, "average") for rows in known.values()]
        left.plot(list(known), errors, "o-", label=f"average, {stage}")
        seconds = [np.mean([r["processor_seconds"] for r in rows]) for rows in known.values()]
        right.plot(seconds, errors, "o-")
    known = {n: rows for n, rows in results[FOUND].items() if rows}
    for kind in NAMES:
        errors = [over_one(results, rows, kind) for rows in known.values()]
        left.plot(list(known), errors, ":", label=f"{kind}, {FOUND}")
    left.set(xlabel="photos", ylabel="RMSE over one photo's")
    right.set(xlabel="processor seconds, lights included", xscale="log", yscale="log")
    left.legend(fontsize=7)
    for axis in (left, right):
        axis.grid(alpha=0.3, which="both")
    figure.tight_layout()
    figure.savefig(file, dpi=120)
    plt.close(figure)


def kept(out: Path) -> tuple[Results, dict[str, list[bool]]]:
    """The rows that a run before has left, and for each sample which patterns it recognised."""
    file = out / "results.json"
    if not file.exists():
        return {}, {}
    content = json.loads(file.read_text())
    rows = {
        stage: {int(n): of_n for n, of_n in sorted(by.items(), key=lambda x: int(x[0]))}
        for stage, by in content["rows"].items()
    }
    return rows, content["recognised"]


def parser() -> argparse.ArgumentParser:
    p = arguments(__doc__, "one small procedural sample, three photos", 16)
    p.add_argument("--size", type=int, default=256, help="pixels a side of the maps (256)")
    p.add_argument("--width", type=int, default=960, help="of the photos, pixels (960)")
    p.add_argument("--spp", type=int, default=24, help="samples a pixel of ball and table (24)")
    p.add_argument("--first", type=int, default=0, help="number of the first sample (0)")
    p.add_argument("--numbers", type=int, nargs="+", default=NUMBERS, help="of photos")
    p.add_argument("--stages", nargs="+", choices=STAGES, default=STAGES)
    return p


def main(args: argparse.Namespace) -> None:
    if args.quick:
        count, size, width, spp, numbers = 1, 48, 640, 16, [1, 3]
        real, lamps, stages = (None, None), 3, [FOUND]
    else:
        count, size, width, spp, numbers = args.count, args.size, args.width, args.spp, args.numbers
        real, lamps, stages = (args.materials, args.envs), LAMP_PHOTOS, args.stages
    chosen = range(args.first, args.first + count)
    patterns = pattern_set(max(COUNTS))
    results, seen = kept(args.out)
    for stage in (*stages, NO_TABLET):
        for n in [lamps] if stage == NO_TABLET else numbers:
            results.setdefault(stage, {}).setdefault(n, [])
    networks = load_networks()

    def missing(sample: str, stage: str, number: int) -> bool:
        return all(row["sample"] != sample for row in results[stage][number])

    def keep() -> None:
        """What there is so far, which a run that is stopped leaves."""
        for by_number in results.values():
            for rows in by_number.values():
                rows.sort(key=lambda row: str(row["sample"]))
        share = float(np.mean([right for of_one in seen.values() for right in of_one]))
        content = {"rows": results, "recognised": seen, "bars": bars(results, share)}
        plot(results, args.out / "several.png")
        tables = {
            "errors over those of one photo": error_table(results),
            "errors over those of one photo, by sample": sample_table(results),
        }
        write_results(args.out, content, tables)

    def judge(
        found: Sequence[FoundLights | None], seconds: float, folders: Sequence[Path], stage: str
    ) -> None:
        """A row for the photos, whose lights took so long each; those without a ball are left out,
        as `invrender refine` does."""
        used = [(f, p) for f, p in zip(found, folders, strict=True) if f is not None]
        name = folders[0].parent.name
        try:
            row = measure([f for f, _ in used], [p for _, p in used], size, stage, networks)
        except InputError as error:
            print(f"{name}, {stage}, {len(found)}: {error}", flush=True)
            return
        row["processor_seconds"] += seconds * len(found)
        results[stage][len(found)].append({"sample": name, "used": len(used), **row})
        print(
            f"{name}, {stage}, {len(found)}: "
            + ", ".join(f"{kind} {row[kind]:.4f}" for kind in KINDS)
            + f"; photos {', '.join(f'{e:.3f}' for e in row['photos'])}"
            + f"; {row['processor_seconds']:.1f} processor s",
            flush=True,
        )
        keep()

    for k in chosen:
        folders, lit = make_set(
            args.out / "captures", k, max(numbers), lamps, size, width, spp, *real
        )
        sample = folders[0].parent.name
        wanted = [(stage, n) for stage in stages for n in numbers if missing(sample, stage, n)]
        if wanted:
            cpu = time.process_time()
            told = [find(folder, patterns[: max(numbers)], i) for i, folder in enumerate(folders)]
            found = [lights for lights, _ in told]
            seen[sample] = [right for _, right in told]
            cpu = (time.process_time() - cpu) / len(folders)
            if found[0] is None:  # there is no photo to compare with
                continue
            for stage, n in wanted:
                judge(found[:n], cpu, folders[:n], stage)
        if missing(sample, NO_TABLET, lamps):
            cpu = time.process_time()
            found = [find(folder, [], -1)[0] for folder in lit]
            judge(found, (time.process_time() - cpu) / len(lit), lit, NO_TABLET)
