"""One damped least-squares solver for the fits with robust weights of their own.

`scipy.optimize.least_squares` serves where residuals are few (glare, clipped and hidden lamps). The
rim's and the screen's fits solve for part of their unknowns inside (variable projection), or need a
prior beside a robust loss, and are made of normal equations: 14 unknowns and 30,000 residuals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from invrender.capture.settings import DAMPED_STEPS
from invrender.types import TINY, Array

State = TypeVar("State")


@dataclass(frozen=True)
class Minimum(Generic[State]):
    """Where `minimise` ended: the unknowns (n,), what the cost was made from, and the cost."""

    unknowns: Array
    state: State
    cost: float


def minimise(
    unknowns: Array,
    evaluate: Callable[[Array, State | None], tuple[float, State]],
    normal_equations: Callable[[Array, State], tuple[Array, Array]],
    *,
    steps: int,
    longest: float,
    enough: Callable[[float, float], bool],
) -> Minimum[State]:
    """Levenberg's and Marquardt's steps to a minimum of a cost near ``unknowns`` (n,).

    evaluate: cost and state at some unknowns, with robust weights as the given state has them.
    normal_equations: Gauss–Newton's matrix (n, n) and the right side (n,), downhill, there. steps:
    at most; longest: the greatest change of an unknown in one; enough: whether a step that gained
    so much of a cost that was so large is the last one. Only steps that lower the cost are made.
    """
    cost, state = evaluate(unknowns, None)
    damping = DAMPED_STEPS.first
    for _ in range(steps):
        matrix, right = normal_equations(unknowns, state)
        raised = False
        for _ in range(DAMPED_STEPS.attempts):
            damped = matrix + np.diag(np.diag(matrix) * damping + DAMPED_STEPS.ridge)
            step = np.linalg.solve(damped, right)
            step *= min(1, longest / max(np.abs(step).max(), TINY))
            tried_cost, tried = evaluate(unknowns + step, state)
            if tried_cost < cost:
                break
            damping *= DAMPED_STEPS.factor
            raised = True
        else:
            break
        gained, before = cost - tried_cost, cost
        unknowns, state, cost = unknowns + step, tried, tried_cost
        if not raised:
            damping /= DAMPED_STEPS.factor
        if enough(gained, before):
            break
    return Minimum(unknowns, state, cost)
