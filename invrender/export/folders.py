"""Folders of textures with the names, packing and colour spaces that programs expect.

Blender's Node Wrangler tells what a file is by the last words of its name; Unreal packs roughness
and metalness into one file with ambient occlusion, of which a flat sample has none; Unity's
specular workflow has k_d, k_s and smoothness = 1 - roughness as they are.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from invrender.export.material import Material, height_texture, normal_texture, normals_seen
from invrender.export.metalrough import MetalRough, maps_of, with_grey_f0
from invrender.export.textures import Texture, safe_name, whole_folder, write_textures
from invrender.maps import Maps
from invrender.types import Array, InputError

WHITE_F0 = (
    0.08  # reflectance of "specular" = 1 in Unreal and of "specular IOR level" = 1 in Blender
)


def write_blender(material: Material, out: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write ``NAME_BaseColor``, ``_Metallic``, ``_Specular``, ``_Roughness``, ``_Normal`` and, with
    a height, ``_Displacement``.

    In Blender: select the Principled BSDF, Ctrl+Shift+T, and choose all files.
    """
    maps, name = material.maps, safe_name(material.name)
    mr = with_grey_f0(maps, WHITE_F0)
    textures = {
        f"{name}_BaseColor": Texture(mr.base, colour=True),
        f"{name}_Metallic": Texture(mr.metallic),
        f"{name}_Specular": Texture(mr.f0 / WHITE_F0),
        f"{name}_Roughness": Texture(maps.roughness),
        f"{name}_Normal": normal_texture(maps.normal, convention),
    }
    if material.height is not None:
        textures[f"{name}_Displacement"] = height_texture(material.height)
    with whole_folder(out) as folder:
        seen = write_textures(folder, textures, format)
    base, metal, f0, rough, normal = (seen[k] for k in list(textures)[:5])
    back = maps_of(MetalRough(base, metal, f0 * WHITE_F0), rough, normals_seen(normal, convention))
    return {"Principled BSDF": back}


def write_unreal(material: Material, out: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write ``T_NAME_BC T_NAME_ORM T_NAME_S T_NAME_N [T_NAME_H]``: base colour (sRGB); ambient
    occlusion, roughness and metalness in R, G and B; specular; normal."""
    maps, name = material.maps, safe_name(material.name)
    mr = with_grey_f0(maps, WHITE_F0)
    orm = np.stack([np.ones_like(maps.roughness), maps.roughness, mr.metallic], -1)
    textures = {
        f"T_{name}_BC": Texture(mr.base, colour=True),
        f"T_{name}_ORM": Texture(orm),
        f"T_{name}_S": Texture(mr.f0 / WHITE_F0),
        f"T_{name}_N": normal_texture(maps.normal, convention),
    }
    if material.height is not None:
        textures[f"T_{name}_H"] = height_texture(material.height)
    with whole_folder(out) as folder:
        seen = write_textures(folder, textures, format)
    base, orm, f0, normal = (seen[k] for k in list(textures)[:4])
    back = maps_of(
        MetalRough(base, orm[..., 2], f0 * WHITE_F0),
        orm[..., 1],
        normals_seen(normal, convention),
    )
    return {"default lit": back}


def write_unity(material: Material, out: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write ``NAME_Albedo NAME_SpecularSmoothness NAME_Normal [NAME_Height]`` for the specular
    workflow: k_d (sRGB); k_s (sRGB) with smoothness in its alpha; normal. Unity multiplies the
    albedo by 1 - max(k_s), so it is divided by that here."""
    if format == "jpeg":
        raise InputError("Unity keeps smoothness in an alpha channel, which JPEG has not; use png8")
    maps, name = material.maps, safe_name(material.name)
    packed = np.concatenate([maps.specular, 1 - maps.roughness[..., None]], -1)
    textures = {
        f"{name}_Albedo": Texture(np.minimum(maps.diffuse / _unreflected(maps.specular), 1), True),
        f"{name}_SpecularSmoothness": Texture(packed, colour=True),
        f"{name}_Normal": normal_texture(maps.normal, convention),
    }
    if material.height is not None:
        textures[f"{name}_Height"] = height_texture(material.height)
    with whole_folder(out) as folder:
        seen = write_textures(folder, textures, format)
    albedo, packed, normal = (seen[k] for k in list(textures)[:3])
    specular, smoothness = packed[..., :3], packed[..., 3]
    diffuse = albedo * _unreflected(specular)
    back = Maps(diffuse, specular, 1 - smoothness, normals_seen(normal, convention))
    return {"specular workflow": back}


def _unreflected(specular: Array) -> Array:
    """1 - max(k_s), (H, W, 1): the share of light that Unity leaves to the diffuse part."""
    return np.maximum(1 - specular.max(-1, keepdims=True), 1e-4)
