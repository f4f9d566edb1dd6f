"""The image of maps under lights, from arrays to an array."""

from __future__ import annotations

from invrender.lights import Lights
from invrender.maps import Maps
from invrender.render.near import renderer_under
from invrender.types import Array


def render(maps: Maps, lights: Lights, *, samples: int = 256, seed: int = 0) -> Array:
    """Image (H, W, 3) of the sample as the camera sees it, linear RGB radiance, float32.

    The unit is that of the lights. samples: of the specular lobe; what they leave of noise differs
    by ``seed``. Raises `InputError` for lights of a wrong shape, negative or not finite. For many
    images under the same lights, for gradients, or without bias, see `invrender.render.Renderer`.

        image = invrender.render(maps, invrender.Lights(Rig(), pattern, gain=2.0))
    """
    return renderer_under(lights).render(maps, samples, seed)
