"""invrender: one photo under a tablet's light pattern in, relightable material maps out.

Conventions, used everywhere (see docs/conventions.md): right-handed metres, origin at the sample's
centre, z up, x towards the camera; images are linear RGB float32 with row 0 at +y and column 0 at
-x; roughness is perceptual (alpha = roughness²); normals are unit vectors in memory.

Importing this loads nothing else: each name brings what it needs when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from invrender.maps import Maps, map_errors
    from invrender.rig import Rig
    from invrender.types import InputError

__all__ = ["InputError", "Maps", "Rig", "map_errors"]

_HOMES = {"InputError": "types", "Maps": "maps", "Rig": "rig", "map_errors": "maps"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
