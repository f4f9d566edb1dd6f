"""Procedural materials and environments beside real ones: sheets to look at, statistics, timings.

Writes procedural.png, real.png, environments.png (each cell of the first two: lit from the front
left; beside it albedo, specular, roughness, normal) and histograms of both. The folders of real
materials and rooms are optional.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.stats import ks_2samp

from benchmarks.common.results import Table, bar, benchmark_parser, table, write_results
from invrender.data.environments import (
    KINDS,
    find_environments,
    procedural_environment,
    read_environment,
)
from invrender.data.materials import (
    PRESETS,
    augment,
    check_maps,
    is_directx,
    load_materials,
    procedural_material,
)
from invrender.files.write import write_png
from invrender.maps import Maps, resize_maps
from invrender.render.point_lights import relight
from invrender.rig import Rig
from invrender.sphere import irradiance, solid_angles
from invrender.types import InputError

Array = NDArray[np.floating[Any]]
Statistics = dict[str, Array]
QUANTILES = (5, 25, 50, 75, 95)
SOURCES = ("procedural", "real")
LIGHTS = np.array([[0.5 * k - 1.6, 1.2 - 0.2 * k, 1.6] for k in range(5)])  # in half samples
POWER = 0.06  # of each, chosen by eye


# --- statistics -----------------------------------------------------------------------------------


def _edges(image: Array) -> Array:
    """Size of the differences between neighbouring pixels, summed over channels, (H, W)."""
    image = image.reshape(*image.shape[:2], -1)
    return sum(np.hypot(*np.gradient(image[..., i])) for i in range(image.shape[2]))


def _correlation(a: Array, b: Array) -> float:
    """Of two fields; 0 where one of them is flat."""
    if a.std() < 1e-5 or b.std() < 1e-5:
        return 0.0
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def material_statistics(maps: Maps) -> dict[str, float]:
    """One number for each property of a material."""
    diffuse, specular = maps.diffuse.mean(-1), maps.specular.mean(-1)
    base = diffuse + specular
    tilt = np.degrees(np.arccos(np.clip(maps.normal[..., 2], -1, 1)))
    colour = maps.diffuse + maps.specular
    edges = {
        "base": _edges(colour),
        "rough": _edges(maps.roughness),
        "normal": _edges(maps.normal),
    }
    return {
        "diffuse mean": float(diffuse.mean()),
        "diffuse std": round(float(diffuse.std()), 6),
        "specular mean": float(specular.mean()),
        "specular std": round(float(specular.std()), 6),
        "roughness mean": float(maps.roughness.mean()),
        "roughness std": float(maps.roughness.std()),
        "tilt median": float(np.median(tilt)),
        "tilt 95%": float(np.percentile(tilt, 95)),
        "tilt over 30°": float((tilt > 30).mean()),
        "metal fraction": float((specular > 0.12).mean()),
        "saturation": float(1 - (colour.min(-1) / np.maximum(colour.max(-1), 1e-4)).mean()),
        "base gradient": float(edges["base"].mean()),
        "roughness gradient": float(edges["rough"].mean()),
        "normal gradient": float(edges["normal"].mean()),
        "base ~ roughness": _correlation(base, maps.roughness),
        "edges base ~ normal": _correlation(edges["base"], edges["normal"]),
        "edges roughness ~ normal": _correlation(edges["rough"], edges["normal"]),
        "edges base ~ roughness": _correlation(edges["base"], edges["rough"]),
    }


def environment_statistics(env: Array) -> dict[str, float]:
    """One number for each property of an environment's upper half."""
    half = env.shape[0] // 2
    grey = env[:half].mean(-1)
    omega = np.repeat(solid_angles(*env.shape[:2])[:half, None], env.shape[1], 1)
    order = np.argsort(-grey.ravel())
    share = np.cumsum(omega.ravel()[order]) / omega.sum()
    flux = (grey * omega).ravel()[order]
    e = irradiance(env)
    side = [irradiance(env, n).mean() for n in ((1, 0, 1), (-1, 0, 1), (0, 1, 1), (0, -1, 1))]
    return {
        "log10 max/median": float(np.log10(grey.max() / max(np.median(grey), 1e-9))),
        "log10 median/irradiance": float(np.log10(max(np.median(grey), 1e-9) / e.mean())),
        "flux of brightest 0.1%": float(flux[share <= 0.001].sum() / flux.sum()),
        "flux of brightest 1%": float(flux[share <= 0.01].sum() / flux.sum()),
        "flux of brightest 10%": float(flux[share <= 0.1].sum() / flux.sum()),
        "colour cast": float(e.max() / e.min() - 1),
        "one-sidedness": float((max(side) - min(side)) / sum(side) * 4),
    }


def _by_name(rows: list[dict[str, float]]) -> Statistics:
    return {k: np.array([r[k] for r in rows]) for k in rows[0]} if rows else {}


def compare(made: Statistics, real: Statistics) -> list[dict[str, Any]]:
    """Quantiles of both, the Kolmogorov–Smirnov distance, and how much of the real is covered."""
    lines = []
    for key, values in made.items():
        line: dict[str, Any] = {
            "name": key,
            "procedural": [float(v) for v in np.percentile(values, QUANTILES)],
        }
        if real:
            low, high = np.percentile(values, [0.5, 99.5])
            line["real"] = [float(v) for v in np.percentile(real[key], QUANTILES)]
            line["ks"] = float(ks_2samp(values, real[key]).statistic)
            line["covered"] = float(((real[key] >= low) & (real[key] <= high)).mean())
        lines.append(line)
    return lines


def compared(lines: list[dict[str, Any]]) -> Table:
    """The comparison as a table."""
    rows = []
    for line in lines:
        made, real = (" / ".join(f"{v:.3g}" for v in line.get(k, [])) for k in SOURCES)
        rows.append([line["name"], made, real, line.get("ks"), line.get("covered")])
    header = ["", "procedural, 5 / 25 / 50 / 75 / 95%", "real, the same", "KS distance", "covered"]
    return table(header, rows)


# --- pictures -------------------------------------------------------------------------------------


def preview(maps: Maps) -> Array:
    """Under a row of five point lights from the front left and a little fill, (H, W, 3) linear."""
    lights = Rig().sample_size / 2 * LIGHTS
    fill = 0.15 * (maps.diffuse + 0.7 * maps.specular)
    return np.asarray(relight(maps, Rig(), lights).sum(0) * POWER + fill)


def cell(maps: Maps, size: int = 128) -> Array:
    """Shaded beside its four maps, (size, 2·size, 3) linear."""
    lit = np.clip(preview(resize_maps(maps, size, size)), 0, 1)
    small = resize_maps(maps, size // 2, size // 2)
    # write_png encodes to sRGB: undo it for what is no colour
    rough = np.repeat(small.roughness[..., None] ** 2.2, 3, -1)
    normal = (small.normal / 2 + 0.5) ** 2.2
    top = np.concatenate([small.diffuse, small.specular], 1)
    bottom = np.concatenate([rough, normal], 1)
    return np.concatenate([lit, np.concatenate([top, bottom], 0)], 1)


def sheet(cells: list[Array], columns: int) -> Array:
    """Cells side by side with a thin gap."""
    h, w = cells[0].shape[:2]
    rows = -(-len(cells) // columns)
    out = np.ones((rows * (h + 4), columns * (w + 4), 3), np.float32)
    for i, c in enumerate(cells):
        y, x = i // columns * (h + 4), i % columns * (w + 4)
        out[y : y + h, x : x + w] = c
    return out


def histograms(path: Path, made: Statistics, real: Statistics) -> None:
    """A plot of each statistic, procedural beside real."""
    columns = 6
    rows = -(-len(made) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3 * columns, 2.2 * rows))
    for axis in np.ravel(axes):
        axis.set_visible(False)
    for axis, (key, values) in zip(np.ravel(axes), made.items(), strict=False):
        axis.set_visible(True)
        both = np.concatenate([values, real[key]]) if real else values
        low, high = np.percentile(both, [0.5, 99.5])
        bins = np.linspace(low, high, 25)
        axis.hist(
            np.clip(values, bins[0], bins[-1]), bins, density=True, alpha=0.6, label="procedural"
        )
        if real:
            axis.hist(
                np.clip(real[key], bins[0], bins[-1]),
                bins,
                density=True,
                histtype="step",
                lw=1.5,
                color="k",
                label="real",
            )
        axis.set_title(key, fontsize=9)
        axis.set_yticks([])
    np.ravel(axes)[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=80)
    plt.close(figure)


# --- measurements ---------------------------------------------------------------------------------


def milliseconds(make: Callable[[int], object], seeds: range) -> Array:
    """Wall time and processor time of each call, (n, 2), after three that do not count."""
    for seed in list(seeds)[:3]:
        make(seed)
    times = []
    for seed in seeds:
        wall, processor = time.perf_counter(), time.process_time()
        make(seed)
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    return 1e3 * np.array(times)


def _times(times: Array) -> dict[str, dict[str, float]]:
    return {
        clock: {f"{q}%": float(np.percentile(times[:, i], q)) for q in (25, 50, 75, 95)}
        for i, clock in enumerate(("wall", "processor"))
    }


def degenerate(maps: Maps) -> bool:
    """Whether `check_maps` refuses it."""
    try:
        check_maps(maps)
    except InputError:
        return True
    return False


def parser() -> argparse.ArgumentParser:
    p = benchmark_parser(__doc__, "fewer samples")
    p.add_argument("--materials", type=Path, help="folder of real material folders")
    p.add_argument("--envs", type=Path, help="folder of real environments")
    p.add_argument("--count", type=int, default=800, help="procedural materials")
    p.add_argument("--size", type=int, default=128)
    p.add_argument("--seed", type=int, default=0)
    return p


def main(args: argparse.Namespace) -> None:
    out: Path = args.out
    out.mkdir(parents=True, exist_ok=True)
    size, count = args.size, 150 if args.quick else args.count
    seeds = range(args.seed, args.seed + count)

    times = milliseconds(lambda s: procedural_material(s, size, size), seeds)
    made = [procedural_material(s, size, size) for s in seeds]
    bars = [
        bar(f"procedural material {size}², median ms of one core",
            float(np.median(times[:, 1])), 20, False),
        bar("degenerate procedural materials", sum(map(degenerate, made)), 0, False),
    ]  # fmt: skip
    made_table = _by_name([material_statistics(m) for m in made])
    per_kind = 3 if args.quick else 6
    shown = [procedural_material(s, size, size, k) for k in PRESETS for s in range(per_kind)]
    write_png(out / "procedural.png", sheet([cell(m) for m in shown], 6))

    real_table: Statistics = {}
    if args.materials:
        rng = np.random.default_rng(args.seed)
        rows, cells, wrong = [], [], 0
        for _, maps in load_materials(args.materials, 512):
            wrong += is_directx(maps.normal)
            cells.append(cell(maps))
            for _ in range(1 if args.quick else 3):
                piece = augment(maps, rng, size, size, jitter=0, free_rotation=0)
                rows.append(material_statistics(piece))
        real_table = _by_name(rows)
        write_png(out / "real.png", sheet(cells, 6))
        bars.append(bar("OpenGL normals taken for DirectX", wrong, 0, False))
    lines = compare(made_table, real_table)
    if real_table:
        covered, distance = min(x["covered"] for x in lines), np.mean([x["ks"] for x in lines])
        bars += [
            bar("real materials inside the procedural range, worst statistic", covered, 0.8, True),
            bar("mean KS distance, procedural to real", float(distance), 0.35, False),
        ]
    histograms(out / "histograms.png", made_table, real_table)

    envs = 40 if args.quick else 160
    env_times = milliseconds(lambda s: procedural_environment(s, 128), range(min(envs, 40)))
    rooms = [procedural_environment(s, 128) for s in range(envs)]
    env_table = _by_name([environment_statistics(e) for e in rooms])
    cells = [_shown(procedural_environment(s, 64, k)) for k in KINDS for s in range(6)]
    real_env: Statistics = {}
    if args.envs:
        found = [read_environment(p, 128) for p in find_environments(args.envs)]
        real_env = _by_name([environment_statistics(e) for e in found])
        cells += [_shown(read_environment(p, 64)) for p in find_environments(args.envs)]
    write_png(out / "environments.png", sheet(cells, 6))
    histograms(out / "environment_histograms.png", env_table, real_env)
    env_lines = compare(env_table, real_env)
    results = {
        "procedural": count,
        "real": len(next(iter(real_table.values()))) if real_table else 0,
        "material_ms": _times(times),
        "environment_ms": _times(env_times),
        "materials": lines,
        "environments": env_lines,
        "bars": bars,
    }
    tables = {"materials": compared(lines), "environments above the table": compared(env_lines)}
    write_results(out, results, tables)


def _shown(env: Array) -> Array:
    """An environment exposed for its walls."""
    return np.clip(env / (np.percentile(env.mean(-1), 85) * 1.2), 0, 1)
