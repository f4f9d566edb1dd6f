"""Stiff and extreme samples: how far refinement comes, and what it says of it.

Photos are rendered by the forward model from known maps and refined from a flat start and from the
networks' maps, with the true lights unless the case says otherwise. A run warns where the photo's
large shades are not explained to within `invrender.report.notices.POOR_FIT`, or where the albedo's
colours follow the light's (`BAKED`).
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.results import Bar, bar, benchmark_parser, table, write_results
from invrender.capture.sample import Sample
from invrender.data.environments import procedural_environment
from invrender.lights import Lights
from invrender.maps import Maps, constant_maps, map_errors
from invrender.pattern.default import default_pattern
from invrender.pipeline import Stages, estimate_maps
from invrender.refine.checks import baked_light, coarse_error, photo_error
from invrender.render import Fast
from invrender.render.scene import make_scene
from invrender.report.notices import BAKED, POOR_FIT
from invrender.rig import Rig
from invrender.sphere import scale_environment

Array = NDArray[np.floating[Any]]
RIG, GAIN, PATTERN = Rig(), 2.0, default_pattern()


@dataclass
class Case:
    """noise: relative to a pixel; clip: share of the pixels that saturate."""

    maps: Maps
    environment: Any
    noise: float = 0.005
    clip: float = 0.0
    rig: Rig = field(default_factory=Rig)


def cases(n: int) -> dict[str, Case]:
    """The cases at n × n pixels."""
    room = scale_environment(procedural_environment(3, 64), 0.3)

    def one(k_d: Any, k_s: Any, rho: float) -> Maps:
        maps = constant_maps(n, n, k_d, k_s, rho)
        y, x = np.mgrid[:n, :n] / n * 2 * np.pi
        maps.diffuse *= (1 + 0.2 * np.sin(3 * x) * np.sin(4 * y)).astype(np.float32)[..., None]
        return maps

    mixed = one((0.4, 0.3, 0.2), 0.04, 0.8)
    mixed.diffuse[:, : n // 2], mixed.specular[:, : n // 2] = 0, 0.9
    mixed.roughness[:, : n // 2] = 0.06
    lamp = room.copy()
    lamp[10:13, 20:24] += 300
    sun = room.copy()
    sun[12, 70] += 2e4
    matt = one((0.5, 0.35, 0.2), 0.04, 0.5)
    return {
        "near-mirror beside rough": Case(mixed, room),
        "black velvet": Case(one(0.01, 0.02, 0.9), room),
        "white paper": Case(one(0.8, 0.04, 0.7), room),
        "polished metal under a lamp": Case(one(0, (0.9, 0.8, 0.6), 0.12), lamp),
        "one-texel sun": Case(matt, sun),
        "dark room, noise 20%": Case(matt, None, noise=0.2),
        "half of the photo clipped": Case(matt, room, clip=0.5),
        "screen and camera 20% too high": Case(
            matt, room, rig=replace(RIG, screen_height=1.2 * RIG.screen_height)
        ),
        "near-mirror, 20% too high": Case(
            mixed, room, rig=replace(RIG, screen_height=1.2 * RIG.screen_height)
        ),
    }


def photograph(case: Case, seed: int) -> tuple[Array, NDArray[np.bool_] | None]:
    """The case's photo (n, n, 3), and where it is saturated."""
    rng = np.random.default_rng(seed)
    true = Fast(make_scene(case.rig, PATTERN, case.environment, GAIN))
    photo = true.render(case.maps, 256)
    photo = np.maximum(photo * (1 + case.noise * rng.standard_normal(photo.shape)), 0)
    photo = photo.astype(np.float32)
    if not case.clip:
        return photo, None
    white = np.quantile(photo.max(-1), 1 - case.clip)
    return np.minimum(photo, np.float32(white)), photo.max(-1) >= white


def run(case: Case, seed: int, init: str) -> dict[str, Any]:
    """Photograph a case and refine it."""
    photo, clipped = photograph(case, seed)
    mask = np.zeros(photo.shape[:2], bool) if clipped is None else clipped
    room = np.zeros((64, 128, 3), np.float32) if case.environment is None else case.environment
    stage = Stages()
    sample = Sample(photo, mask, Lights(RIG, PATTERN, room, GAIN))
    start, result, (shot,) = estimate_maps([sample], stage, init)
    renderer = shot.renderer
    images = [*result.maps.encoded().values(), result.sigma]
    before, after = map_errors(start, case.maps), map_errors(result.maps, case.maps)
    baked = baked_light(result.maps.diffuse, renderer)
    shown = renderer.render(result.maps, 256)
    coarse = coarse_error(shown, photo, mask)
    return {
        "initial": before,
        "refined": after,
        "photo_error": photo_error(shown, photo, mask),
        "coarse_error": coarse,
        "iterations": max(len(result.history) - 1, 1),
        "converged": result.converged,
        "baked": baked,
        "warns": not result.converged or coarse > POOR_FIT[init] or baked > BAKED,
        "finite": bool(all(np.isfinite(i).all() for i in images)),
        "greatest albedo": float((result.maps.diffuse + result.maps.specular).max()),
        "seconds": sum(stage.seconds.values()),
    }


def parser() -> argparse.ArgumentParser:
    return benchmark_parser(__doc__, "16 × 16 pixels")


def main(args: argparse.Namespace) -> None:
    results: dict[str, Any] = {}
    rows = []
    numbered = enumerate(cases(16 if args.quick else 64).items())
    for (seed, (name, case)), init in itertools.product(numbered, ("flat", "network")):
        r = results[f"{name}, {init}"] = run(case, seed, init)
        maps = [f"{r['initial'][n]:.3f} → {r['refined'][n]:.3f}" for n in r["initial"]]
        end = "yes" if r["converged"] else "no"
        end += ", warns" if r["warns"] else ""
        numbers = (r[k] for k in ("photo_error", "coarse_error", "baked", "iterations"))
        row = [name, init, *maps, *numbers, end, r["seconds"]]
        rows.append(row)
        print(*row, "" if r["finite"] else "NOT FINITE", flush=True)
    names = [*next(iter(results.values()))["initial"]]
    header = ["case", "start", *names, "photo error", "coarse", "light in albedo", "steps"]
    header += ["converged", "seconds"]
    content = {"cases": results, "bars": bars(results)}
    write_results(args.out, content, {"cases": table(header, rows)})


def bars(results: dict[str, Any]) -> list[Bar]:
    """A start from the networks should end no worse than a flat one; nothing may be infinite."""
    ends = {name: r["refined"]["average"] for name, r in results.items()}
    worse = [n for n in ends if n.endswith(", network")
             and ends[n] > ends[n.removesuffix("network") + "flat"]]  # fmt: skip
    infinite = sum(not r["finite"] for r in results.values())
    return [
        bar("cases that end worse from the networks than from flat", len(worse), 0, False),
        bar("runs with a number that is not finite", infinite, 0, False),
    ]
