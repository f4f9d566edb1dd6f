"""Designing the light pattern: docs/pattern.md."""

from invrender.design.criterion import NAMES, WEIGHTS, Criterion
from invrender.design.optimise import DARKEST, Design, design, optimise, wheel
from invrender.design.population import (
    CELLS,
    GROUP,
    Population,
    Responses,
    draw_population,
    measure_responses,
)

__all__ = [
    "CELLS", "DARKEST", "GROUP", "NAMES", "WEIGHTS", "Criterion", "Design", "Population",
    "Responses", "design", "draw_population", "measure_responses", "optimise", "wheel",
]  # fmt: skip
