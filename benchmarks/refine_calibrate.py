"""By how much errors exceed what is expected of them, once lights are estimated and not known.

Refines captures like those of `refine`, but none of its materials and rooms, from the photo
alone: real ones that the networks have seen, and half as many procedural ones that they have not.
For each map, the factor on its sigma with which 68% of the truth lies within, of all pixels and
captures of a kind together, and the mean over both kinds: what
`invrender.refine.priors.ERROR_INFLATION` is to be multiplied by, again until it is one.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.captures import CaptureSet, arguments, make_captures
from benchmarks.common.results import table, write_results
from invrender.capture.lights import find_lights
from invrender.files.capture import load_capture
from invrender.maps import NAMES, resize_maps
from invrender.pipeline import reconstruct

REAL = CaptureSet("train", 97_000, every=4)  # a few show all families
MADE = CaptureSet("train", 98_000)
SURE = 0.6827  # of a Gaussian within one sigma
STEP = 4  # every how many pixels count: errors are shared by neighbours


def ratios(folder: Path, size: int) -> dict[str, NDArray[np.floating[Any]]]:
    """|error|/sigma of some pixels of each map; of normals x and y, encoded."""
    capture = load_capture(folder)
    result = reconstruct(find_lights(capture), size=size)
    assert capture.truth is not None
    found, true = result.maps.encoded(), resize_maps(capture.truth, size, size).encoded()
    out: dict[str, NDArray[np.floating[Any]]] = {}
    for name, sigma in result.estimate.sigma.items():
        error = np.abs(found[name] - true[name])
        error = error[..., :2] if name == "normal" else error
        sigma = sigma[..., None] if error.ndim > sigma.ndim else sigma
        out[name] = (error / np.maximum(sigma, 1e-9))[::STEP, ::STEP].ravel()
    return out


def parser() -> argparse.ArgumentParser:
    return arguments(__doc__, "three small captures", 16)


def main(args: argparse.Namespace) -> None:
    count, size, width, spp = (2, 96, 480, 8) if args.quick else (args.count, 256, 960, 32)
    sizes = (size, width, spp)
    kinds = {
        "real": make_captures(args.out / "real", REAL, count, *sizes, args.materials, args.envs),
        "made": make_captures(args.out / "made", MADE, count // 2, *sizes),
    }
    factors, covered = {}, {}
    for kind, folders in kinds.items():
        rows = []
        for folder in folders:
            rows.append(ratios(folder, size))
            found = (f"{n} {np.quantile(r, SURE):.2f}" for n, r in rows[-1].items())
            print(kind, folder.name, *found, flush=True)
        every = {n: np.concatenate([r[n] for r in rows]) for n in NAMES}
        factors[kind] = {n: float(np.quantile(r, SURE)) for n, r in every.items()}
        covered[kind] = {n: float((r <= 1).mean()) for n, r in every.items()}
    mean = {n: float(np.mean([f[n] for f in factors.values()])) for n in NAMES}
    lines = [
        [n, *(c[n] for c in covered.values()), *(f[n] for f in factors.values()), mean[n]]
        for n in NAMES
    ]
    header = ["map", *(f"within one sigma, {k}" for k in kinds), *(f"factor, {k}" for k in kinds)]
    results = {"factors": factors, "mean": mean, "within": covered}
    write_results(args.out, results, {"factors": table([*header, "mean"], lines)})
