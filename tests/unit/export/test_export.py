"""Exports, read back by libraries that are not ours, and re-rendered."""

import io
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from invrender.cli import export as cli
from invrender.cli.main import main
from invrender.colour import srgb_to_linear
from invrender.data.materials import procedural_material, read_material
from invrender.export import TARGETS, export, export_maps, rerender_error
from invrender.export.metalrough import (
    MetalRough,
    maps_of,
    metal_rough,
    metallic,
    with_coloured_f0,
)
from invrender.export.textures import safe_name
from invrender.files.images import read_image
from invrender.files.maps import write_maps
from invrender.maps import Maps, map_errors
from invrender.types import InputError

SIZE = 64


@pytest.fixture(scope="module")
def maps():
    return procedural_material(3, SIZE, SIZE, kind="rusty_metal")


def decode(normal, sign=1):
    n = (normal * 2 - 1) * np.array([1, sign, 1], np.float32)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def png(path_or_bytes, colour=False):
    source = io.BytesIO(path_or_bytes) if isinstance(path_or_bytes, bytes) else path_or_bytes
    with Image.open(source) as image:
        data = np.asarray(image).astype(np.float32) / 255
    if not colour:
        return data
    return np.concatenate([srgb_to_linear(data[..., :3]), data[..., 3:]], -1)


def exr(path):
    with OpenEXR.File(str(path)) as file:
        return next(iter(file.channels().values())).pixels


def test_glb_holds_both_albedos(maps, tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    trimesh = pytest.importorskip("trimesh")
    out = tmp_path / "m.glb"
    done = export_maps(maps, out, "gltf", name="rust", width=0.1)
    file = pygltflib.GLTF2().load(str(out))
    blob, material = file.binary_blob(), file.materials[0]

    def image(index, colour=False):
        view = file.bufferViews[file.images[file.textures[index].source].bufferView]
        return png(blob[view.byteOffset : view.byteOffset + view.byteLength], colour)

    pbr = material.pbrMetallicRoughness
    extension = material.extensions["KHR_materials_specular"]
    base = image(pbr.baseColorTexture.index, True)
    orm = image(pbr.metallicRoughnessTexture.index)
    tint = image(extension["specularColorTexture"]["index"], True)
    f0 = np.minimum(0.04 * np.array(extension["specularColorFactor"], np.float32) * tint, 1)
    m = orm[..., 2:]
    normal = decode(image(material.normalTexture.index))
    back = Maps(base * (1 - m), f0 * (1 - m) + base * m, orm[..., 1], normal)
    errors = map_errors(back, maps)
    assert errors["specular"] < 2e-3 and errors["diffuse"] < 3e-3
    assert rerender_error(back, maps) < 0.01
    assert done.errors["KHR_materials_specular"]["rerender"] == pytest.approx(
        rerender_error(back, maps), abs=1e-4
    )
    assert done.errors["metal-rough only"]["specular"] > 2 * errors["specular"]
    mesh = next(iter(trimesh.load(str(out), force="scene").geometry.values()))
    assert np.allclose(mesh.extents, [0.1, 0.1, 0])
    assert np.allclose(mesh.face_normals, [0, 0, 1])


def test_materialx_is_valid_and_lossless(maps, tmp_path):
    mx = pytest.importorskip("MaterialX")
    done = export_maps(maps, tmp_path / "m", "materialx", name="rust", height=True)
    document = mx.createDocument()
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    mx.readFromXmlFile(document, str(tmp_path / "m" / "rust.mtlx"))
    document.setDataLibrary(library)
    assert document.validate()[0]
    names = {m.getName() for m in document.getMaterialNodes()}
    assert names == {"rust", "rust_open_pbr", "rust_standard_surface"}

    def image(key):
        node = document.getNodeGraph("NG_rust").getNode(f"image_{key}")
        return exr(tmp_path / "m" / node.getInputValue("file"))

    back = Maps(image("diffuse"), image("specular"), image("roughness"), decode(image("normal")))
    assert rerender_error(back, maps) < 1e-4
    # OpenPBR 1.1: F0 = specular_weight · ((ior - 1) / (ior + 1))² of the dielectric base.
    shader = document.getNode("rust_open_pbr_surface")
    assert shader.getCategory() == "open_pbr_surface"
    ior = shader.getInputValue("specular_ior")
    f0 = image("specular_weight") * ((ior - 1) / (ior + 1)) ** 2
    open_pbr = maps_of(MetalRough(image("base"), image("metalness"), f0), back.roughness,
                       back.normal)  # fmt: skip
    assert done.errors["rust_open_pbr"]["rerender"] == pytest.approx(
        rerender_error(open_pbr, maps), abs=1e-5
    )
    assert done.errors["rust_open_pbr"]["rerender"] < 0.01
    assert image("height").min() == 0 and image("height").max() == pytest.approx(1)
    assert done.height["white"] > 0 > done.height["black"]


@pytest.mark.parametrize(("convention", "sign"), [("opengl", 1), ("directx", -1)])
def test_unreal_packing(maps, tmp_path, convention, sign):
    done = export_maps(
        maps, tmp_path / "u", "unreal", name="rust", format="png8", normal_convention=convention
    )
    read = {k: png(tmp_path / "u" / f"T_rust_{k}.png", k == "BC") for k in ("BC", "ORM", "S", "N")}
    m, f0 = read["ORM"][..., 2:], 0.08 * read["S"][..., None]
    back = Maps(
        read["BC"] * (1 - m), f0 * (1 - m) + read["BC"] * m, read["ORM"][..., 1],
        decode(read["N"], sign),
    )  # fmt: skip
    error = rerender_error(back, maps)
    assert error < 0.01
    assert done.errors["default lit"]["rerender"] == pytest.approx(error, abs=1e-4)
    assert (read["ORM"][..., 0] == 1).all()


def test_unity_specular_workflow(maps, tmp_path):
    export_maps(maps, tmp_path / "u", "unity", name="rust", format="png8")
    packed = png(tmp_path / "u" / "rust_SpecularSmoothness.png", True)
    albedo = png(tmp_path / "u" / "rust_Albedo.png", True)
    specular = packed[..., :3]
    back = Maps(
        albedo * (1 - specular.max(-1, keepdims=True)), specular, 1 - packed[..., 3],
        decode(png(tmp_path / "u" / "rust_Normal.png")),
    )  # fmt: skip
    assert rerender_error(back, maps) < 0.01


def test_blender_names_and_16_bits(maps, tmp_path):
    export_maps(maps, tmp_path / "b", "blender", name="rust")
    names = {p.stem.split("_")[1] for p in (tmp_path / "b").glob("*.png")}
    assert names == {"BaseColor", "Metallic", "Specular", "Roughness", "Normal", "kd", "ks"}
    # 16 bits, as Pillow reads grey ones.
    with Image.open(tmp_path / "b" / "rust_Roughness.png") as image:
        rough = np.asarray(image).astype(np.float64) / 65535
    assert np.abs(rough - maps.roughness).max() < 1e-5
    normal = read_image(tmp_path / "b" / "rust_Normal.png", linear=True)
    assert np.abs(decode(normal) - maps.normal).max() < 1e-4


@pytest.mark.parametrize("target", ["blender", "unreal", "unity"])
def test_polished_metal_survives_by_default(tmp_path, target):
    """Sixteen bits: a normal's eighth bit moves a narrow highlight by more than its width."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    normal = np.dstack([0.05 * np.sin(9 * x + 3 * y), 0.05 * np.cos(7 * y), np.ones_like(x)])
    normal = (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)
    rgb = np.ones((SIZE, SIZE, 3), np.float32)
    polished = Maps(0 * rgb, 0.9 * rgb, np.full((SIZE, SIZE), 0.0612, np.float32), normal)
    default, *_ = export_maps(polished, tmp_path / "a", target).errors.values()
    bytes_only, *_ = export_maps(polished, tmp_path / "b", target, format="png8").errors.values()
    assert default["rerender"] < 0.002 < 0.03 < bytes_only["rerender"]


def test_width_is_the_reports(maps, tmp_path):
    write_maps(tmp_path, maps)
    report = {"capture": "x", "sample_size": 0.25}
    (tmp_path / "report.json").write_text(json.dumps(report))
    assert export(tmp_path, tmp_path / "m.glb", "gltf").width == 0.25


def test_mitsuba_scene_renders_alike(maps, tmp_path):
    from invrender.render.path_traced import mi, path_traced
    from invrender.render.point_lights import grid_lights, relight
    from invrender.rig import Rig

    rig = Rig()
    export_maps(maps, tmp_path / "m", "mitsuba", width=rig.sample_size)
    path = tmp_path / "m" / "scene.xml"
    mi.load_file(str(path))  # as it is
    tree = ET.parse(path)
    root = tree.getroot()
    root.remove(root.find("emitter"))
    light = grid_lights(rig)[:1]
    x, y, z = light[0]
    power = np.pi * rig.screen_height**2
    root.append(ET.fromstring(
        f'<emitter type="point"><point name="position" x="{x}" y="{y}" z="{z}"/>'
        f'<rgb name="intensity" value="{power}"/></emitter>'
    ))  # fmt: skip
    tree.write(path)
    image = path_traced(mi.load_file(str(path)), rig, SIZE, SIZE, 1)
    expected = relight(maps, rig, light)[0]
    # Mitsuba interpolates between pixels' centres, where these rays meet the sample; its separable
    # shadowing and the missing Schlick term are the rest.
    assert np.sqrt(np.mean((image - expected) ** 2)) < 0.01 * expected.mean()


def test_tileable_height_is_periodic(maps, tmp_path):
    done = export_maps(
        maps, tmp_path / "b", "blender", name="x", tileable=True, height=True, format="exr"
    )
    height = exr(tmp_path / "b" / "x_Displacement.exr")
    inner = np.abs(np.diff(height, axis=0)).mean()
    assert np.abs(height[0] - height[-1]).mean() < 2 * inner
    assert done.seams["after"] < 0.7 * done.seams["before"]


def test_metal_rough_inverts_metal_rough():
    rng = np.random.default_rng(1)
    base = rng.uniform(0, 1, (16, 16, 3)).astype(np.float32)
    m = rng.uniform(0, 1, (16, 16, 1)).astype(np.float32)
    normal = np.broadcast_to(np.float32([0, 0, 1]), base.shape)
    maps = Maps(base * (1 - m), 0.04 * (1 - m) + base * m, m[..., 0], normal)
    back = maps_of(metal_rough(maps), maps.roughness, maps.normal)
    assert np.abs(back.diffuse - maps.diffuse).max() < 1e-3
    assert np.abs(back.specular - maps.specular).max() < 1e-3


def test_any_specular_survives_in_gltf():
    rng = np.random.default_rng(2)
    r = lambda *s: rng.uniform(0, 1, s).astype(np.float32)  # noqa: E731
    normal = np.broadcast_to(np.float32([0, 0, 1]), (16, 16, 3))
    maps = Maps(r(16, 16, 3), r(16, 16, 3), r(16, 16), normal)
    exact = maps_of(with_coloured_f0(maps, metallic(maps)), maps.roughness, normal)
    assert np.abs(exact.specular - maps.specular).max() < 1e-5
    both = maps_of(with_coloured_f0(maps, np.zeros((16, 16))), maps.roughness, normal)
    assert np.abs(both.diffuse - maps.diffuse).max() < 1e-6


@pytest.mark.parametrize("target", ["gltf", "unity", "mitsuba"])
def test_what_a_target_cannot_hold(maps, tmp_path, target):
    out = tmp_path / ("x.glb" if target == "gltf" else "x")
    with pytest.raises(InputError):
        export_maps(maps, out, target, format="jpeg" if target == "unity" else "png16")
    if not TARGETS[target].height:
        with pytest.raises(InputError, match="height"):
            export_maps(maps, out, target, height=True)
    assert not list(tmp_path.iterdir())


def test_names_from_files_stay_in_the_folder(maps, tmp_path):
    assert re.fullmatch(r"x-[0-9a-f]{8}", safe_name("../../x"))
    assert re.fullmatch(r"material-[0-9a-f]{8}", safe_name(".."))
    assert [safe_name(n) for n in ("Ähre", "Öhre", "木", "A\u0308hre")] == [
        "Ähre",
        "Öhre",
        "木",
        "Ähre",
    ]
    like = ["a/b", "a b", "a_b", "a:b", "_a_b", "a_b_", "a__b", "..", "", "con", "CON", "con_"]
    like += [first + "y" * 80 for first in ("x", "yx")] + ["y" * 64, "y" * 65, "\udce4", "\udce5"]
    assert len({safe_name(n) for n in like}) == len(like)  # two names never become one
    source = tmp_path / "source"
    source.mkdir()
    write_maps(source, maps)
    evil = {"capture": '../../evil"><script>', "sample_size": float("nan")}
    (source / "report.json").write_text(json.dumps(evil))
    done = export(source, tmp_path / "out", "mitsuba")
    assert done.width > 0
    export(source, tmp_path / "blender", "blender")
    assert {p.name for p in tmp_path.iterdir()} == {"source", "out", "blender"}
    assert all("evil_script" in p.name for p in (tmp_path / "blender").glob("rust*"))
    assert "script" not in (tmp_path / "out" / "scene.xml").read_text()


def test_command(maps, tmp_path, capsys):
    assert tuple(TARGETS) == cli.EXPORT_TARGETS
    source = tmp_path / "source"
    source.mkdir()
    write_maps(source, maps)
    out = tmp_path / "m.glb"
    assert main(["export", str(source), "--to", "gltf", "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["errors"]["KHR_materials_specular"]["rerender"] < 0.01
    assert main(["export", str(source), "--to", "gltf", "-o", str(tmp_path / "m.txt")]) == 2
    assert main(["export", str(tmp_path / "none"), "--to", "unity", "-o", str(tmp_path / "u")]) == 2
    assert {p.name for p in tmp_path.iterdir()} == {"source", "m.glb"}


def test_glb_passes_khronos_validator(maps, tmp_path):
    node = shutil.which("node")
    root = Path(__file__).parents[3]
    if node is None or not (root / "node_modules/gltf-validator").is_dir():
        pytest.skip("no Khronos validator (node; npm install gltf-validator@2.0.0-dev.3.10)")
    script = (
        "require('gltf-validator').validateBytes(require('fs').readFileSync(process.argv[1]))"
        ".then(report => console.log(JSON.stringify(report.issues)))"
    )
    for format in TARGETS["gltf"].formats:
        export_maps(maps, tmp_path / "m.glb", "gltf", format=format)
        done = subprocess.run(
            [node, "-e", script, tmp_path / "m.glb"], cwd=root, capture_output=True, text=True
        )
        assert json.loads(done.stdout)["messages"] == []


@pytest.mark.parametrize("name", ["m.usdz", "m"])
def test_usd_is_valid(maps, tmp_path, name):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    done = export_maps(maps, tmp_path / name, "usd", name="3rust", width=0.1, height=True)
    stage = Usd.Stage.Open(str(tmp_path / name / "3rust.usda" if name == "m" else tmp_path / name))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    box = UsdGeom.Imageable(stage.GetDefaultPrim()).ComputeWorldBound(0, "default").GetRange()
    assert np.allclose(box.GetSize(), [0.1, 0.1, 0])
    everything = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(everything).Validate(stage)
    # The wheel of USD comes without MaterialX's nodes; the next lines look for these themselves.
    unknown = [e for e in errors if e.GetName() == "MissingShaderIdInRegistry"]
    assert [e.GetMessage() for e in errors if e not in unknown] == []
    mx = pytest.importorskip("MaterialX")
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    shaders = {
        p.GetName(): UsdShade.Shader(p) for p in stage.Traverse() if p.GetTypeName() == "Shader"
    }
    nodes = {n: s for n, s in shaders.items() if s.GetIdAttr().Get().startswith("ND_")}
    assert len(nodes) == len(unknown) == 8
    kinds = {"color3f": "color3", "float3": "vector3", "float2": "vector2", "asset": "filename"}
    for shader in nodes.values():
        definition = library.getNodeDef(shader.GetIdAttr().Get())
        for entry in shader.GetInputs():
            kind = str(entry.GetTypeName())
            known = definition.getActiveInput(entry.GetBaseName())
            assert known.getType() == kinds.get(kind, kind), entry.GetBaseName()
    look = UsdShade.Material(stage.GetDefaultPrim().GetChild("Material"))
    assert look.ComputeSurfaceSource("mtlx")[0].GetPath().name == "OpenPBR"
    assert look.ComputeSurfaceSource()[0].GetIdAttr().Get() == "UsdPreviewSurface"
    lift = shaders["height"]
    black, white = done.height["black"], done.height["white"]
    assert lift.GetInput("bias").Get()[0] == pytest.approx(black)
    assert lift.GetInput("scale").Get()[0] == pytest.approx(white - black)
    assert done.errors["OpenPBR"]["rerender"] < 0.01


NAMES = {
    "godot": {"rust_albedo.png", "rust_orm.png", "rust_normal.png", "rust_height.png"},
    "ambientcg": {
        f"rust_64x64-PNG_{k}.png"
        for k in ("Color", "Metalness", "Roughness", "NormalGL", "Displacement", "AmbientOcclusion")
    },
    "polyhaven": {
        f"rust_{k}_64x64.png" for k in ("diff", "metal", "rough", "nor_gl", "disp", "ao")
    },
}


@pytest.mark.parametrize("target", NAMES)
def test_names_of_other_libraries(maps, tmp_path, target):
    """Their files are read back by the program itself, as downloads of theirs are."""
    export_maps(maps, tmp_path / "m", target, name="rust", height=True)
    assert {p.name for p in (tmp_path / "m").glob("*.png")} == NAMES[target]
    assert map_errors(read_material(tmp_path / "m"), maps)["average"] < 0.01


def test_zip_holds_everything(maps, tmp_path):
    out = tmp_path / "rust.zip"
    done = export_maps(
        maps, out, "unreal", name="rust", width=0.1, height=True, licence="CC0-1.0"
    )  # fmt: skip
    with zipfile.ZipFile(out) as archive:
        assert archive.testzip() is None
        facts = json.loads(archive.read("material.json"))
        names = set(archive.namelist())
        orm = archive.read("T_rust_ORM.png")
    assert names == {"material.json"} | {f"T_rust_{k}.png" for k in ("BC", "ORM", "S", "N", "H")}
    assert facts["licence"] == "CC0-1.0" and facts["sides"] == [0.1, 0.1]
    assert facts["height"] == {k: done.height[k] for k in ("black", "white")}
    assert png(orm[:])[..., 0].min() < 1
    assert [p.name for p in tmp_path.iterdir()] == ["rust.zip"]


@pytest.mark.parametrize(
    ("format", "name"), [("png8", "BC.png"), ("png16", "BC.png"), ("jpeg", "BC.jpg")]
)
def test_textures_tell_colour_space_and_size(maps, tmp_path, format, name):
    """Of 64 pixels on 0.1 m, 640 pixels a metre or 16.256 an inch; JPEG rounds these."""
    export_maps(maps, tmp_path / "u", "unreal", name="rust", width=0.1, format=format)
    with Image.open(tmp_path / "u" / f"T_rust_{name}") as colour:
        assert colour.info["dpi"] == pytest.approx((16.256, 16.256), rel=0.02)
        srgb = colour.info.get("srgb") if format != "jpeg" else colour.info.get("icc_profile")
        assert srgb is not None
    with Image.open(tmp_path / "u" / f"T_rust_{name.replace('BC', 'ORM')}") as data:
        assert "srgb" not in data.info and "icc_profile" not in data.info
        assert format == "jpeg" or data.info["gamma"] == 1


def test_exr_textures_tell_colour_space_and_size(maps, tmp_path):
    export_maps(maps, tmp_path / "u", "unreal", name="rust", width=0.1, format="exr")
    headers = {}
    for key in ("BC", "N"):
        with OpenEXR.File(str(tmp_path / "u" / f"T_rust_{key}.exr")) as file:
            headers[key] = dict(file.header())
    assert headers["BC"]["colorInteropID"] == "lin_rec709_scene"
    assert headers["N"]["colorInteropID"] == "data"
    assert headers["N"]["xDensity"] == pytest.approx(16.256, rel=1e-4)
