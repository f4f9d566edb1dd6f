"""Lights and maps → radiance and its Jacobian: the forward model.

    from invrender.render import Fast, make_scene

    renderer = Fast(make_scene(rig, pattern, environment, gain))
    image = renderer.render(maps)

The names below load Dr.Jit when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from invrender.render.fast.estimator import Fast
    from invrender.render.mis import Mis
    from invrender.render.renderer import Material, Renderer
    from invrender.render.scene import Scene, make_scene, make_view

__all__ = ["Fast", "Material", "Mis", "Renderer", "Scene", "make_scene", "make_view"]

_HOMES = {
    "Fast": "fast.estimator", "Mis": "mis", "Material": "renderer", "Renderer": "renderer",
    "Scene": "scene", "make_scene": "scene", "make_view": "scene",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
