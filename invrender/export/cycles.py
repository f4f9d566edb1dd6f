"""What Blender's Cycles makes of a Principled BSDF that holds our maps.

By default its GGX reflects again what single scattering loses, a factor of
1 + F_ms·(1 - E)/E with F_ms = F_ss·E / (1 - F_ss·(1 - E)) and F_ss = f0 + (1 - f0)/21, where E is
the albedo of the lobe without Fresnel [Kulla and Conty 2017, "Revisiting physically based shading
at Imageworks"; Turquin 2019, "Practical multiple scattering compensation for microfacet models"].
The diffuse part gets what the dielectric's reflection leaves.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.ndimage import map_coordinates

from invrender.export.metalrough import MetalRough
from invrender.maps import Maps
from invrender.rig import Rig
from invrender.types import Array

TABLE_ENTRIES = 32  # of the table, along the cosine to the viewer and along α
QUADRATURE_STEPS = 24  # of the quadrature, along both random numbers


def principled(mr: MetalRough, roughness: Array, normal: Array) -> Maps:
    """The maps (ours, single scattering) that shine as Cycles' do, seen from the rig's camera.

    mr: with a grey f0. Exact where all light comes from one side of the lobe's peak; k_s may exceed
    1, as the light that is reflected again is added to it.
    """
    rig = Rig()
    view = (rig.camera - rig.sample_points(*roughness.shape)).astype(np.float32)
    length = np.sqrt(np.einsum("ijk,ijk->ij", view, view))
    cosine = np.clip(np.einsum("ijk,ijk->ij", view, normal) / length, 0, 1)
    at = np.stack([cosine, np.square(roughness)]) * np.float32(TABLE_ENTRIES - 1)
    flat, grazing = (map_coordinates(t, at, output=np.float32, order=1) for t in _albedo())
    m = mr.metallic[..., None]
    flat, grazing = flat[..., None], grazing[..., None]
    f0 = mr.f0[..., None]
    metal, dielectric = (_gain(reflectance, flat + grazing) for reflectance in (mr.base, f0))
    kept = 1 - dielectric * (f0 * flat + grazing)
    return Maps(
        (mr.base * (1 - m) * kept).astype(np.float32),
        (f0 * (1 - m) * dielectric + mr.base * m * metal).astype(np.float32),
        roughness,
        normal,
    )


def _gain(f0: Array, albedo: Array) -> Array:
    """By how much light that is reflected again brightens a lobe of this albedo without Fresnel."""
    mean = f0 + (1 - f0) / 21
    again = mean * albedo / (1 - mean * (1 - albedo))
    return 1 + again * (1 - albedo) / albedo


@cache
def _albedo() -> tuple[Array, Array]:
    """Tables (cosine to the viewer, α) from 0 to 1 of A and B: a GGX lobe with Schlick's Fresnel
    reflects f0·A + B of the light of an even sky.

    By half vectors from the visible normals; see `invrender.render.brdf.sample_vndf`.
    """
    axis = np.linspace(0, 1, TABLE_ENTRIES)
    mu, alpha = np.maximum(axis, 1e-3)[:, None, None], np.maximum(axis, 1e-3)[None, :, None]
    u = (np.arange(QUADRATURE_STEPS) + 0.5) / QUADRATURE_STEPS
    u1, u2 = (g.ravel() for g in np.meshgrid(u, u))
    sine = np.sqrt(1 - mu**2)
    length = np.hypot(alpha * sine, mu)
    wx, wz = alpha * sine / length, mu / length
    z = (1 - u2) * (1 + wz) - wz
    r = np.sqrt(np.clip(1 - z * z, 0, 1))
    h = np.stack([
        alpha * (r * np.cos(2 * np.pi * u1) + wx), alpha * r * np.sin(2 * np.pi * u1), z + wz
    ])  # fmt: skip
    h /= np.linalg.norm(h, axis=0)
    v_dot_h = sine * h[0] + mu * h[2]
    cosine = 2 * v_dot_h * h[2] - mu
    up = cosine > 0
    cosine = np.where(up, cosine, 1)

    def root(c: Array) -> Array:
        return np.sqrt(alpha**2 + (1 - alpha**2) * c * c)

    # G2/G1 of the height-correlated Smith shadowing.
    seen = up * cosine * (mu + root(mu)) / (mu * root(cosine) + cosine * root(mu))
    schlick = (1 - v_dot_h) ** 5
    return (seen * (1 - schlick)).mean(-1), (seen * schlick).mean(-1)
