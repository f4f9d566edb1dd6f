"""Search for the pattern of least expected error, within what a display can show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from invrender.pattern.default import default_pattern
from invrender.pattern.design.criterion import Criterion
from invrender.pattern.design.population import PATTERN_CELLS, draw_population, measure_responses
from invrender.pattern.sets import DARKEST
from invrender.rig import Rig
from invrender.sampling import resize_pattern
from invrender.types import Array

DIM, DIM_WEIGHT = 0.35, 10.0  # a channel whose mean is less is penalised: its gain must be read
SMOOTHNESS = 0.05  # weight of the mean squared second difference between cells


def optimise(
    criterion: Callable[[Array], tuple[float, Array]],
    start: Array,
    iterations: int = 150,
    smoothness: float = SMOOTHNESS,
    progress: Callable[[float], None] | None = None,
) -> Array:
    """The pattern (cells, cells, 3) that L-BFGS-B reaches from ``start`` in a display's range.

    criterion: pattern to value and gradient.
    """
    n = len(start)

    def cost(flat: Array) -> tuple[float, Array]:
        pattern = flat.reshape(n, n, 3)
        value, gradient = criterion(pattern)
        rough, d_rough = _roughness(pattern)
        dim = np.minimum(pattern.mean((0, 1)) - DIM, 0)
        value += smoothness * rough + DIM_WEIGHT * float((dim**2).sum())
        gradient = gradient + smoothness * d_rough + 2 * DIM_WEIGHT * dim / (n * n)
        return value, gradient.ravel()

    done = [0]

    def step(_: Array) -> None:
        done[0] += 1
        if progress:
            progress(done[0] / iterations)

    result = minimize(
        cost, start.ravel(), jac=True, method="L-BFGS-B", bounds=[(DARKEST, 1.0)] * start.size,
        callback=step, options={"maxiter": iterations},
    )  # fmt: skip
    return result.x.reshape(n, n, 3)


def _roughness(pattern: Array) -> tuple[float, Array]:
    """Mean squared second difference, and its gradient."""
    gradient = np.zeros_like(pattern)
    total = 0.0
    for axis in (0, 1):
        p = np.moveaxis(pattern, axis, 0)
        g = np.moveaxis(gradient, axis, 0)
        d = p[2:] - 2 * p[1:-1] + p[:-2]
        total += float((d**2).mean())
        d = 2 * d / d.size
        g[2:] += d
        g[1:-1] -= 2 * d
        g[:-2] += d
    return total, gradient


def wheel(cells: int = PATTERN_CELLS, angle: float = 0.0, flip: bool = False) -> Array:
    """Hue by direction from the screen's centre, (cells, cells, 3): where searches start.

    No two directions of a normal look alike in it. The criterion, a local bound, does not ask for
    that.
    """
    u = (np.arange(cells) + 0.5) / cells - 0.5
    direction = np.arctan2(-u[:, None], u[None, :]) * (-1 if flip else 1) + angle
    phases = 2 * np.pi / 3 * np.arange(3)
    return np.clip(0.5 + 0.45 * np.cos(direction[..., None] - phases), DARKEST, 1)


@dataclass
class Design:
    """A pattern (cells, cells, 3), and what each of several patterns leaves unknown on a population
    that the search has not seen: `Criterion.errors`."""

    pattern: Array
    held_out: Criterion
    errors: dict[str, dict[str, float]]


def design(
    rig: Rig,
    compare: dict[str, Array] | None = None,
    groups: int = 480,
    starts: int = 2,
    iterations: int = 80,
    samples: int = 128,
    seed: int = 0,
    cells: int = PATTERN_CELLS,
    rooms: int = 12,
    progress: Callable[[float], None] | None = None,
) -> Design:
    """Optimise a pattern for a rig, from the default one and from hue wheels; the best of them on a
    held-out population wins.

    starts: how many. compare: patterns (cells, cells, 3) to report beside it. progress: called with
    0 to 1.
    """
    tell = progress or (lambda _: None)

    def measure(count: int, population_seed: int, begin: float, end: float) -> Criterion:
        population = draw_population(rig, count, population_seed, rooms)
        report = lambda f: tell(begin + f * (end - begin))  # noqa: E731
        return Criterion(measure_responses(rig, population, cells, samples, report))

    train = measure(groups, 2 * seed + 1, 0.0, 0.35)
    held_out = measure(max(groups // 2, 1), 2 * seed + 2, 0.35, 0.55)
    rng = np.random.default_rng(seed)
    found = []
    for k in range(starts):
        start = np.clip(resize_pattern(default_pattern(), cells), DARKEST, 1)
        if k:
            start = wheel(cells, rng.uniform(0, 2 * np.pi), k % 2 == 0)
        tell(0.55 + 0.45 * k / starts)
        step = lambda f, k=k: tell(0.55 + 0.45 * (k + f) / starts)  # noqa: E731
        found.append(optimise(train, start, iterations, progress=step))
    best = min(found, key=lambda p: held_out.errors(p)["criterion"])
    patterns = {**(compare or {}), "optimised": best}
    return Design(best, held_out, {k: held_out.errors(p) for k, p in patterns.items()})
