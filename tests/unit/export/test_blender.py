"""The material in a real Blender, rendered by Cycles, against our own rendering."""

import json
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from invrender.data.materials import procedural_material
from invrender.export import cycles, export_maps
from invrender.export.metalrough import WHITE_F0, with_grey_f0
from invrender.maps import constant_maps
from invrender.render.point_lights import grid_lights, relight
from invrender.rig import Rig

SIZE = 48
RIG = Rig()
LIGHTS = grid_lights(RIG)[[0, 4, 7]]
MATERIALS = {
    "rust": procedural_material(3, SIZE, SIZE, kind="rusty_metal"),
    "bricks": procedural_material(3, SIZE, SIZE, kind="bricks"),
    "rough metal": constant_maps(SIZE, SIZE, (0.0, 0.0, 0.0), 0.9, 0.8),
    "plastic": constant_maps(SIZE, SIZE, (0.5, 0.3, 0.2), 0.04, 0.4),
}


def in_blender(script, out, **options):
    """The images that Cycles makes of a script's plane, (lights, SIZE, SIZE, 3)."""
    if find_spec("bpy"):
        start = [sys.executable]
    elif blender := shutil.which("blender"):
        start = [blender, "-b", "--factory-startup", "--python"]
    else:
        pytest.skip("no Blender: neither the package bpy nor a program of that name")
    scene = Path(__file__).with_name("cycles_scene.py")
    options |= {
        "script": str(script), "out": str(out), "pixels": SIZE, "side": RIG.sample_size,
        "camera": [float(RIG.camera[0]), RIG.screen_height], "lights": LIGHTS.tolist(),
    }  # fmt: skip
    done = subprocess.run(
        [*start, str(scene), "--", json.dumps(options)], capture_output=True, text=True
    )
    assert out.is_file(), done.stdout + done.stderr
    return np.load(out)


def relative(a, b, truth):
    return float(np.sqrt(np.mean((a - b) ** 2, dtype=np.float64)) / truth.mean())


@pytest.mark.parametrize(
    ("name", "convention"), [*((name, "opengl") for name in MATERIALS), ("rust", "directx")]
)
def test_the_script_makes_our_own_reflectance(tmp_path, name, convention):
    maps = MATERIALS[name]
    export_maps(maps, tmp_path / "b", "blender", name="m", width=RIG.sample_size,
                normal_convention=convention)  # fmt: skip
    seen = in_blender(tmp_path / "b" / "m.py", tmp_path / "seen.npy", principled=False)
    ours = relight(maps, RIG, LIGHTS)
    assert relative(seen, ours, ours) < 0.002


@pytest.mark.parametrize("name", MATERIALS)
def test_the_cost_of_a_principled_bsdf_is_what_cycles_renders(tmp_path, name):
    maps = MATERIALS[name]
    export_maps(maps, tmp_path / "b", "blender", name="m", width=RIG.sample_size)
    seen = in_blender(tmp_path / "b" / "m.py", tmp_path / "seen.npy", principled=True)
    ours = relight(maps, RIG, LIGHTS)
    stated = cycles.principled(with_grey_f0(maps, WHITE_F0), maps.roughness, maps.normal)
    assert relative(relight(stated, RIG, LIGHTS), seen, ours) < 0.01
    assert relative(seen, ours, ours) > 0.02


def test_a_lobe_loses_what_its_quadrature_says():
    """Of α = 1 and v = n: D = 1/π, G2 = 1/(1 + Λ(l)), so f·cos = 1/(4π·(1 + Λ))."""
    theta = (np.arange(2000) + 0.5) / 2000 * np.pi / 2
    smith = (np.sqrt(1 + np.tan(theta) ** 2) - 1) / 2
    expected = (np.sin(theta) / (2 * (1 + smith))).mean() * np.pi / 2
    flat, grazing = cycles._albedo()
    assert (flat + grazing)[-1, -1] == pytest.approx(expected, rel=0.01)


def test_white_metal_gives_all_light_back():
    """The white furnace: what a lobe of mirrors keeps, times its gain, is 1."""
    albedo = np.linspace(0.2, 1, 9)
    assert np.allclose(cycles._gain(np.ones(9), albedo) * albedo, 1)
