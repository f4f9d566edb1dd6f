"""Designing the light pattern: docs/explain/pattern.md."""

from invrender.pattern.design.criterion import MAP_WEIGHTS, NAMES, Criterion
from invrender.pattern.design.optimise import DARKEST, Design, design, optimise, wheel
from invrender.pattern.design.population import (
    GROUP_PIXELS,
    PATTERN_CELLS,
    Population,
    Responses,
    draw_population,
    measure_responses,
)

__all__ = [
    "DARKEST",
    "GROUP_PIXELS",
    "MAP_WEIGHTS",
    "NAMES",
    "PATTERN_CELLS",
    "Criterion",
    "Design",
    "Population",
    "Responses",
    "design",
    "draw_population",
    "measure_responses",
    "optimise",
    "wheel",
]  # fmt: skip
