"""Maps under point lights: what relighting shows, and the field's re-render error is measured on.

The lights are small, so one evaluation of the BRDF a pixel and light is exact.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from invrender.maps import Maps
from invrender.render import brdf
from invrender.render.backend import Float, dr, vector
from invrender.render.renderer import MIN_ROUGHNESS, Material
from invrender.rig import Rig
from invrender.types import Array

GAMMA = 2.2  # of the re-render error's display, as in the literature


def reflect(material: Material, l: Any, v: Any) -> Any:
    """f(l, v)·(n·l), an Array3, for unit world directions to the light and to the viewer.

    Zero where the light is below the shading normal's horizon.
    """
    n = dr.normalize(material.normal)
    s, t = brdf.frame(n)
    local_l, local_v = brdf.to_local(l, s, t, n), brdf.to_viewer(v, s, t, n)
    alpha = dr.square(dr.maximum(material.roughness, MIN_ROUGHNESS))
    value, weight = brdf.specular(local_l, local_v, alpha)
    fresnel = dr.fma(1 - material.specular, weight, material.specular)
    return material.diffuse * (dr.maximum(local_l.z, 0) / dr.pi) + fresnel * value


def grid_lights(rig: Rig) -> Array:
    """The nine lights of the re-render error, (9, 3): a 3 × 3 grid over the sample at height h."""
    steps = np.array([-1.0, 0.0, 1.0]) * rig.sample_size / 2
    return np.array([[x, y, rig.screen_height] for y in steps[::-1] for x in steps])


def relight(maps: Maps, rig: Rig, lights: Array) -> Array:
    """Radiance (N, H, W, 3) of the sample under each of N point lights, seen from the camera.

    lights: (N, 3), metres, above the table. Their power is such that a white diffuse sample
    straight below a light at the screen's height has radiance 1; it falls with squared distance.
    """
    height, width = maps.shape
    vec3 = vector(Float, 3)
    material = Material.from_maps(maps)
    x = vec3(rig.sample_points(height, width).reshape(-1, 3).T.astype(np.float32))
    place = lambda p: vec3(*(dr.opaque(Float, float(c)) for c in p))  # noqa: E731
    v = dr.normalize(place(rig.camera) - x)
    images = np.empty((len(lights), height, width, 3), np.float32)
    for image, light in zip(images, lights, strict=True):
        to_light = place(light) - x
        distance2 = dr.squared_norm(to_light)
        l = to_light * dr.rsqrt(distance2)
        power = dr.opaque(Float, np.pi * rig.screen_height**2)
        color = reflect(material, l, v) * (power / distance2)
        image[...] = np.asarray(color).T.reshape(height, width, 3)
    return images


def rerender(maps: Maps, rig: Rig | None = None) -> Array:
    """The nine re-rendered images (9, H, W, 3) as displayed: clipped to [0, 1], gamma 1/2.2."""
    rig = rig or Rig()
    return np.clip(relight(maps, rig, grid_lights(rig)), 0, 1) ** np.float32(1 / GAMMA)
