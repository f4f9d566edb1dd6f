"""The set of patterns, shown one after another, that leaves least unknown: the criterion of one
pattern (`invrender.pattern.design.criterion`) over several photos.

With the Jacobian Jᵢ and the noise Nᵢ of the photo under pattern i, information adds up,

    C = (P⁻¹ + Σᵢ Jᵢᵀ Nᵢ⁻¹ Jᵢ)⁻¹,

so that the best pattern to add to a set is found among candidates by one product for each. The
screen's gain and the room's light are the same in all photos of a set.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from invrender.pattern.design.criterion import Criterion
from invrender.pattern.sets import gradient, half, stripes
from invrender.types import Array

CANDIDATE_DIRECTIONS = 8  # of halves and gradients
PHASES = 3  # phases of stripes


def candidates(cells: int, default: Array) -> dict[str, Array]:
    """Patterns (cells, cells, 3) by name: the default one and its turns, halves, gradients and
    stripes in several directions; white is none of them, since no ball shows where it is."""
    out = {f"default {90 * k}": np.ascontiguousarray(np.rot90(default, k)) for k in range(4)}
    for k in range(CANDIDATE_DIRECTIONS):
        angle = 360 * k / CANDIDATE_DIRECTIONS
        out[f"half {angle:g}"] = half(cells, angle)
        out[f"gradient {angle:g}"] = gradient(cells, angle)
    for angle in (0, 90):
        for step in range(PHASES):
            out[f"stripes {angle} {step}"] = stripes(cells, angle, step / PHASES)
    return out


def set_errors(criterion: Criterion, patterns: Sequence[Array]) -> dict[str, float]:
    """Root-mean-square posterior deviation of each map, and the criterion, with a photo under each
    of the patterns."""
    information = sum(criterion.information(p) for p in patterns)
    return criterion.errors_of(criterion.prior + information)


def best_set(
    criterion: Criterion, named: dict[str, Array], count: int, first: str, swaps: int = 1
) -> list[str]:
    """The names of ``count`` patterns, ``first`` among them: added one by one, each the best, then
    each but the first exchanged for a better one, ``swaps`` rounds."""
    information = {name: criterion.information(p) for name, p in named.items()}

    def score(names: Sequence[str]) -> float:
        total = criterion.prior + sum(information[n] for n in names)
        return criterion.errors_of(total)["criterion"]

    chosen = [first]
    while len(chosen) < count:
        chosen.append(min(named, key=lambda n: score([*chosen, n])))
    for _ in range(swaps):
        for i in range(1, count):
            rest = chosen[:i] + chosen[i + 1 :]
            chosen[i] = min(named, key=lambda n: score([*rest, n]))
    return chosen
