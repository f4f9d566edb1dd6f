"""Refinement on simulated captures: maps, re-rendering, uncertainty and time, before and after.

Whole photographs are path-traced (`benchmarks.common.captures`) and every capture is refined from
its photo alone, with estimated lights; from the network's maps and, beside it, from a flat start.
What the estimate costs is told by the network's start with the true lights. The photographs are of
materials and rooms of holdout.txt, looked at during development; ``--others`` adds as many of
holdout_families.txt, with other noise and seeds: only for a final run, they are the ones that
count (parts of materials of which development has seen others). Captures are kept in DIR/captures
and DIR/others: a rerun only refines. Without folders, and with --quick, materials and rooms are
procedural.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.captures import OTHERS, PHOTOGRAPHS, arguments, make_captures, true_lights
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import Bar, Table, bar, table, write_results
from invrender.capture.lights import find_lights
from invrender.capture.sample import Sample
from invrender.data import EXAMPLE
from invrender.files.capture import load_capture
from invrender.maps import NAMES, Maps, constant_maps, map_errors, resize_maps
from invrender.pipeline import Stages, estimate_maps
from invrender.refine.checks import coarse_error, photo_error
from invrender.refine.theta import deviations
from invrender.render.point_lights import rerender
from invrender.render.renderer import Renderer
from invrender.report.metrics import calibration
from invrender.report.notices import POOR_FIT
from invrender.types import Array, InputError

TRUE = "network, true lights"
INITS = ("network", "flat", TRUE)
SETS = {"photographs": PHOTOGRAPHS, "others": OTHERS}
FOLDERS = {"photographs": "captures", "others": "others"}
WHEN = ("initial", "refined")
GLOSSY = 0.45  # median roughness of a sample on which the light's pattern shows
FLAT = {"normal": 0.01, "roughness": 0.03, "specular": 0.02}  # deviations of flat, homogeneous maps
SAMPLES = 256  # of the renders that are compared with the photo

Row = dict[str, Any]


def rerender_error(maps: Maps, truth: Maps) -> float:
    """RMSE under nine point lights, as displayed."""
    return float(np.sqrt(np.mean((rerender(maps) - rerender(truth)) ** 2, dtype=np.float64)))


def pattern_in_albedo(maps: Maps, truth: Maps, renderer: Renderer) -> tuple[float, float] | None:
    """Correlation of the found and of the true albedo with the light's pattern, if that shows.

    The pattern is the highlight that a plane of the sample's median roughness would show; the
    albedo is diffuse and specular together; the correlation's size is averaged over the channels.
    None for a sample that is not glossy: its pattern is too smooth to tell from its own shades.
    """
    roughness = float(np.median(truth.roughness))
    if roughness > GLOSSY:
        return None
    lobe = renderer.render(constant_maps(*truth.shape, 0.0, 0.5, roughness), SAMPLES)
    return tuple(correlation(m.diffuse + m.specular, lobe) for m in (maps, truth))  # type: ignore[return-value]


def correlation(a: Array, b: Array) -> float:
    """Mean size of Pearson's correlation of two images' channels; a flat channel has none."""
    found = []
    for c in range(a.shape[2]):
        x, y = (image[..., c].astype(np.float64) for image in (a, b))
        x, y = x - x.mean(), y - y.mean()
        scale = np.sqrt((x * x).mean() * (y * y).mean())
        found.append(abs((x * y).mean()) / scale if scale > 1e-9 else 0.0)
    return float(np.mean(found))


def expected_noise(photo: Array, level: float, noise: float) -> float:
    """RMS of the sensor's noise over the mean, of pixels that are taken over as they are.

    noise: of a pixel at ``level``; it grows with the root of the radiance.
    """
    return noise * float(np.sqrt(level / photo.mean()))


def is_flat(truth: Maps) -> bool:
    """Whether relief, roughness and specular albedo are those of one flat, homogeneous material."""
    maps = truth.encoded()
    return all(float(maps[n].std((0, 1)).max()) <= most for n, most in FLAT.items())


def measure(folder: Path, size: int, init: str, noise: float | None = None) -> Row:
    """Refine a capture and compare with its truth; noise: of the sensor, where it is known."""
    stage = Stages()
    cpu = time.process_time()
    with stage("read"):
        capture = load_capture(folder)
    with stage("lights"):
        found = find_lights(capture)
    if init == TRUE:
        found, init = replace(found, lights=true_lights(folder, found.capture)), "network"
    sample = Sample.of(found, size)
    start, result, (shot,) = estimate_maps([sample], stage, init)
    cpu = time.process_time() - cpu
    assert capture.truth is not None
    truth, renderer = resize_maps(capture.truth, size, size), shot.renderer
    done = sum(stage.seconds.values())
    shares = calibration(result.maps, truth, deviations(result.sigma))
    row: Row = {
        "capture": folder.name,
        "jpeg": capture.photo.clip_level is not None,
        "seconds_initial": done - stage.seconds["refine"],
        "seconds_refined": done,
        "processor_seconds": cpu,
        "stages": stage.seconds,
        "coverage": shares,
        "covered": float(np.mean(list(shares.values()))),
        "converged": result.converged,
        "pattern": pattern_in_albedo(result.maps, truth, renderer),
    }
    for when, maps in zip(WHEN, (start, result.maps), strict=True):
        shown = renderer.render(maps, SAMPLES)
        row[f"photo_{when}"] = photo_error(shown, sample.photo, sample.clipped)
        for name, error in map_errors(maps, truth).items():
            row[f"{name}_{when}"] = error
        row[f"rerender_{when}"] = rerender_error(maps, truth)
    row["coarse"] = coarse_error(shown, sample.photo, sample.clipped)
    row["warned"] = row["coarse"] > POOR_FIT[init]
    if noise is not None and not row["jpeg"] and is_flat(truth):
        level = float(np.percentile(capture.photo.image, 99))
        row["photo_over_noise"] = row["photo_refined"] / expected_noise(sample.photo, level, noise)
    return row


def pooled(rows: Sequence[Row], name: str) -> float:
    """RMSE over all captures together; ``average`` is the mean of the four maps'."""
    kind, when = name.rsplit("_", 1)
    if kind == "average":
        return float(np.mean([pooled(rows, f"{n}_{when}") for n in NAMES]))
    return float(np.sqrt(np.mean([r[name] ** 2 for r in rows])))


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """Pooled errors before and after, what is left of the photos, and the medians of the times."""
    ratios = [r["average_refined"] / r["average_initial"] for r in rows]
    stages = list(dict.fromkeys(n for r in rows for n in r["stages"]))
    patterns = [found - true for found, true in (r["pattern"] for r in rows if r["pattern"])]
    noises = [r["photo_over_noise"] for r in rows if "photo_over_noise" in r]
    return {
        "captures": len(rows),
        "errors": {
            n: [pooled(rows, f"{n}_{when}") for when in WHEN]
            for n in (*NAMES, "average", "rerender")
        },
        "improved": float(np.mean([r < 1 for r in ratios])),
        "worst": max(ratios),
        "photo": {
            when: {"median": float(np.median(some)), "worst": max(some)}
            for when, some in ((when, [r[f"photo_{when}"] for r in rows]) for when in WHEN)
        },
        "glossy": len(patterns),
        "pattern": float(np.median(patterns)) if patterns else None,
        "photo_over_noise": float(np.median(noises)) if noises else None,
        "coverage": {n: float(np.mean([r["coverage"][n] for r in rows])) for n in NAMES},
        "warned": float(np.mean([r["warned"] for r in rows])),
        "seconds": {
            n: float(np.median([r[n] for r in rows]))
            for n in ("seconds_initial", "seconds_refined", "processor_seconds")
        },
        "stages": {n: float(np.median([r["stages"].get(n, 0.0) for r in rows])) for n in stages},
    }  # fmt: skip


def bars(kind: str, s: dict[str, Any]) -> list[Bar]:
    """The bars of refining the network's maps on one set of captures."""
    ratio = {n: after / before for n, (before, after) in s["errors"].items()}
    shares, photo = s["coverage"].values(), s["photo"]["refined"]
    spent = s["seconds"]["seconds_refined"] - s["seconds"]["seconds_initial"]
    lines: list[tuple[str, float | None, float, bool]] = [
        ("average map RMSE, refined over network", ratio["average"], 0.75, False),
        ("share of captures improved", s["improved"], 0.95, True),
        ("worst capture, refined over network", s["worst"], 1.03, False),
        ("worst map, refined over network", max(ratio[n] for n in NAMES), 0.98, False),
        ("roughness, refined over network", ratio["roughness"], 0.75, False),
        ("photo unexplained, RMS over mean, median", photo["median"], 0.04, False),
        ("photo unexplained, worst", photo["worst"], 0.12, False),
        ("the same over the noise, flat samples", s["photo_over_noise"], 2.0, False),
        ("correlation with the light's pattern, above the truth's", s["pattern"], 0.02, False),
        ("re-render RMSE, refined over network", ratio["rerender"], 0.65, False),
        ("coverage within one sigma, least map", min(shares), 0.60, True),
        ("coverage within one sigma, greatest map", max(shares), 0.76, False),
        ("seconds after the initial maps, median", spent, 3.0, False),
    ]
    return [
        bar(f"{kind}: {name}", value, target, at_least)
        for name, value, target, at_least in lines
        if value is not None
    ]


def bundled_bars(row: Row) -> list[Bar]:
    """The bars of the capture that comes with the package."""
    return [
        bar("bundled capture: average map RMSE", row["average_refined"], 0.04, False),
        bar("bundled capture: photo unexplained", row["photo_refined"], 0.06, False),
    ]


def lights_cost(results: dict[str, list[Row]]) -> Table:
    """Average map RMSE with the lights found and with the true ones."""
    lines = []
    for name, kinds in (("all", (False, True)), ("HDR", (False,)), ("JPEG", (True,))):
        some = [[r for r in results[i] if r["jpeg"] in kinds] for i in ("network", TRUE)]
        if some[0]:
            found, true = (pooled(rows, "average_refined") for rows in some)
            lines.append([name, found, true, found / true])
    return table(["average map RMSE", "lights found", "true lights", "ratio"], lines)


def tables(results: dict[str, list[Row]], summaries: dict[str, Any]) -> dict[str, Table]:
    """Of one set of captures: errors and stages by start, and what estimated lights cost."""
    found = {}
    for init, s in summaries.items():
        found[f"from {init}"] = table(
            ["RMSE", *WHEN, "ratio", "within one sigma"],
            [[n, *e, e[1] / e[0], s["coverage"].get(n)] for n, e in s["errors"].items()],
        )
    found["captures"] = table(
        ["", *summaries],
        [
            ["share improved", *(s["improved"] for s in summaries.values())],
            ["worst, refined over initial", *(s["worst"] for s in summaries.values())],
            *(
                [f"photo unexplained, {when}, {what}",
                 *(s["photo"][when][what] for s in summaries.values())]
                for when in WHEN for what in ("median", "worst")
            ),
            ["pattern in albedo, above the truth's", *(s["pattern"] for s in summaries.values())],
            ["warned of", *(s["warned"] for s in summaries.values())],
        ],
    )  # fmt: skip
    stages = list(dict.fromkeys(n for s in summaries.values() for n in s["stages"]))
    found["seconds"] = table(
        ["stage, median seconds", *summaries],
        [
            *([n, *(s["stages"].get(n) for s in summaries.values())] for n in stages),
            ["all", *(s["seconds"]["seconds_refined"] for s in summaries.values())],
        ],
    )
    if {"network", TRUE} <= set(results):
        found["lights"] = lights_cost(results)
    return found


def plot(results: dict[str, dict[str, list[Row]]], file: Path) -> None:
    """Map and re-render error against run time: a thin line a capture, a thick one for all."""
    panels: Any = {}
    thin: Any = {}
    for kind, starts in results.items():
        for name in ("average", "rerender"):
            title = f"{kind}, {name}"
            panels[title], thin[title] = {}, {}
            for init, rows in starts.items():
                s = summarise(rows)
                seconds = [s["seconds"][f"seconds_{when}"] for when in WHEN]
                panels[title][init] = (seconds, s["errors"][name])
                thin[title][init] = [
                    tuple([r[f"{what}_{when}"] for when in WHEN] for what in ("seconds", name))
                    for r in rows
                ]
    plot_error_over_time(file, panels, thin, y="RMSE", columns=2)


def parser() -> argparse.ArgumentParser:
    p = arguments(__doc__, "a small procedural capture of each set", 24)
    p.add_argument("--init", choices=INITS, action="append", help="only this start")
    p.add_argument("--others", action="store_true", help="for a final run: the other captures too")
    return p


def main(args: argparse.Namespace) -> None:
    count, size, width, spp = (1, 96, 720, 24) if args.quick else (args.count, 256, 960, 32)
    real = (None, None) if args.quick else (args.materials, args.envs)
    inits = args.init or INITS
    results: dict[str, dict[str, list[Row]]] = {}
    refused: dict[str, dict[str, str]] = {}
    bundled = measure(EXAMPLE, size, inits[0])  # the first loads libraries, compiles kernels
    for kind, drawn in SETS.items():
        if kind == "others" and not (args.others or args.quick):
            continue
        folders = make_captures(args.out / FOLDERS[kind], drawn, count, size, width, spp, *real)
        results[kind], refused[kind] = {}, {}
        for init in inits:
            rows = results[kind][init] = []
            for k, folder in enumerate(folders):
                try:
                    r = measure(folder, size, init, drawn.noise_of(k))
                except InputError as error:
                    refused[kind][folder.name] = str(error)
                    print(f"{kind} {folder.name} is refused: {error}", flush=True)
                    continue
                rows.append(r)
                print(
                    f"{kind} {folder.name}, {init}: maps {r['average_initial']:.4f} →"
                    f" {r['average_refined']:.4f}, photo {r['photo_refined']:.3f}, re-render"
                    f" {r['rerender_initial']:.4f} → {r['rerender_refined']:.4f},"
                    f" {r['seconds_refined']:.1f} s",
                    flush=True,
                )
    summaries = {
        kind: {init: summarise(rows) for init, rows in starts.items()}
        for kind, starts in results.items()
    }
    plot(results, args.out / "refine.png")
    shown = {
        f"{kind}, {name}": t
        for kind, starts in results.items()
        for name, t in tables(starts, summaries[kind]).items()
    }
    reached = [
        b for kind, s in summaries.items() if "network" in s for b in bars(kind, s["network"])
    ]
    reached += [bar(f"{k}: captures refused", len(r), 0, False) for k, r in refused.items()]
    content: dict[str, Any] = {"summaries": summaries, "rows": results, "refused": refused}
    if inits[0] == "network":
        content["bundled"] = bundled
        reached += bundled_bars(bundled)
    write_results(args.out, {**content, "bars": reached}, shown)
