"""Materials, environments and simulated captures, and the bundled example.

    maps = procedural_material(seed=3, height=256, width=256, kind="bricks")
    room = scale_environment(procedural_environment(seed=3), level=0.5)

The names load what they need when they are first used.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lazy_loader import attach

if TYPE_CHECKING:
    from invrender.data.environments import (
        procedural_environment,
        read_environment,
        scale_environment,
    )
    from invrender.data.materials import procedural_material, read_material

EXAMPLE = Path(__file__).with_name("example")  # a capture with ground truth

__all__ = [
    "EXAMPLE",
    "procedural_environment",
    "procedural_material",
    "read_environment",
    "read_material",
    "scale_environment",
]

__getattr__, __dir__, _ = attach(
    __name__,
    submod_attrs={
        "environments": ["procedural_environment", "read_environment", "scale_environment"],
        "materials": ["procedural_material", "read_material"],
    },
)
