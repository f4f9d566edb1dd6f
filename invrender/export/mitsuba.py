"""A Mitsuba 3 scene of standard plugins: the sample, the camera above it and the captured room.

The BSDF is the even blend of a Lambertian of 2·k_d and a GGX conductor of reflectance 2·k_s, which
sums to k_d/π + D·G·k_s/(4 (n·l)(n·v)): ours but for Schlick's rise of reflectance at grazing angles
and Mitsuba's separable G. The files therefore hold the doubled albedos, and α = ρ².
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from invrender.export.material import Material, normal_texture, normals_seen
from invrender.export.textures import Texture, write_textures
from invrender.maps import Maps
from invrender.rig import Rig
from invrender.sphere import mitsuba_rows

SCENE = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- mitsuba -m llvm_ad_rgb scene.xml -->
<scene version="3.0.0">
  <default name="spp" value="64"/>
  <default name="resolution" value="512"/>
  <integrator type="path"><integer name="max_depth" value="4"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="{fov:.6g}"/>
    <transform name="to_world">
      <lookat origin="0, 0, {distance:.9g}" target="0, 0, 0" up="0, 1, 0"/>
    </transform>
    <sampler type="multijitter"><integer name="sample_count" value="$spp"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="$resolution"/>
      <integer name="height" value="$resolution"/>
    </film>
  </sensor>
  <shape type="rectangle">
    <transform name="to_world"><scale x="{half_x:.9g}" y="{half_y:.9g}" z="1"/></transform>
    <bsdf type="normalmap">
      <boolean name="flip_invalid_normals" value="false"/>
      <boolean name="use_shadowing_function" value="false"/>
{normal}
      <bsdf type="blendbsdf">
        <float name="weight" value="0.5"/>
        <bsdf type="diffuse">
{diffuse}
        </bsdf>
        <bsdf type="roughconductor">
          <string name="material" value="none"/>
          <string name="distribution" value="ggx"/>
{alpha}
{specular}
        </bsdf>
      </bsdf>
    </bsdf>
  </shape>
{light}
</scene>
"""
# Mitsuba's rectangle has image row 0 at -y, hence to_uv.
TEXTURE = """\
{indent}<texture type="bitmap" name="{parameter}">
{indent}  <string name="filename" value="{file}"/>
{indent}  <boolean name="raw" value="true"/>
{indent}  <transform name="to_uv"><scale x="1" y="-1"/></transform>
{indent}</texture>"""
ROOM = """\
  <emitter type="envmap">
    <string name="filename" value="environment.exr"/>
    <transform name="to_world"><matrix value="0 0 -1 0  -1 0 0 0  0 1 0 0  0 0 0 1"/></transform>
  </emitter>"""
WHITE_SKY = """\
  <emitter type="constant"><rgb name="radiance" value="1"/></emitter>"""


def write_mitsuba(
    material: Material, folder: Path, format: str, convention: str
) -> dict[str, Maps]:
    """Write ``scene.xml``, its EXR textures and, where it is known, ``environment.exr``."""
    maps = material.maps
    textures = {
        "diffuse_x2": Texture(2 * maps.diffuse),
        "specular_x2": Texture(2 * maps.specular),
        "alpha": Texture(maps.roughness**2),
        "normal": normal_texture(maps.normal, convention),
    }
    if material.environment is not None:
        textures["environment"] = Texture(mitsuba_rows(material.environment))
    (folder / "scene.xml").write_text(_scene(material), encoding="utf-8")
    seen = write_textures(folder, textures, format)
    diffuse, specular = seen["diffuse_x2"] / 2, seen["specular_x2"] / 2
    normal = normals_seen(seen["normal"], convention)
    return {"scene": Maps(diffuse, specular, np.sqrt(seen["alpha"]), normal)}


def _scene(material: Material) -> str:
    def texture(indent: int, parameter: str, file: str) -> str:
        return TEXTURE.format(indent=" " * indent, parameter=parameter, file=f"{file}.exr")

    x, y = (s / 2 for s in material.sides)
    distance = Rig().screen_height / Rig().sample_size * material.width
    return SCENE.format(
        fov=2 * np.degrees(np.arctan(max(x, y) / distance)),
        distance=distance,
        half_x=x,
        half_y=y,
        normal=texture(6, "normalmap", "normal"),
        diffuse=texture(10, "reflectance", "diffuse_x2"),
        alpha=texture(10, "alpha", "alpha"),
        specular=texture(10, "specular_reflectance", "specular_x2"),
        light=WHITE_SKY if material.environment is None else ROOM,
    )
