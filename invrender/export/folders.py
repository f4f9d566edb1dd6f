"""Folders of textures with the names, packing and colour spaces that programs expect.

Metal-rough sets differ in their files' names alone (`Naming`); Unity's specular workflow has k_d,
k_s and smoothness = 1 - roughness as they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from invrender.export.blender_script import SCRIPT
from invrender.export.cycles import principled
from invrender.export.material import (
    Material,
    height_range,
    height_texture,
    normal_texture,
    normals_seen,
)
from invrender.export.metalrough import (
    WHITE_F0,
    MetalRough,
    maps_of,
    metal_rough,
    with_grey_f0,
)
from invrender.export.textures import FORMAT_SUFFIXES, Texture, write_textures
from invrender.maps import Maps
from invrender.types import Array, InputError


@dataclass(frozen=True)
class Naming:
    """Files of a metal-rough set, without their suffix; None where the set has no such file.

    ``{name}`` is the material's, ``{size}`` its pixels as in "2K" or "512x512", ``{format}`` "PNG",
    ``{green}`` "GL" or "DX". Without a file for the dielectric's specular reflectance f0 is 0.04.
    ``orm`` packs occlusion, roughness and metalness into R, G and B. The height and the occlusion
    are written where there is a height.
    """

    base: str
    normal: str
    height: str
    roughness: str | None = None
    metallic: str | None = None
    orm: str | None = None
    specular: str | None = None
    occlusion: str | None = None


# Node Wrangler (Ctrl+Shift+T on the Principled BSDF) goes by the last words of the names.
BLENDER = Naming(
    "{name}_BaseColor", "{name}_Normal", "{name}_Displacement", "{name}_Roughness",
    "{name}_Metallic", specular="{name}_Specular",
)  # fmt: skip
UNREAL = Naming(
    "T_{name}_BC", "T_{name}_N", "T_{name}_H", orm="T_{name}_ORM", specular="T_{name}_S"
)
# Godot's ORMMaterial3D.
GODOT = Naming("{name}_albedo", "{name}_normal", "{name}_height", orm="{name}_orm")
AMBIENTCG = Naming(
    "{name}_{size}-{format}_Color", "{name}_{size}-{format}_Normal{green}",
    "{name}_{size}-{format}_Displacement", "{name}_{size}-{format}_Roughness",
    "{name}_{size}-{format}_Metalness", occlusion="{name}_{size}-{format}_AmbientOcclusion",
)  # fmt: skip
POLYHAVEN = Naming(
    "{name}_diff_{size}", "{name}_nor_{green}_{size}", "{name}_disp_{size}", "{name}_rough_{size}",
    "{name}_metal_{size}", occlusion="{name}_ao_{size}",
)  # fmt: skip


def write_blender(
    material: Material, folder: Path, format: str, convention: str
) -> dict[str, Maps]:
    """Write a set of `BLENDER`'s names, and ``NAME.py`` with ``NAME_kd`` and ``NAME_ks``, of which
    it makes our own reflectance in Blender."""
    maps, name = material.maps, material.name
    mr, rough, normal = write_metal_rough(material, folder, format, convention, BLENDER)
    albedos = {
        f"{name}_kd": Texture(maps.diffuse, colour=True),
        f"{name}_ks": Texture(maps.specular, colour=True),
    }
    seen = write_textures(folder, albedos, format, material.width)
    diffuse, specular = seen.values()
    script = SCRIPT.format(
        name=name,
        suffix=FORMAT_SUFFIXES[format],
        sides=material.sides,
        colour="Linear Rec.709" if format == "exr" else "sRGB",
        green_up=convention == "opengl",
        height=None if material.height is None else height_range(material.height),
    )
    (folder / f"{name}.py").write_text(script, encoding="utf-8")
    return {
        f"{name}.py": Maps(diffuse, specular, rough, normal),
        "Principled BSDF": principled(mr, rough, normal),
    }


def write_unreal(material: Material, folder: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write a set of `UNREAL`'s names."""
    return {
        "default lit": maps_of(*write_metal_rough(material, folder, format, convention, UNREAL))
    }


def write_godot(material: Material, folder: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write a set of `GODOT`'s names."""
    return {
        "ORMMaterial3D": maps_of(*write_metal_rough(material, folder, format, convention, GODOT))
    }


def write_ambientcg(
    material: Material, folder: Path, format: str, convention: str
) -> dict[str, Maps]:
    """Write a set named as ambientCG names its own: ``NAME_1K-PNG_Color``."""
    return {
        "metal-rough": maps_of(*write_metal_rough(material, folder, format, convention, AMBIENTCG))
    }


def write_polyhaven(
    material: Material, folder: Path, format: str, convention: str
) -> dict[str, Maps]:
    """Write a set named as Poly Haven names its own: ``NAME_diff_1k``."""
    return {
        "metal-rough": maps_of(*write_metal_rough(material, folder, format, convention, POLYHAVEN))
    }


def write_metal_rough(
    material: Material, folder: Path, format: str, convention: str, naming: Naming
) -> tuple[MetalRough, Array, Array]:
    """Write a metal-rough set; returns the material, roughness and normals that a reader sees."""
    maps = material.maps
    mr = with_grey_f0(maps, WHITE_F0) if naming.specular else metal_rough(maps)
    textures = {
        "base": Texture(mr.base, colour=True),
        "normal": normal_texture(maps.normal, convention),
    }
    if naming.orm:
        textures["orm"] = Texture(np.stack([material.occlusion, maps.roughness, mr.metallic], -1))
    if naming.roughness:
        textures["roughness"] = Texture(maps.roughness)
    if naming.metallic:
        textures["metallic"] = Texture(mr.metallic)
    if naming.specular:
        textures["specular"] = Texture(mr.f0 / WHITE_F0)
    if material.height is not None:
        textures["height"] = height_texture(material.height)
        if naming.occlusion:
            textures["occlusion"] = Texture(material.occlusion)
    rows, columns = maps.shape
    size = f"{columns // 1024}K" if columns % 1024 == 0 else f"{columns}x{rows}"
    green = "DX" if convention == "directx" else "GL"
    if naming is POLYHAVEN:
        size, green = size.lower(), green.lower()
    kind = {"jpeg": "JPG", "exr": "EXR"}.get(format, "PNG")
    names = {
        key: getattr(naming, key).format(name=material.name, size=size, format=kind, green=green)
        for key in textures
    }
    files = {names[key]: texture for key, texture in textures.items()}
    written = write_textures(folder, files, format, material.width)
    seen = {key: written[name] for key, name in names.items()}
    if naming.orm:
        seen["roughness"], seen["metallic"] = seen["orm"][..., 1], seen["orm"][..., 2]
    f0 = seen["specular"] * WHITE_F0 if naming.specular else mr.f0
    return (
        MetalRough(seen["base"], seen["metallic"], f0),
        seen["roughness"],
        normals_seen(seen["normal"], convention),
    )


def write_unity(material: Material, folder: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write ``NAME_Albedo NAME_SpecularSmoothness NAME_Normal [NAME_Height NAME_Occlusion]`` for
    the specular workflow: k_d (sRGB); k_s (sRGB) with smoothness in its alpha; normal. Unity
    multiplies the albedo by 1 - max(k_s), so it is divided by that here."""
    if format == "jpeg":
        raise InputError("Unity keeps smoothness in an alpha channel, which JPEG has not; use png8")
    maps, name = material.maps, material.name
    packed = np.concatenate([maps.specular, 1 - maps.roughness[..., None]], -1)
    textures = {
        f"{name}_Albedo": Texture(np.minimum(maps.diffuse / _unreflected(maps.specular), 1), True),
        f"{name}_SpecularSmoothness": Texture(packed, colour=True),
        f"{name}_Normal": normal_texture(maps.normal, convention),
    }
    if material.height is not None:
        textures[f"{name}_Height"] = height_texture(material.height)
        textures[f"{name}_Occlusion"] = Texture(material.occlusion)
    seen = write_textures(folder, textures, format, material.width)
    albedo, packed, normal = (seen[k] for k in list(textures)[:3])
    specular, smoothness = packed[..., :3], packed[..., 3]
    diffuse = albedo * _unreflected(specular)
    back = Maps(diffuse, specular, 1 - smoothness, normals_seen(normal, convention))
    return {"specular workflow": back}


def _unreflected(specular: Array) -> Array:
    """1 - max(k_s), (H, W, 1): the share of light that Unity leaves to the diffuse part."""
    return np.maximum(1 - specular.max(-1, keepdims=True), 1e-4)
