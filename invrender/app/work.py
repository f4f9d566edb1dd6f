"""What a worker's process does for the app: check a photo, make maps, export, preview.

Every function's first argument tells its progress. What it makes, it writes into the capture's
folder; a whole answer is the last file that it writes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from invrender.app import store
from invrender.app.corrections import find_corrected_lights, turn_between, turned
from invrender.capture.orientation import find_ball_and_orientation
from invrender.colour import linear_to_srgb
from invrender.files.capture import Capture, load_capture
from invrender.files.images import Photo
from invrender.files.write import atomic_path
from invrender.maps import Maps, resize_maps
from invrender.report.inspection import outlines, summary
from invrender.report.page import SIGMA_TOP, block_means, heat, room_data, to_bytes, viewer_data
from invrender.rig import Rig
from invrender.types import Array, InputError

Tell = Callable[[Any], None]

PHOTO_PIXELS = 1600  # pixels, the longer side of the photo on the page
QUICK = 800  # pixels, of the copy in which ball and sample are looked for first
PREVIEW = 64  # pixels a side of the first, quick maps
THUMBNAIL = 320  # pixels a side
TILED = 512  # pixels a side of the previews of a tile and of the relief
WHITE_PERCENTILE = 99.0  # percentile of the photo that is drawn white
# The lamp of the thumbnail in sample sizes, its power, and the light from everywhere; by eye.
LAMP, LAMP_POWER, AMBIENT = (-0.6, 0.6, 1.2), 1.6, 0.35
# Share of the whole time at which a stage begins; medians of the bundled capture.
BEGINS = {
    "lights": 0.02, "preview": 0.15, "crop": 0.3, "read": 0.3, "forward model": 0.35,
    "initial maps": 0.4, "refine": 0.6, "render": 0.85, "write": 0.9,
}  # fmt: skip
ENDS = {"initial maps": 0.6, "refine": 0.8}  # of those that tell how far they are
ROOMS = {"studio": 3, "sky": 1, "night": 2}  # kinds of procedural environment, and their seeds


def warm(tell: Tell) -> None:
    """Load and compile what checks and maps need, before anybody waits for it."""
    from invrender.data import EXAMPLE
    from invrender.pipeline import reconstruct

    reconstruct(find_corrected_lights(load_capture(EXAMPLE), {}), size=PREVIEW)


def warm_check(tell: Tell) -> None:
    """Load what a check needs."""
    import invrender.pattern.guide  # noqa: F401


def warm_export(tell: Tell) -> None:
    """Load and compile what an export needs."""
    from invrender.export import rerender_error
    from invrender.maps import constant_maps

    maps = constant_maps(8, 8)
    rerender_error(maps, maps)


def check(tell: Tell, folder: str, number: int) -> dict[str, Any]:
    """Show a photo and what is found in it; returns what ``check.json`` then says.

    Tells first that the picture is there, then the outlines as they are found in a small copy.
    ``problem`` is the sentence of an `InputError`, else None; lengths are in pixels of the photo
    the right way round.
    """
    capture_folder, began = Path(folder), time.perf_counter()
    out = capture_folder / "shown" / str(number)
    out.mkdir(parents=True, exist_ok=True)
    sources = store.sources(capture_folder, number)
    fix = sources["fix"]
    answer: dict[str, Any] = {"problem": None, "fix": fix, "turn": fix.get("turn", 0)}
    try:
        capture = load_capture(capture_folder / "photos" / str(number))
        shown = turned(capture, answer["turn"])
        answer |= _show(shown.photo, out)
        nominal = shown.rig.project(shown.rig.sample_corners, shown.photo.height, shown.photo.width)
        answer["corners"] = fix.get("corners") or nominal.tolist()
        tell(answer)
        if not fix and max(shown.photo.image.shape) > QUICK:
            quick = _quick_look(capture)
            if quick:
                answer |= quick
                if quick["turn"]:
                    answer |= _show(turned(capture, quick["turn"]).photo, out)
                tell(answer)
        found = find_corrected_lights(capture, fix)
        store.keep(capture_folder, number, sources, found)
        turn = turn_between(capture.photo, found.capture.photo)
        if turn != answer["turn"]:
            answer |= _show(found.capture.photo, out)
        assert found.ball is not None
        rig, photo = found.lights.rig, found.capture.photo
        lines = outlines(rig, found.ball, photo.height, photo.width)
        answer |= {
            "turn": turn, "found": summary(found), "outlines": _plain(lines),
            "corners": lines["sample"].tolist(), "ball": [*found.ball.centre, found.ball.radius],
            "markers": [] if found.sheet is None else np.round(found.sheet.corners, 1).tolist(),
        }  # fmt: skip
    except InputError as error:
        answer["problem"] = _without_paths(str(error), capture_folder)
    answer["seconds"] = time.perf_counter() - began
    with atomic_path(out / "check.json") as path:
        path.write_text(json.dumps(answer), encoding="utf-8")
    return answer


def _without_paths(text: str, folder: Path) -> str:
    """A sentence without the places of files on this machine."""
    return (
        text.replace(f"{folder.resolve()}/", "")
        .replace(f"{folder}/", "")
        .replace("photos/", "photo ")
    )


def _quick_look(capture: Capture) -> dict[str, Any] | None:
    """Outlines in a small copy of the photo; None where the ball is not found in it."""
    photo = capture.photo
    image = block_means(photo.image[::2, ::2], QUICK)
    # Of both shapes a hemisphere is what it is first taken for: one search less.
    unknown = capture.unknown - {"ball_shape"}
    small = replace(capture, photo=replace(photo, image=image), unknown=unknown)
    scale = photo.width / small.photo.width
    if capture.fov_from == "unknown":
        return None
    try:
        found, ball, _ = find_ball_and_orientation(small)
    except InputError:
        return None
    lines = outlines(found.rig, ball, found.photo.height, found.photo.width)
    lines = {name: line * scale for name, line in lines.items()}
    x, y = ball.centre
    return {
        "turn": turn_between(small.photo, found.photo), "outlines": _plain(lines),
        "corners": lines["sample"].tolist(), "ball": [x * scale, y * scale, ball.radius * scale],
    }  # fmt: skip


def _plain(lines: dict[str, Array]) -> dict[str, list[list[float]]]:
    return {k: np.round(v[np.isfinite(v).all(-1)], 1).tolist() for k, v in lines.items()}


def _show(photo: Photo, out: Path) -> dict[str, Any]:
    """Write the photo as the page shows it, and where it is saturated; returns its size."""
    step = max(1, -(-max(photo.height, photo.width) // PHOTO_PIXELS))
    small = photo.image[::step, ::step] if step > 2 else block_means(photo.image, PHOTO_PIXELS)
    white = max(float(np.percentile(small, WHITE_PERCENTILE)), 1e-9)
    with atomic_path(out / "photo.jpg") as path:
        Image.fromarray(to_bytes(linear_to_srgb(small / white))).save(path, "JPEG", quality=88)
    clipped = photo.clipped
    share = float(clipped.mean())
    if step > 1:
        h, w = (n // step * step for n in clipped.shape)
        blocks = clipped[:h, :w].reshape(h // step, step, w // step, step)
        clipped = np.asarray(blocks.any((1, 3)))
    mask = Image.fromarray(clipped.astype(np.uint8), "P")
    mask.putpalette([0, 0, 0, 255, 60, 60])
    with atomic_path(out / "clipped.png") as path:
        mask.save(path, "PNG", transparency=0)
    return {"size": [photo.width, photo.height], "clipped": share, "shown": time.time()}


def refine(tell: Tell, folder: str, size: int, init: str) -> None:
    """Make a capture's maps: at once small ones to look at, then the result."""
    from invrender.pipeline import reconstruct

    place = Path(folder)
    content = store.read(place)
    stage = lambda name: tell({"stage": name, "share": share_done(name)})  # noqa: E731
    found = []
    for number in store.photo_numbers(place):
        stage("lights")
        lights = store.kept(place, number)
        if lights is None:
            capture = load_capture(place / "photos" / str(number))
            lights = find_corrected_lights(capture, content["fixes"].get(str(number), {}))
        found.append(replace(lights, capture=replace(lights.capture, name=content["name"])))
    stage("preview")
    if size > PREVIEW:
        first = reconstruct(found, size=PREVIEW, init=init)
        _preview(first.maps, first.rendering, place)
        tell({"preview": time.time()})
    result = reconstruct(found, size=size, init=init, progress=stage)
    _preview(result.maps, result.rendering, place)
    tell({"preview": time.time()})
    stage("write")
    _write_views(result.maps, result.estimate.sigma, result.lights.environment, place / "shown")
    # One name for the capture, not one a photo.
    result = replace(result, report=replace(result.report, capture=content["name"]))
    result.save(place / "result")


def share_done(stage: str) -> float:
    """How much of the whole is done where a stage says that it begins, or how far it is."""
    name, _, rest = stage.partition(": ")
    begin = BEGINS.get(name, 0.0)
    if rest.endswith("%") and name in ENDS:
        return begin + (ENDS[name] - begin) * float(rest[:-1]) / 100
    return begin


def _preview(maps: Maps, rendering: Array | None, place: Path) -> None:
    """Pictures of the maps so far."""
    out = place / "shown"
    out.mkdir(exist_ok=True)
    images = {k: _display(k, v) for k, v in maps.encoded().items()}
    if rendering is not None:
        white = max(float(np.percentile(rendering, WHITE_PERCENTILE)), 1e-12)
        images["render"] = linear_to_srgb(rendering / white)
        images["lit"] = linear_to_srgb(_lit(maps))
    for name, image in images.items():
        with atomic_path(out / f"preview_{name}.jpg") as path:
            small = Image.fromarray(to_bytes(block_means(image, TILED)))
            small.save(path, "JPEG", quality=90)


def _lit(maps: Maps) -> Array:
    """The maps under a lamp and a little light from everywhere, for a card of the page."""
    from invrender.render.point_lights import relight

    rig = Rig()
    small = resize_maps(maps, *(min(n, THUMBNAIL) for n in maps.shape))
    lamp = np.array([LAMP]) * rig.sample_size
    return AMBIENT * (small.diffuse + small.specular) + LAMP_POWER * relight(small, rig, lamp)[0]


def _display(name: str, encoded: Array) -> Array:
    return encoded if name in ("normal", "roughness") else linear_to_srgb(encoded)


def _write_views(maps: Maps, sigma: dict[str, Array], environment: Array, out: Path) -> None:
    """What the result's page reads: the viewer's data, the expected errors, a thumbnail."""
    out.mkdir(exist_ok=True)
    with atomic_path(out / "viewer.json") as path:
        path.write_text(json.dumps(viewer_data(maps, environment)), encoding="utf-8")
    # Without the tag of a linear PNG, by which a browser would draw data as if it were light.
    for name, image in maps.encoded().items():
        with atomic_path(out / f"map_{name}.jpg") as path:
            shown = Image.fromarray(to_bytes(_display(name, image)))
            shown.save(path, "JPEG", quality=95, subsampling=0)
    for name, error in sigma.items():
        spread = np.sqrt(np.mean(error**2, -1)) if error.ndim == 3 else error
        with atomic_path(out / f"sigma_{name}.jpg") as path:
            Image.fromarray(to_bytes(heat(spread / SIGMA_TOP))).save(path, "JPEG", quality=90)


def views(tell: Tell, folder: str) -> None:
    """Write anew what the result's page reads."""
    from invrender.report.result import Result

    place = Path(folder)
    result = Result.load(place / "result")
    _preview(result.maps, result.render(), place)
    _write_views(result.maps, result.estimate.sigma, result.lights.environment, place / "shown")


def rooms(tell: Tell) -> dict[str, Any]:
    """Rooms other than the captured one, as the viewer reads them."""
    from invrender.data.environments import procedural_environment

    return {
        kind: room_data(procedural_environment(seed=seed, kind=kind, height=64))
        for kind, seed in ROOMS.items()
    }


def export(tell: Tell, folder: str, target: str, options: dict[str, Any]) -> dict[str, Any]:
    """Write a result for another program into ``exports``; returns the file's name, and what the
    conversion costs."""
    from invrender.export import TARGETS
    from invrender.export import export as write
    from invrender.export.textures import safe_name

    place = Path(folder)
    out = place / "exports"
    out.mkdir(exist_ok=True)
    if target not in TARGETS:
        raise InputError(f"no export target '{target[:40]}'")
    name = safe_name(options.get("name") or store.read(place)["name"])
    parts = [name, target, *(w for w in ("tileable", "height") if options.get(w))]
    file = out / ("-".join(parts) + (TARGETS[target].single or ".zip"))
    done = write(place / "result", file, target, **{**options, "name": name})
    return {**asdict(done), "file": file.name, "path": None, "bytes": file.stat().st_size}


def tile(tell: Tell, folder: str) -> dict[str, Any]:
    """Pictures of the sample repeated, as it is and seamless, and of its relief."""
    from invrender.data.materials import read_material
    from invrender.export.tileable import make_tileable
    from invrender.render.height import height_from_normals
    from invrender.report.report import Report

    place = Path(folder)
    maps = read_material(place / "result")
    width = Report.read(place / "result").sample_size
    seamless, seams = make_tileable(maps)
    for name, shown in {"repeated": maps, "tile": seamless}.items():
        image = block_means(linear_to_srgb(shown.diffuse), TILED // 2)
        with atomic_path(place / "shown" / f"{name}.jpg") as path:
            Image.fromarray(to_bytes(np.tile(image, (2, 2, 1)))).save(path, "JPEG", quality=90)
    relief = height_from_normals(maps.normal, width / maps.shape[1], periodic=False)
    low, high = np.percentile(relief.height, (0.5, 99.5))
    grey = (relief.height - low) / max(float(high - low), 1e-12)
    with atomic_path(place / "shown" / "height.jpg") as path:
        Image.fromarray(to_bytes(block_means(grey, TILED))).save(path, "JPEG", quality=90)
    return {
        "seams": asdict(seams), "span": float(high - low), "outliers": relief.outliers,
    }  # fmt: skip


def guide(tell: Tell, rig: Rig, file: str) -> None:
    """The printed guide of a rig as a PDF."""
    from invrender.pattern.guide import write_guide

    write_guide(Path(file), rig)
