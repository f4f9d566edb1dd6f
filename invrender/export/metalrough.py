"""Between our two albedos and the metal-rough parameters of game engines and glTF.

    k_d = base·(1 - metallic),    k_s = f0·(1 - metallic) + base·metallic,

where f0, the reflectance of the part that is no metal, is 0.04 unless a renderer takes it as a map.
Six numbers a pixel become four, so the conversion has an error, which the exporters report.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from invrender.maps import Maps
from invrender.types import Array

F0 = 0.04  # of a dielectric with a refractive index of 1.5
# Reflectance of "specular" = 1 in Unreal and of "specular IOR level" = 1 in Blender.
WHITE_F0 = 0.08
WHITE_IOR = (1 + WHITE_F0**0.5) / (1 - WHITE_F0**0.5)  # the refractive index of it


@dataclass
class MetalRough:
    """base: (H, W, 3) linear; metallic: (H, W); f0: (H, W) or (H, W, 3), the dielectric part's."""

    base: Array
    metallic: Array
    f0: Array


def metallic(maps: Maps) -> Array:
    """(H, W): the metalness at which the mean specular albedo comes out right.

    With D and S the means of k_d and k_s over the channels, base eliminated from the equations
    above leaves F0·m² + m·(D + S - 2·F0) + F0 - S = 0, solved without cancellation.
    """
    d, s = maps.diffuse.mean(-1, dtype=np.float32), maps.specular.mean(-1, dtype=np.float32)
    extra = np.maximum(s - F0, 0)
    b = d + s - 2 * F0
    root = np.sqrt(b * b + 4 * F0 * extra)
    m = 2 * extra / np.maximum(b + root, 1e-6)
    return np.clip(m, 0, 1).astype(np.float32)


def metal_rough(maps: Maps) -> MetalRough:
    """The closest metal-rough material: base by least squares over k_d and k_s, f0 = 0.04."""
    m = metallic(maps)
    n = m[..., None]
    dielectric = 1 - n
    base = dielectric * maps.diffuse + n * (maps.specular - F0 * dielectric)
    base = np.clip(base / (dielectric**2 + n**2), 0, 1).astype(np.float32)
    return MetalRough(base, m, np.full(m.shape, F0, np.float32))


def with_grey_f0(maps: Maps, highest: float = WHITE_F0) -> MetalRough:
    """As `metal_rough`, with the dielectric's f0 in [0, highest] per pixel, as Unreal's and
    Blender's "specular" set it."""
    mr = metal_rough(maps)
    m = mr.metallic[..., None]
    rest = np.maximum(maps.specular - m * mr.base, 0).mean(-1)
    f0 = np.clip(rest / np.maximum(1 - mr.metallic, 1e-3), 0, highest)
    # Where there is hardly any dielectric its f0 says nothing.
    f0 = np.where(mr.metallic > 0.99, F0, f0).astype(np.float32)
    return MetalRough(mr.base, mr.metallic, f0)


def with_coloured_f0(maps: Maps, m: Array) -> MetalRough:
    """An exact k_s at the given metalness (H, W), by the coloured f0 that the glTF extension
    KHR_materials_specular has; k_d as near as that leaves it, exact where m = 0.

    base = k_d/(1 - m) makes k_d exact; f0 = (k_s - m·base)/(1 - m) must lie in [0, 1], so base is
    moved into [(k_s - (1 - m))/m, k_s/m].
    """
    n = m[..., None]
    dielectric = np.maximum(1 - n, 1e-6)
    metal = np.maximum(n, 1e-6)
    least = np.maximum((maps.specular - dielectric) / metal, 0)
    most = np.where(n > 0, np.minimum(maps.specular / metal, 1), 1)
    base = np.clip(maps.diffuse / dielectric, least, np.maximum(most, least))
    f0 = np.clip((maps.specular - n * base) / dielectric, 0, 1)
    return MetalRough(base.astype(np.float32), m, f0.astype(np.float32))


def maps_of(mr: MetalRough, roughness: Array, normal: Array) -> Maps:
    """The maps that a renderer sees in metal-rough parameters."""
    m = mr.metallic[..., None]
    f0 = mr.f0 if mr.f0.ndim == 3 else mr.f0[..., None]
    return Maps(
        np.clip(mr.base * (1 - m), 0, 1),
        np.clip(f0 * (1 - m) + mr.base * m, 0, 1),
        roughness,
        normal,
    )
