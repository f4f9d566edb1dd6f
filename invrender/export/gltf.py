"""glTF 2.0 binary (.glb): a rectangle of the sample's size with the material on it.

The material is metal-rough, as the core asks, with KHR_materials_specular for the k_s that
metal-rough cannot hold: the dielectric part's f0 = 0.04 · specularColor (Khronos, "glTF 2.0
Specification" and "KHR_materials_specular"). The rectangle stands in the xy plane and faces +z, the
way viewers look at a model; the sample's +y is up.
"""

from __future__ import annotations

import json
import os
import struct
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from invrender.export.material import Material, normal_texture, normals_seen
from invrender.export.metalrough import F0, MetalRough, maps_of, metallic, with_coloured_f0
from invrender.export.textures import Texture, as_read, encoded
from invrender.maps import Maps
from invrender.types import Array

FLOAT, UINT16 = 5126, 5123
ARRAY_BUFFER, ELEMENT_BUFFER = 34962, 34963
WORST_DIFFUSE = 0.005  # RMSE of k_d above which the material is written without metal


def write_gltf(material: Material, folder: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write ``NAME.glb``; returns the maps that a viewer sees, with the extension and without it.

    Metalness, base colour and f0 are rounded to bytes one after the other, each making up for the
    rounding before it. A material that no metalness suits is written with metallic = 0, all of k_s
    in the extension: exact with it, and without it only the diffuse part.
    """
    maps = material.maps
    mr = _split(maps, format)
    needed = mr.f0 / F0
    weight = F0 * (1 - mr.metallic[..., None])
    # The texture's white: as low as changes no pixel's k_s by more than half a byte.
    scale = max(1.0, float((needed - 1 / (510 * np.maximum(weight, 1e-6))).max()))
    textures = {
        "base": Texture(mr.base, colour=True),
        "orm": _rough_metal(maps.roughness, mr.metallic),
        "normal": normal_texture(maps.normal, convention),
        "specular": Texture(np.clip(needed / scale, 0, 1), colour=True),
    }
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = pool.map(encoded, textures.values(), [format] * len(textures))
        files = dict(zip(textures, done, strict=True))
    path = folder / f"{material.name}.glb"
    _write_glb(material, path, {k: data for k, (data, _) in files.items()}, format, scale)
    seen = {k: image for k, (_, image) in files.items()}
    rough, metal = seen["orm"][..., 1], seen["orm"][..., 2]
    normal = normals_seen(seen["normal"], convention)
    f0 = np.minimum(F0 * scale * seen["specular"], 1)
    return {
        "KHR_materials_specular": maps_of(MetalRough(seen["base"], metal, f0), rough, normal),
        "metal-rough only": maps_of(
            MetalRough(seen["base"], metal, np.full_like(metal, F0)), rough, normal
        ),
    }


def move_glb(folder: Path, out: Path) -> None:
    """Move the one ``.glb`` of a folder."""
    (file,) = folder.glob("*.glb")
    os.replace(file, out)


def _split(maps: Maps, format: str) -> MetalRough:
    """Metalness, then base, then f0, each computed from the rounded ones before it."""

    m = as_read(_rough_metal(maps.roughness, metallic(maps)), format)[..., 2]
    for metal in (m, np.zeros_like(m)):
        mr = with_coloured_f0(maps, metal)
        base = as_read(Texture(mr.base, colour=True), format)
        error = mr.base * (1 - metal[..., None]) - maps.diffuse
        if np.sqrt(np.mean(error**2)) <= WORST_DIFFUSE:
            break
    n = metal[..., None]
    f0 = (maps.specular - n * base) / np.maximum(1 - n, 1e-6)
    return MetalRough(mr.base, metal, np.clip(f0, 0, 1))


def _rough_metal(roughness: Array, metallic: Array) -> Texture:
    return Texture(np.stack([np.ones_like(roughness), roughness, metallic], -1))


def _write_glb(
    material: Material, path: Path, images: dict[str, bytes], format: str, scale: float
) -> None:
    w, h = (s / 2 for s in material.sides)
    corners = np.array([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]], "<f4")
    geometry: list[tuple[str, bytes, dict[str, Any]]] = [
        ("POSITION", corners.tobytes(), {"type": "VEC3", "componentType": FLOAT, "count": 4,
         "min": corners.min(0).tolist(), "max": corners.max(0).tolist()}),
        ("NORMAL", np.tile(np.array([0, 0, 1], "<f4"), 4).tobytes(),
         {"type": "VEC3", "componentType": FLOAT, "count": 4}),
        ("TANGENT", np.tile(np.array([1, 0, 0, 1], "<f4"), 4).tobytes(),
         {"type": "VEC4", "componentType": FLOAT, "count": 4}),
        # Row 0 of an image is at v = 0.
        ("TEXCOORD_0", np.array([0, 1, 1, 1, 1, 0, 0, 0], "<f4").tobytes(),
         {"type": "VEC2", "componentType": FLOAT, "count": 4}),
        ("", np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes(),
         {"type": "SCALAR", "componentType": UINT16, "count": 6}),
    ]  # fmt: skip
    blob, views = b"", []
    for data in [g[1] for g in geometry] + list(images.values()):
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        blob += data + bytes(-len(data) % 4)
    for view in views[:4]:
        view["target"] = ARRAY_BUFFER
    views[4]["target"] = ELEMENT_BUFFER
    mime = "image/jpeg" if format == "jpeg" else "image/png"
    index = {key: {"index": i} for i, key in enumerate(images)}
    document = {
        "asset": {"version": "2.0", "generator": f"invrender {version('invrender')}"},
        "extensionsUsed": ["KHR_materials_specular"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": material.name}],
        "meshes": [{"primitives": [{
            "attributes": {name: i for i, (name, _, _) in enumerate(geometry) if name},
            "indices": 4,
            "material": 0,
        }]}],
        "materials": [{
            "name": material.name,
            "pbrMetallicRoughness": {
                "baseColorTexture": index["base"],
                "metallicRoughnessTexture": index["orm"],
            },
            "normalTexture": index["normal"],
            "extensions": {"KHR_materials_specular": {
                "specularColorTexture": index["specular"],
                "specularColorFactor": [scale] * 3,
            }},
        }],
        "textures": [{"sampler": 0, "source": i} for i in range(len(images))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497}],
        "images": [
            {"bufferView": len(geometry) + i, "mimeType": mime, "name": f"{material.name}_{key}"}
            for i, key in enumerate(images)
        ],
        "accessors": [{"bufferView": i, **g[2]} for i, g in enumerate(geometry)],
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob)}],
    }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as f:
        f.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(blob)))
        f.write(struct.pack("<I4s", len(text), b"JSON") + text)
        f.write(struct.pack("<I4s", len(blob), b"BIN\0") + blob)
