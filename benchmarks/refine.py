"""Refinement on simulated captures: maps, re-rendering, uncertainty and time, before and after.

Whole photographs are path-traced (`benchmarks.common.captures`) and every capture is refined from
its photo alone, with estimated lights; from the network's maps and, beside it, from a flat start.
What the estimate costs is told by the network's start with the true lights. Captures are kept in
DIR/captures: a rerun only refines. Without folders, materials and rooms are procedural.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.captures import arguments, make_captures, true_lights
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import Table, bar, table, write_results
from invrender.capture.crop import crop_mask, crop_sample
from invrender.maps import NAMES, Maps, map_errors, resize_maps
from invrender.pipeline import POOR_FIT, Seen, Stages, recover, see
from invrender.refine.checks import coarse_error
from invrender.render.point_lights import rerender
from invrender.report.results import deviations

TRUE = "network, true lights"
INITS = ("network", "flat", TRUE)
SURE = 0.68  # of a Gaussian within one sigma


def rerender_error(maps: Maps, truth: Maps) -> float:
    """RMSE under nine point lights, as displayed."""
    return float(np.sqrt(np.mean((rerender(maps) - rerender(truth)) ** 2, dtype=np.float64)))


def coverage(maps: Maps, truth: Maps, sigma: dict[str, Any]) -> dict[str, float]:
    """Share of the truth within one standard deviation; of normals x and y, encoded."""
    found, true = maps.encoded(), truth.encoded()
    shares = {}
    for name, s in sigma.items():
        a, b = (x[name][..., :2] if name == "normal" else x[name] for x in (found, true))
        s = s[..., None] if a.ndim > s.ndim else s
        shares[name] = float((np.abs(a - b) <= s).mean())
    return shares


def relit(folder: Path, size: int, seen: Seen) -> Seen:
    """The capture with its true lights, and the crop of the true rig."""
    photo, lights = seen.capture.photo, true_lights(folder, seen.capture)
    crop = crop_sample(photo, lights.rig, size)
    return replace(seen, lights=lights, photo=crop, clipped=crop_mask(photo, lights.rig, size))


def measure(folder: Path, size: int, init: str) -> dict[str, Any]:
    """Refine a capture and compare with its truth."""
    stage = Stages()
    cpu = time.process_time()
    seen = see(folder, size, stage)
    if init == TRUE:
        seen, init = relit(folder, size, seen), "network"
    start, result, shots = recover([seen], stage, init=init)
    cpu = time.process_time() - cpu
    assert seen.capture.truth is not None
    truth = resize_maps(seen.capture.truth, size, size)
    done = sum(stage.seconds.values())
    shares = coverage(result.maps, truth, deviations(result.sigma))
    row: dict[str, Any] = {
        "capture": folder.name,
        "jpeg": seen.capture.photo.clip_level is not None,
        "seconds_initial": done - stage.seconds["refine"] - stage.seconds.get("materials", 0.0),
        "seconds_refined": done,
        "processor_seconds": cpu,
        "stages": stage.seconds,
        "coverage": shares,
        "covered": float(np.mean(list(shares.values()))),
        "converged": result.converged,
        "coarse": coarse_error(shots[0].renderer.render(result.maps, 64), seen.photo, seen.clipped),
    }
    row["warned"] = row["coarse"] > POOR_FIT[init]
    for when, maps in (("initial", start), ("refined", result.maps)):
        for name, error in map_errors(maps, truth).items():
            row[f"{name}_{when}"] = error
        row[f"rerender_{when}"] = rerender_error(maps, truth)
    return row


def pooled(rows: list[dict[str, Any]], name: str) -> float:
    """RMSE over all captures together; ``average`` is the mean of the four maps' (design, 8)."""
    kind, when = name.rsplit("_", 1)
    if kind == "average":
        return float(np.mean([pooled(rows, f"{n}_{when}") for n in NAMES]))
    return float(np.sqrt(np.mean([r[name] ** 2 for r in rows])))


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Pooled errors before and after, and the medians of the times."""
    errors = {
        n: [pooled(rows, f"{n}_initial"), pooled(rows, f"{n}_refined")]
        for n in (*NAMES, "average", "rerender")
    }
    better = [r["average_refined"] < r["average_initial"] for r in rows]
    shares = {n: float(np.mean([r["coverage"][n] for r in rows])) for n in NAMES}
    names = list(dict.fromkeys(n for r in rows for n in r["stages"]))
    return {
        "errors": errors,
        "improved": float(np.mean(better)),
        "coverage": shares,
        "warned": float(np.mean([r["warned"] for r in rows])),
        "seconds": {
            n: float(np.median([r[n] for r in rows]))
            for n in ("seconds_initial", "seconds_refined", "processor_seconds")
        },
        "stages": {n: float(np.median([r["stages"].get(n, 0.0) for r in rows])) for n in names},
    }


def lights_cost(results: dict[str, list[dict[str, Any]]]) -> Table:
    """Average map RMSE with the lights found and with the true ones."""
    lines = []
    for name, kinds in (("all", (False, True)), ("HDR", (False,)), ("JPEG", (True,))):
        some = [[r for r in results[i] if r["jpeg"] in kinds] for i in ("network", TRUE)]
        if some[0]:
            found, true = (pooled(rows, "average_refined") for rows in some)
            lines.append([name, found, true, found / true])
    return table(["average map RMSE", "lights found", "true lights", "ratio"], lines)


def bars(summary: dict[str, Any]) -> list[dict[str, Any]]:
    """The bars of refining the network's maps."""
    ratio = {n: after / before for n, (before, after) in summary["errors"].items()}
    covered = float(np.mean(list(summary["coverage"].values())))
    return [
        bar("average map RMSE, refined over network", ratio["average"], 0.9, at_least=False),
        bar("share of captures improved", summary["improved"], 0.8, at_least=True),
        bar("worst map, refined over network", max(ratio[n] for n in NAMES), 1, at_least=False),
        bar("re-render RMSE, refined over network", ratio["rerender"], 0.8, at_least=False),
        bar("seconds, median", summary["seconds"]["seconds_refined"], 20, at_least=False),
        bar("seconds to initial maps", summary["seconds"]["seconds_initial"], 1.8, at_least=False),
        bar("coverage's distance from 68%", abs(covered - SURE), 0.08, at_least=False),
    ]


def plot(results: dict[str, list[dict[str, Any]]], file: Path) -> None:
    """Map and re-render error against run time: a thin line a capture, a thick one for all."""
    panels: Any = {"average map": {}, "re-render": {}}
    thin: Any = {title: {} for title in panels}
    for title, name in zip(panels, ("average", "rerender"), strict=True):
        for init, rows in results.items():
            s = summarise(rows)
            x = [s["seconds"]["seconds_initial"], s["seconds"]["seconds_refined"]]
            panels[title][init] = (x, s["errors"][name])
            thin[title][init] = [
                ([r["seconds_initial"], r["seconds_refined"]],
                 [r[f"{name}_initial"], r[f"{name}_refined"]])
                for r in rows
            ]  # fmt: skip
    plot_error_over_time(file, panels, thin, y="RMSE")


def parser() -> argparse.ArgumentParser:
    p = arguments(__doc__, "two small captures", 24)
    p.add_argument("--init", choices=INITS, action="append", help="only this start")
    return p


def main(args: argparse.Namespace) -> None:
    count, size, width, spp = (2, 96, 720, 24) if args.quick else (args.count, 256, 960, 32)
    folders = make_captures(
        args.out / "captures", count, size, width, spp, args.materials, args.envs
    )

    results: dict[str, list[dict[str, Any]]] = {}
    inits = args.init or INITS
    measure(folders[0], size, inits[0])  # loads libraries, compiles kernels
    for init in inits:
        rows = results[init] = []
        for folder in folders:
            rows.append(measure(folder, size, init))
            r = rows[-1]
            print(
                f"{init} {folder.name}: maps {r['average_initial']:.4f} →"
                f" {r['average_refined']:.4f}, re-render {r['rerender_initial']:.4f} →"
                f" {r['rerender_refined']:.4f}, {r['seconds_refined']:.1f} s",
                flush=True,
            )
    summaries = {init: summarise(rows) for init, rows in results.items()}
    plot(results, args.out / "refine.png")
    reached = bars(summaries["network"]) if "network" in summaries else []
    content = {"summaries": summaries, "rows": results, "bars": reached}
    write_results(args.out, content, tables(results, summaries))


def tables(results: dict[str, list[dict[str, Any]]], summaries: dict[str, Any]) -> dict[str, Table]:
    """Errors and stages by start, and what it costs to estimate the lights."""
    found = {}
    for init, s in summaries.items():
        found[f"from {init}"] = table(
            ["RMSE", "initial", "refined", "ratio", "within one sigma"],
            [[n, *e, e[1] / e[0], s["coverage"].get(n)] for n, e in s["errors"].items()],
        )
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
