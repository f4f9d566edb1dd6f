"""MaterialX (.mtlx) with its textures, written and validated by the MaterialX library.

Three materials share the textures. NAME is our BRDF in MaterialX's own closures: a Lambertian plus
a generalised Schlick lobe with F0 = k_s, F90 = 1 and GGX of α = ρ². NAME_open_pbr (OpenPBR 1.1) and
NAME_standard_surface (Autodesk's, for older renderers) are metal-rough; OpenPBR's specular weight
holds the dielectric part's f0 per pixel.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from invrender.export.material import (
    Material,
    height_range,
    height_texture,
    normal_texture,
    normals_seen,
)
from invrender.export.metalrough import (
    F0,
    WHITE_F0,
    WHITE_IOR,
    MetalRough,
    maps_of,
    with_grey_f0,
)
from invrender.export.textures import FORMAT_SUFFIXES, Texture, write_textures
from invrender.maps import Maps
from invrender.types import InputError


def write_materialx(
    material: Material, folder: Path, format: str, convention: str
) -> dict[str, Maps]:
    """Write ``NAME.mtlx`` and its textures; raises `InputError` without the materialx package."""
    try:
        import MaterialX as mx
    except ImportError:
        raise InputError(
            "MaterialX files need the materialx package: pip install 'invrender[export]'"
        ) from None
    maps, name = material.maps, material.name
    mr = with_grey_f0(maps, WHITE_F0)
    textures = {
        f"{name}_diffuse": Texture(maps.diffuse, colour=True),
        f"{name}_specular": Texture(maps.specular, colour=True),
        f"{name}_roughness": Texture(maps.roughness),
        f"{name}_normal": normal_texture(maps.normal, convention),
        f"{name}_base": Texture(mr.base, colour=True),
        f"{name}_metalness": Texture(mr.metallic),
        f"{name}_specular_weight": Texture(mr.f0 / WHITE_F0),
    }
    if material.height is not None:
        textures[f"{name}_height"] = height_texture(material.height)
    document = _document(mx, material, name, format)
    valid, message = document.validate()
    if not valid:
        raise RuntimeError(f"the MaterialX document is not valid: {message}")
    mx.writeToXmlFile(document, str(folder / f"{name}.mtlx"), _own_elements(mx))
    seen = write_textures(folder, textures, format, material.width)
    diffuse, specular, rough, normal, base, metal, weight = (seen[k] for k in list(textures)[:7])
    n = normals_seen(normal, convention)
    return {
        name: Maps(diffuse, specular, rough, n),
        f"{name}_open_pbr": maps_of(MetalRough(base, metal, weight * WHITE_F0), rough, n),
        f"{name}_standard_surface": maps_of(
            MetalRough(base, metal, np.full_like(metal, F0)), rough, n
        ),
    }


def _own_elements(mx: Any) -> Any:
    """Leave the standard library, which every reader has, out of the file."""
    options = mx.XmlWriteOptions()
    options.elementPredicate = lambda element: not element.hasSourceUri()
    return options


def _document(mx: Any, material: Material, name: str, format: str) -> Any:
    element = re.sub(r"\W", "_", name, flags=re.ASCII)  # names of elements, unlike files, are ASCII
    document = mx.createDocument()
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    document.setDataLibrary(library)
    document.setColorSpace("lin_rec709")
    graph = document.addNodeGraph(f"NG_{element}")
    colour_space = "lin_rec709" if format == "exr" else "srgb_texture"

    def image(key: str, kind: str, colour: bool = False) -> Any:
        node = graph.addNode("image", f"image_{key}", kind)
        file = node.setInputValue("file", f"{name}_{key}{FORMAT_SUFFIXES[format]}", "filename")
        if colour:
            file.setColorSpace(colour_space)
        return node

    def output(key: str, node: Any, kind: str) -> None:
        graph.addOutput(f"out_{key}", kind).setConnectedNode(node)

    for key in ("diffuse", "specular", "base"):
        output(key, image(key, "color3", colour=True), "color3")
    for key in ("roughness", "metalness", "specular_weight"):
        output(key, image(key, "float"), "float")
    normal = graph.addNode("normalmap", "normalmap", "vector3")
    normal.setConnectedNode("in", image("normal", "vector3"))
    output("normal", normal, "vector3")

    def connect(node: Any, **sources: str) -> Any:
        for key, source in sources.items():
            kind = graph.getOutput(f"out_{source}").getType()
            node.addInput(key, kind).setConnectedOutput(graph.getOutput(f"out_{source}"))
        return node

    displacement = None
    if material.height is not None:
        output("height", image("height", "float"), "float")
        low, high = height_range(material.height)
        displacement = document.addNode("displacement", f"{element}_relief", "displacementshader")
        connect(displacement, displacement="height")
        displacement.setInputValue("scale", max(high - low, 1e-12), "float")

    alpha = graph.addNode("roughness_anisotropy", "alpha", "vector2")
    alpha.setConnectedNode("roughness", graph.getNode("image_roughness"))
    output("alpha", alpha, "vector2")
    lambert = document.addNode("oren_nayar_diffuse_bsdf", f"{element}_lambert", "BSDF")
    connect(lambert, color="diffuse", normal="normal")
    lobe = document.addNode("generalized_schlick_bsdf", f"{element}_lobe", "BSDF")
    connect(lobe, color0="specular", roughness="alpha", normal="normal")
    both = document.addNode("add", f"{element}_bsdf", "BSDF")
    both.setConnectedNode("in1", lambert)
    both.setConnectedNode("in2", lobe)
    surface = document.addNode("surface", f"{element}_surface", "surfaceshader")
    surface.setConnectedNode("bsdf", both)

    standard = document.addNode("standard_surface", f"{element}_standard", "surfaceshader")
    connect(standard, base_color="base", metalness="metalness", specular_roughness="roughness",
            normal="normal")  # fmt: skip
    standard.setInputValue("base", 1.0, "float")
    open_pbr = document.addNode("open_pbr_surface", f"{element}_open_pbr_surface", "surfaceshader")
    connect(open_pbr, base_color="base", base_metalness="metalness", geometry_normal="normal",
            specular_roughness="roughness", specular_weight="specular_weight")  # fmt: skip
    open_pbr.setInputValue("specular_ior", WHITE_IOR, "float")
    for suffix, shader in (
        ("", surface), ("_open_pbr", open_pbr), ("_standard_surface", standard)
    ):  # fmt: skip
        key = element + suffix
        node = document.addMaterialNode(key, shader)
        if displacement is not None:
            node.setConnectedNode("displacementshader", displacement)
    return document
