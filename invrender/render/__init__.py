"""Lights and maps → radiance and its Jacobian: the forward model.

    renderer = Fast.under(Lights(rig, pattern, environment, gain))
    material = Material.from_maps(maps)  # Dr.Jit arrays, one entry a pixel
    color = renderer.radiance(make_view(renderer.scene, *maps.shape), material, samples=64)

`Renderer` is what either of its kinds can do, `Fast` and `Mis`. Called by its own name,
`invrender.render` is the function of `invrender.render.image`. The names below load Dr.Jit when
they are first used.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING

from lazy_loader import attach

if TYPE_CHECKING:
    from invrender.lights import Lights
    from invrender.maps import Maps
    from invrender.render.fast.estimator import Fast
    from invrender.render.mis import Mis
    from invrender.render.renderer import Material, Renderer
    from invrender.render.scene import Scene, make_scene, make_view
    from invrender.types import Array

__all__ = ["Fast", "Material", "Mis", "Renderer", "Scene", "make_scene", "make_view"]

__getattr__, __dir__, _ = attach(
    __name__,
    submod_attrs={
        "fast.estimator": ["Fast"],
        "mis": ["Mis"],
        "renderer": ["Material", "Renderer"],
        "scene": ["Scene", "make_scene", "make_view"],
    },
)


class _Render(ModuleType):
    """A module that can be called: `invrender.render` is a function's name too."""

    def __call__(self, maps: Maps, lights: Lights, *, samples: int = 256, seed: int = 0) -> Array:
        from invrender.render.image import render

        return render(maps, lights, samples=samples, seed=seed)


sys.modules[__name__].__class__ = _Render
