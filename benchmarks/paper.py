"""The paper's evaluation: every method, clue and perturbation, on held-out captures.

All methods of `benchmarks.baselines` have one size and were trained on the same captures for the
same processor time; rows called "shipped" are the program's own networks, trained longer. The
captures are `benchmarks.common.held_out`'s: --materials and --envs name the folders of which the
held-out part is drawn; without, and with --quick, materials and rooms are procedural. Errors are of
maps of 64 pixels a side, re-renderings under nine point lights. What is measured is kept in
DIR/rows, one file a capture: a rerun measures what is missing. Perturbations (Fig. 15) are of whole
path-traced photographs, kept in DIR/captures.
"""

from __future__ import annotations

import argparse
import json
import time
import tomllib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.baselines import deepbasis, matfusion
from benchmarks.baselines.flash import SIZE
from benchmarks.baselines.methods import METHODS, parameters, trained, training_notes
from benchmarks.common.captures import arguments
from benchmarks.common.held_out import FIRST_SEED, HeldOut, draw, draw_setting, photograph
from benchmarks.common.lpips import Lpips
from benchmarks.common.paper_pictures import draw_clues, draw_denoised, draw_maps, draw_perturbed
from benchmarks.common.perturbed import GREY_FREE, KINDS, METHODS_OF_RIG, measure_perturbed
from benchmarks.common.plot import plot_error_over_time
from benchmarks.common.results import Bar, Table, bar, table, write_results
from invrender.maps import NAMES, Maps, map_errors, resize_maps
from invrender.pattern.default import default_pattern
from invrender.pipeline import Stages, estimate_maps
from invrender.render.point_lights import GAMMA, grid_lights, relight
from invrender.report.metrics import flip
from invrender.rig import Rig
from invrender.types import Array, InputError
from nets.batch import Batch
from nets.model import encode, normalise
from nets.predict import WEIGHTS as PROGRAM
from nets.predict import Reconstructor, estimate_of

NUMBERS = Path(__file__).with_name("paper_numbers.toml")
SHOWN = 4  # captures whose pictures are drawn
PERFECT = 6  # captures under a pattern that the ball shows without a mosaic
JUDGED = (0, 4, 8)  # of the nine re-rendered images: LPIPS and FLIP take as long as all else
# The program's first network by the real materials that it saw: the state before its training went
# on with more of them, and the shipped one.
TRAINED_ON = {"64": "training/small-64.safetensors", "245": "small.safetensors"}
LONGEST = 128  # pixels a side of captures, as of the shipped networks' training

# Rows of Table 1 by key: what they are called.
ROWS = {
    "ours": "ours, one photo",
    "ours-refined": "ours, refined",
    "paper": "the paper's clues and denoiser",
    "lpl+": "LPL+ (no clues)",
    "lpl++": "LPL++ (with the denoiser)",
    "mirror-ball": "MirrorBall",
    "coloured-clues": "ColoredNLCs",
    "plane-clues": "PlaneLCs",
    "deepbasis": "DeepBasis+, before its refinement",
    "deepbasis+": "DeepBasis+",
    "matfusion-best": "MatFusion, best seed",
    "matfusion": "MatFusion, mean of the seeds",
    "shipped": "ours, shipped, one photo",
    "shipped-refined": "ours, shipped, refined",
}
# Methods of `benchmarks.baselines.methods` of rows that are called otherwise; none of the shipped.
METHOD_OF = {
    "ours-refined": "ours", "deepbasis": "deepbasis+", "matfusion-best": "matfusion",
    "shipped": None, "shipped-refined": None,
}  # fmt: skip
EQUAL = [k for k in ROWS if not k.startswith("shipped")]
COLUMNS = (*NAMES, "average", "rerender", "lpips", "flip")
BARS = (("lpl+", 0.75), ("deepbasis+", 0.35), ("matfusion", 0.45))

Row = dict[str, Any]


# --- Table 1 --------------------------------------------------------------------------------------


def answers(capture: HeldOut, batch: Batch, steps: int) -> dict[str, tuple[list[Maps], float]]:
    """Maps of every row, several of MatFusion's, and the processor seconds that they took."""
    found: dict[str, tuple[list[Maps], float]] = {}

    def add(name: str, answer: Callable[[], Any]) -> Any:
        began = time.process_time()
        with torch.no_grad():
            out = answer()
        spent = time.process_time() - began
        found[name] = [estimate_of(out, 1.0).maps], spent
        return out

    for name in METHODS:
        if name in ("deepbasis+", "matfusion"):
            continue
        network = trained(name)
        out = add(name, partial(network, batch))
        if name == "ours":
            began = time.process_time()
            refined = refined_maps(capture.at(SIZE), estimate_of(out, 1.0))
            found["ours-refined"] = [refined], time.process_time() - began + found[name][1]
    basis = trained("deepbasis+")
    add("deepbasis", partial(basis, batch))
    with torch.enable_grad():
        began = time.process_time()
        out = deepbasis.refine(basis, batch, steps)
        found["deepbasis+"] = [estimate_of(out, 1.0).maps], time.process_time() - began
    prior = trained("matfusion")
    began = time.process_time()
    draws = [estimate_of(prior.draw(batch, s), 1.0).maps for s in range(matfusion.SEEDS)]
    spent = time.process_time() - began
    errors = [map_errors(m, capture.at(SIZE).maps)["average"] for m in draws]
    found["matfusion"] = draws, spent / len(draws)
    found["matfusion-best"] = [draws[int(np.argmin(errors))]], spent
    stage = Stages()
    began = time.process_time()
    start, refined_all, _ = estimate_maps([capture.sample], stage)
    spent = time.process_time() - began
    share = 1 - stage.seconds["refine"] / sum(stage.seconds.values())
    found["shipped"] = [resize_maps(start, SIZE, SIZE)], spent * share
    found["shipped-refined"] = [resize_maps(refined_all.maps, SIZE, SIZE)], spent
    return found


def refined_maps(capture: HeldOut, estimate: Any) -> Maps:
    """The pipeline's refinement of an estimate, without the learned correction."""
    from invrender.refine.estimate import observe
    from invrender.refine.posterior import explain
    from invrender.refine.priors import network_prior
    from invrender.refine.shared import share

    sample = capture.sample
    observation = observe(sample.photo, sample.lights, sample.clipped)
    prior = network_prior(estimate.maps, estimate.sigma)
    known = share([observation], prior)
    return explain(known.observations, known.prior).maps


def errors_of(
    maps: Maps, truth: Maps, references: Array, lpips: Lpips | None
) -> dict[str, float | None]:
    """Of maps, and of their re-renderings: RMSE of all nine, of `JUDGED` LPIPS as displayed and
    HDR-FLIP of radiance. references: radiance under the nine lights of the truth."""
    linear = relight(maps, Rig(), grid_lights(Rig()))
    pairs = [(as_displayed(linear[i]), as_displayed(references[i])) for i in range(len(linear))]
    out: dict[str, float | None] = dict(map_errors(maps, truth))
    squares = [np.mean((a - b) ** 2, dtype=np.float64) for a, b in pairs]
    out["rerender"] = float(np.sqrt(np.mean(squares)))
    out["lpips"] = _mean([lpips(*pairs[i]) for i in JUDGED]) if lpips else None
    out["flip"] = _mean([flip(linear[i], references[i], hdr=True) for i in JUDGED])
    return out


def as_displayed(radiance: Array) -> Array:
    """Clipped to [0, 1], with the gamma of the re-render error."""
    shown: Array = np.clip(radiance, 0, 1) ** np.float32(1 / GAMMA)
    return shown


def measure(
    k: int, capture: HeldOut, lpips: Lpips | None, steps: int
) -> tuple[Row, dict[str, Maps], Batch]:
    """A capture's row: errors and seconds by method, and what the denoisers leave."""
    batch = capture.batch()
    truth = capture.at(SIZE).maps
    references = relight(truth, Rig(), grid_lights(Rig()))
    row: Row = {"capture": k, "errors": {}, "seconds": {}}
    maps: dict[str, Maps] = {}
    for name, (some, seconds) in answers(capture, batch, steps).items():
        each = [errors_of(m, truth, references, lpips) for m in some]
        row["errors"][name] = {c: _root_mean_square([e[c] for e in each]) for c in COLUMNS}
        row["seconds"][name], maps[name] = seconds, some[0]
    row["denoiser"] = denoised(batch)
    return row, maps, batch


def _root_mean_square(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def table_1(
    rows: list[Row], paper: dict[str, Any], hours: dict[str, float]
) -> tuple[Table, dict[str, dict[str, Any]]]:
    """Errors over all captures together, seconds, training hours by method, and, of its own data,
    the paper's averages."""
    pooled: dict[str, dict[str, Any]] = {}
    for name in ROWS:
        each = [r["errors"][name] for r in rows]
        pooled[name] = {
            c: _mean([e[c] for e in each])
            if c in ("lpips", "flip")
            else _root_mean_square([e[c] for e in each])
            for c in COLUMNS
        }
        pooled[name]["average"] = float(np.mean([pooled[name][n] for n in NAMES]))
    lines = [
        [
            ROWS[name],
            *e.values(),
            float(np.median([r["seconds"][name] for r in rows])),
            hours.get(METHOD_OF.get(name, name) or ""),
            paper.get(name, {}).get("average"),
        ]
        for name, e in pooled.items()
    ]
    spent = ["processor seconds", "hours of training"]
    header = ["", *COLUMNS, *spent, "the paper's average, on its own data"]
    return table(header, lines), pooled


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def training_table() -> Table:
    """What each method was trained for, from its weights' header."""
    lines = []
    for name in METHODS:
        notes = training_notes(name)
        size = parameters(trained(name))
        values = (notes[k] for k in ("captures", "step", "batch", "crop", "rate", "seed"))
        lines.append([name, size, notes["minutes"] / 60, *values])
    columns = ["captures", "steps", "batch", "crop", "rate", "seed"]
    return table(["method", "parameters", "processor hours", *columns], lines)


# --- Table 2 --------------------------------------------------------------------------------------


def denoised(batch: Batch) -> dict[str, float]:
    """RMSE, in units of a white plane and clipped at 1, of the photo to what it would be under the
    ideal pattern, and of each denoiser's."""
    ideal = normalise({**batch, "target": batch["ideal"]})["target"]
    photo = normalise(batch)["photo"]
    out = {"photo": _rmse(photo, ideal)}
    for name in ("paper", "lpl++"):
        with torch.no_grad():
            out[name] = _rmse(decode(trained(name)(batch)["denoised"]), ideal)
    return out


def decode(x: torch.Tensor) -> torch.Tensor:
    """The inverse of `nets.model.encode`."""
    low, high = encode(torch.tensor([0.0, 1.0]))
    floor = torch.exp2((x - low) / (high - low) * torch.log2(torch.tensor(1 / 0.02 + 1)))
    return 0.02 * (floor - 1)


def _rmse(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.clamp(0, 1) - b.clamp(0, 1)).square().mean().sqrt())


def table_2(conditions: dict[str, list[dict[str, float]]]) -> Table:
    lines = [
        [name, len(rows), *(_root_mean_square([r[k] for r in rows]) for k in rows[0])]
        for name, rows in conditions.items()
    ]
    columns = ["without", "the paper's denoiser", "LPL++'s denoiser"]
    return table(["RMSE to the ideal photo", "captures", *columns], lines)


# --- beyond ---------------------------------------------------------------------------------------


def beyond(args: argparse.Namespace, sizes: Sequence[int]) -> dict[str, Table]:
    """Average map RMSE of the shipped program against photos, size, device and materials."""
    folders, count = (args.materials, args.envs), args.photographs

    def error(maps: Maps, truth: Maps) -> float:
        size = min(maps.shape[0], SIZE)
        return map_errors(resize_maps(maps, size, size), resize_maps(truth, size, size))["average"]

    def refined(captures: list[HeldOut]) -> float:
        _, result, _ = estimate_maps([c.sample for c in captures], Stages())
        return error(result.maps, captures[0].maps)

    photos: dict[int, list[float]] = {n: [] for n in (1, 2, 3, 5)}
    for k in range(count):
        setting, rng = draw_setting(k, SIZE, *folders)
        taken = [photograph(setting, rng, p) for p in patterns()]
        for n, errors in photos.items():
            errors.append(refined(taken[:n]))
    captures = [draw(k, max(sizes), *folders) for k in range(count)]
    by_size = {s: [refined([c.at(s)]) for c in captures] for s in sizes}
    devices = {
        name: [refined([draw(k, SIZE, *folders, real_device=real)]) for k in range(count)]
        for name, real in (("ideal", False), ("real", True))
    }
    smallest = [c.at(SIZE) for c in captures]
    materials = {}
    for name, file in TRAINED_ON.items():
        network = Reconstructor(PROGRAM / file)
        materials[name] = [error(network(c.photo, c.lights).maps, c.maps) for c in smallest]
    curves: dict[str, dict[Any, list[float]]] = {
        "photos": photos,
        "pixels a side": by_size,
        "device": devices,
        "training materials, one photo, not refined": materials,
    }
    return {
        f"beyond: {name}": table(
            [name, "captures", "average map RMSE"],
            [[str(x), len(v), _root_mean_square(v)] for x, v in curve.items()],
        )
        for name, curve in curves.items()
    }


def patterns() -> list[Array]:
    """The default pattern, and the screen's left, right, upper and lower half white."""
    found = [default_pattern(128)]
    for half in (np.s_[:, :64], np.s_[:, 64:], np.s_[:64], np.s_[64:]):
        white = np.zeros_like(found[0])
        white[half] = 1
        found.append(white)
    return found


# --- everything -----------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    p = arguments(__doc__, "four small captures, shorter refinement, no photographs", 48)
    p.add_argument("--photographs", type=int, default=2, help="a point of Fig. 15 and of `beyond`")
    return p


def _kept(file: Path, make: Callable[[], Any]) -> Any:
    """What a JSON file holds; made first where it is not there."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        part.write_text(json.dumps(make()))
        part.replace(file)
    return json.loads(file.read_text())


def bars(pooled: dict[str, dict[str, Any]], rows: list[Row]) -> list[Bar]:
    ours = pooled["ours"]["average"]
    found = [
        bar(f"average map RMSE, ours over {ROWS[k]}", ours / pooled[k]["average"], most, False)
        for k, most in BARS
    ]
    first = [
        c
        for c in COLUMNS
        if pooled["ours"][c] is not None
        and min(pooled[k][c] for k in EQUAL if k != "ours")
        >= min(pooled["ours"][c], pooled["ours-refined"][c])
    ]
    measured = [c for c in COLUMNS if pooled["ours"][c] is not None]
    found.append(bar("columns in which ours is first", len(first), len(measured), True))
    found.append(bar("held-out captures", len(rows), 48, True))
    return found


def main(args: argparse.Namespace) -> None:
    torch.manual_seed(0)
    if args.quick:
        args.count, args.materials, args.envs = 4, None, None
    steps = 100 if args.quick else deepbasis.STEPS
    size = SIZE if args.quick else LONGEST
    args.out.mkdir(parents=True, exist_ok=True)
    try:
        lpips: Lpips | None = Lpips()
    except InputError as error:
        print(error)
        lpips = None
    paper = tomllib.loads(NUMBERS.read_text("utf-8"))
    rows = []
    for k in range(args.count):

        def one(k: int = k) -> Row:
            capture = draw(k, size, args.materials, args.envs)
            row, maps, batch = measure(k, capture, lpips, steps)
            if k < SHOWN and (not args.quick or k == 0):
                draw_maps(args.out / f"maps_{k}.png", capture.at(SIZE).maps, maps, ROWS)
                draw_clues(args.out / f"clues_{k}.png", batch, trained("coloured-clues"))
                draw_denoised(args.out / f"denoised_{k}.png", batch, trained("paper"), decode)
            return row

        rows.append(_kept(args.out / "rows" / f"{k:03d}.json", one))
        errors = rows[-1]["errors"]
        print(k, {n: round(e["average"], 4) for n, e in errors.items()}, flush=True)
    hours = {m: training_notes(m)["minutes"] / 60 for m in METHODS}
    shown, pooled = table_1(rows, paper, hours)
    tables = {"Table 1": shown, "training": training_table()}

    def perfect() -> list[dict[str, float]]:
        taken = (draw(k, SIZE, args.materials, args.envs, mosaic=False, real_device=False)
                 for k in range(1 if args.quick else PERFECT))  # fmt: skip
        return [denoised(c.batch()) for c in taken]

    tables["Table 2"] = table_2({
        "perturbed ideal pattern": _kept(args.out / "rows" / "ideal_pattern.json", perfect),
        "captured pattern": [r["denoiser"] for r in rows],
    })  # fmt: skip
    results: dict[str, Any] = {"first_seed": FIRST_SEED, "pooled": pooled, "rows": rows}
    reached = bars(pooled, rows)
    if not args.quick:
        sizes = (32, 64, 128)
        tables |= _kept(args.out / "rows" / "beyond.json", lambda: beyond(args, sizes))
        perturbed = measure_perturbed(args.out, args.materials, args.envs, args.photographs)
        tables |= perturbed_tables(perturbed)
        results["perturbed"] = perturbed
        draw_perturbed(args.out / "fig_15.png", perturbed_curves(perturbed))
        reached += perturbed_bars(perturbed)
    panels = {
        what: {
            ROWS[n]: ([float(np.median([r["seconds"][n] for r in rows]))], [pooled[n][what]])
            for n in ROWS
        }
        for what in ("average", "rerender")
    }
    plot_error_over_time(args.out / "paper.png", panels, x="processor seconds", y="RMSE", columns=2)
    write_results(args.out, {**results, "bars": reached}, tables)


def perturbed_tables(perturbed: dict[str, dict[str, list[Row]]]) -> dict[str, Table]:
    """Fig. 15: average error over the unperturbed one's, a table a perturbation."""
    return {
        f"Fig. 15, {kind}": table(
            [kind, "photographs", *METHODS_OF_RIG],
            [
                [
                    level,
                    len(rows),
                    *(_root_mean_square([r[m] for r in rows]) for m in METHODS_OF_RIG),
                ]
                for level, rows in perturbed[kind].items()
            ],
        )
        for kind in KINDS
    }


def perturbed_curves(
    perturbed: dict[str, dict[str, list[Row]]],
) -> dict[str, dict[str, list[tuple[float, float | None]]]]:
    """Points (level, error) by perturbation and method."""
    return {
        kind: {
            m: [(float(x), _root_mean_square([r[m] for r in rows])) for x, rows in levels.items()]
            for m in METHODS_OF_RIG
        }
        for kind, levels in perturbed.items()
    }


def perturbed_bars(perturbed: dict[str, dict[str, list[Row]]]) -> list[Bar]:
    """The worst rise of the error of ours as it is within the paper's grey-free range."""
    found = []
    for kind in KINDS:
        errors = {
            float(level): _root_mean_square([r["as it is"] for r in rows])
            for level, rows in perturbed[kind].items()
        }
        still = errors.pop(KINDS[kind][0])
        near = [e for level, e in errors.items() if GREY_FREE[kind](level) and e is not None]
        if near and still:
            found.append(bar(f"rise of the error, {kind}", max(near) / still, 1.05, False))
    return found
