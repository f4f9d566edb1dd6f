"""Designing the light pattern: docs/explain/pattern.md."""

from invrender.pattern.design.criterion import NAMES, WEIGHTS, Criterion
from invrender.pattern.design.optimise import DARKEST, Design, design, optimise, wheel
from invrender.pattern.design.population import (
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
