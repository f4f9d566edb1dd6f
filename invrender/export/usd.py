"""OpenUSD: a rectangle of the sample's size with one material for two kinds of renderers.

``outputs:mtlx:surface`` is MaterialX's OpenPBR, whose specular weight holds the dielectric part's
f0 per pixel; ``outputs:surface`` is UsdPreviewSurface, metal-rough with f0 = 0.04 [Pixar,
"UsdPreviewSurface specification"]. Metres, y up; the rectangle stands in the xy plane and faces
+z, as in glTF.
"""

from __future__ import annotations

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


def write_usd(material: Material, folder: Path, format: str, convention: str) -> dict[str, Maps]:
    """Write ``NAME.usda`` and its textures; raises `InputError` without the usd-core package."""
    try:
        import pxr  # noqa: F401
    except ImportError:
        raise InputError(
            "USD files need the usd-core package: pip install 'invrender[export]'"
        ) from None
    maps, name = material.maps, material.name
    mr = with_grey_f0(maps, WHITE_F0)
    textures = {
        f"{name}_base": Texture(mr.base, colour=True),
        f"{name}_metalness": Texture(mr.metallic),
        f"{name}_roughness": Texture(maps.roughness),
        f"{name}_specular_weight": Texture(mr.f0 / WHITE_F0),
        f"{name}_normal": normal_texture(maps.normal, convention),
    }
    if material.height is not None:
        textures[f"{name}_occlusion"] = Texture(material.occlusion)
        textures[f"{name}_height"] = height_texture(material.height)
    seen = write_textures(folder, textures, format, material.width)
    _write_stage(material, folder / f"{name}.usda", format)
    base, metal, rough, weight, normal = (seen[k] for k in list(textures)[:5])
    n = normals_seen(normal, convention)
    return {
        "OpenPBR": maps_of(MetalRough(base, metal, weight * WHITE_F0), rough, n),
        "UsdPreviewSurface": maps_of(MetalRough(base, metal, np.full_like(metal, F0)), rough, n),
    }


def write_usdz(folder: Path, out: Path) -> None:
    """Pack the one ``.usda`` of a folder and its textures into a ``.usdz`` file."""
    from pxr import UsdUtils

    (stage,) = folder.glob("*.usda")
    if not UsdUtils.CreateNewUsdzPackage(str(stage), str(out)):
        raise InputError(f"{out} cannot be written: the USD library refuses it")


def _write_stage(material: Material, path: Path, format: str) -> None:
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    root = UsdGeom.Xform.Define(stage, f"/{_identifier(material.name)}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)

    mesh = UsdGeom.Mesh.Define(stage, root.GetPath().AppendChild("Sample"))
    w, h = (s / 2 for s in material.sides)
    corners = np.array([[-w, -h, 0], [w, -h, 0], [w, h, 0], [-w, h, 0]], np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners[[0, 2]]))
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 1)] * 4)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    coordinates.Set([Gf.Vec2f(0, 0), Gf.Vec2f(1, 0), Gf.Vec2f(1, 1), Gf.Vec2f(0, 1)])

    look = UsdShade.Material.Define(stage, root.GetPath().AppendChild("Material"))
    shader = _Shaders(look, material, format)
    look.CreateSurfaceOutput().ConnectToSource(shader.preview())
    look.CreateSurfaceOutput("mtlx").ConnectToSource(shader.open_pbr())
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(look)
    stage.GetRootLayer().Save()


class _Shaders:
    """The shader networks of a material; each method returns the output of a surface."""

    def __init__(self, look: Any, material: Material, format: str) -> None:
        from pxr import Sdf, UsdShade

        self.look, self.material, self.format = look, material, format
        self.types, self.shade = Sdf.ValueTypeNames, UsdShade

    def _add(self, name: str, identifier: str, **inputs: Any) -> Any:
        """A shader; an input is (type, value), the value being another shader's output or plain."""
        path = self.look.GetPath().AppendChild(name)
        shader = self.shade.Shader.Define(self.look.GetPrim().GetStage(), path)
        shader.CreateIdAttr(identifier)
        for key, (kind, value) in inputs.items():
            entry = shader.CreateInput(key, kind)
            if isinstance(value, self.shade.Output):
                entry.ConnectToSource(value)
            else:
                entry.Set(value)
        return shader

    def _file(self, key: str) -> str:
        return f"./{self.material.name}_{key}{FORMAT_SUFFIXES[self.format]}"

    def preview(self) -> Any:
        """UsdPreviewSurface."""
        t = self.types
        st = self._add("st", "UsdPrimvarReader_float2", varname=(t.String, "st"))
        where = st.CreateOutput("result", t.Float2)

        def texture(key: str, output: str, kind: Any, space: str, **more: Any) -> Any:
            shader = self._add(
                key, "UsdUVTexture", file=(t.Asset, self._file(key)), st=(t.Float2, where),
                sourceColorSpace=(t.Token, space), wrapS=(t.Token, "repeat"),
                wrapT=(t.Token, "repeat"), **more,
            )  # fmt: skip
            return kind, shader.CreateOutput(output, kind)

        colour = "raw" if self.format == "exr" else "sRGB"
        inputs = {
            "diffuseColor": texture("base", "rgb", t.Color3f, colour),
            "metallic": texture("metalness", "r", t.Float, "raw"),
            "roughness": texture("roughness", "r", t.Float, "raw"),
            "normal": texture(
                "normal", "rgb", t.Normal3f, "raw",
                scale=(t.Float4, (2, 2, 2, 1)), bias=(t.Float4, (-1, -1, -1, 0)),
            ),
        }  # fmt: skip
        if self.material.height is not None:
            inputs["occlusion"] = texture("occlusion", "r", t.Float, "raw")
            low, high = height_range(self.material.height)
            inputs["displacement"] = texture(
                "height", "r", t.Float, "raw",
                scale=(t.Float4, (high - low,) * 3 + (1,)), bias=(t.Float4, (low,) * 3 + (0,)),
            )  # fmt: skip
        surface = self._add("PreviewSurface", "UsdPreviewSurface", **inputs)
        return surface.CreateOutput("surface", t.Token)

    def open_pbr(self) -> Any:
        """MaterialX's OpenPBR."""
        t = self.types
        st = self._add("mtlx_st", "ND_geompropvalue_vector2", geomprop=(t.String, "st"))
        where = st.CreateOutput("out", t.Float2)

        def image(key: str, node: str, kind: Any) -> Any:
            shader = self._add(
                f"mtlx_{key}", node, file=(t.Asset, self._file(key)), texcoord=(t.Float2, where)
            )
            if key == "base":
                space = "lin_rec709" if self.format == "exr" else "srgb_texture"
                shader.GetInput("file").GetAttr().SetColorSpace(space)
            return kind, shader.CreateOutput("out", kind)

        bent = self._add(
            "mtlx_normalmap", "ND_normalmap_float",
            **{"in": image("normal", "ND_image_vector3", t.Float3)},
        )  # fmt: skip
        surface = self._add(
            "OpenPBR",
            "ND_open_pbr_surface_surfaceshader",
            base_color=image("base", "ND_image_color3", t.Color3f),
            base_metalness=image("metalness", "ND_image_float", t.Float),
            specular_roughness=image("roughness", "ND_image_float", t.Float),
            specular_weight=image("specular_weight", "ND_image_float", t.Float),
            specular_ior=(t.Float, WHITE_IOR),
            geometry_normal=(t.Float3, bent.CreateOutput("out", t.Float3)),
        )
        return surface.CreateOutput("out", t.Token)


def _identifier(name: str) -> str:
    """A prim's name: letters, digits and _, not beginning with a digit."""
    from pxr import Tf

    return str(Tf.MakeValidIdentifier(name))
