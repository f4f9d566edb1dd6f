"""Search again for the pattern that ships: ``python -m invrender.pattern.design -o pattern.png``.
With ``--set 5`` instead, for the names of the best set (`invrender.pattern.design.sets`).

The mean criterion over the populations `SEEDS`, from a hue wheel; deterministic on one machine.
Prints how far the outcome is from the shipped pattern, and both scores on a third population.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from invrender.files.write import write_png
from invrender.maps import NAMES
from invrender.pattern.default import default_pattern
from invrender.pattern.design.criterion import Criterion
from invrender.pattern.design.optimise import optimise, wheel
from invrender.pattern.design.population import PATTERN_CELLS, draw_population, measure_responses
from invrender.pattern.design.sets import best_set, candidates, set_errors
from invrender.pattern.sets import COUNTS, pattern_set
from invrender.rig import Rig
from invrender.sampling import resize_pattern

SEEDS, HELD_OUT_SEED = (1, 2), 3  # of populations
GROUPS, ITERATIONS, WRITTEN_PIXELS = 320, 90, 256


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m invrender.pattern.design", description=__doc__)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("-o", "--out", type=Path, help="PNG (sRGB)")
    which.add_argument("--set", type=int, dest="count", choices=COUNTS, help="photos of a set")
    args = parser.parse_args()

    def criterion(seed: int) -> Criterion:
        print(f"population {seed} ...", flush=True)
        return Criterion(measure_responses(Rig(), draw_population(Rig(), GROUPS, seed)))

    if args.count is not None:
        search_set(args.count, criterion(SEEDS[0]), criterion(HELD_OUT_SEED))
        return
    parts = [criterion(seed) for seed in SEEDS]

    def mean(pattern: NDArray[np.floating]) -> tuple[float, NDArray[np.floating]]:
        values, gradients = zip(*(c(pattern) for c in parts), strict=True)
        return float(np.mean(values)), np.mean(gradients, 0)

    found = optimise(mean, wheel(), ITERATIONS)
    write_png(args.out, resize_pattern(found, WRITTEN_PIXELS))
    shipped = resize_pattern(default_pattern(), PATTERN_CELLS)
    print(f"RMS difference from the shipped one: {np.sqrt(np.mean((found - shipped) ** 2)):.4f}")
    held_out = criterion(HELD_OUT_SEED)
    for name, pattern in (("found", found), ("shipped", shipped), ("white", np.ones_like(found))):
        errors = held_out.errors(pattern)
        maps = ", ".join(f"{m} {errors[m]:.4f}" for m in NAMES)
        print(f"{name:>8}: {maps}; criterion {errors['criterion']:.4f}")


def search_set(count: int, criterion: Criterion, held_out: Criterion) -> None:
    """Print the best set of ``count`` patterns, and its score beside the shipped one's."""
    default = resize_pattern(default_pattern(), PATTERN_CELLS)
    named = candidates(PATTERN_CELLS, default)
    found = best_set(criterion, named, count, "default 0")
    shipped = [resize_pattern(p, PATTERN_CELLS) for p in pattern_set(count)]
    print(", ".join(found))
    for name, patterns in (("found", [named[n] for n in found]), ("shipped", shipped)):
        print(f"{name:>8}: criterion {set_errors(held_out, patterns)['criterion']:.4f}")


if __name__ == "__main__":
    main()
