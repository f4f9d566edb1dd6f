"""Run by Blender: renders the plane that an exported script makes, under point lights, by Cycles.

Arguments: a JSON object with ``script``, ``out`` (.npy), ``principled`` (use a Principled BSDF of
the other textures instead), ``pixels``, ``camera`` (x and z), ``side`` and ``lights``; metres.
"""

import json
import math
import runpy
import sys

import bpy
import numpy as np

options = json.loads(sys.argv[-1])
bpy.ops.wm.read_factory_settings(use_empty=True)
made = runpy.run_path(options["script"])
material = bpy.data.materials[made["NAME"]]
tree = material.node_tree
if options["principled"]:
    nodes = {node.type: node for node in tree.nodes}
    shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
    for key, name, space in (
        ("BaseColor", "Base Color", made["COLOUR"]),
        ("Metallic", "Metallic", "Non-Color"),
        ("Specular", "Specular IOR Level", "Non-Color"),
        ("Roughness", "Roughness", "Non-Color"),
    ):
        tree.links.new(made["image"](tree, key, space), shader.inputs[name])
    tree.links.new(nodes["NORMAL_MAP"].outputs[0], shader.inputs["Normal"])
    tree.links.new(shader.outputs[0], nodes["OUTPUT_MATERIAL"].inputs["Surface"])
for node in tree.nodes:
    if node.type == "TEX_IMAGE":
        node.interpolation = "Closest"  # one texel a pixel

scene = bpy.context.scene
scene.render.engine = "CYCLES"
scene.cycles.samples = 16
scene.cycles.max_bounces = 0
scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
scene.cycles.pixel_filter_type = "BOX"
scene.cycles.filter_width = 0.01
scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = 0
scene.cycles.light_sampling_threshold = 0
n = options["pixels"]
scene.render.resolution_x = scene.render.resolution_y = n
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"
(x, height), side = options["camera"], options["side"]
lens = bpy.data.cameras.new("camera")
lens.lens, lens.shift_x, lens.clip_start = lens.sensor_width * height / side, -x / side, 1e-3
scene.camera = bpy.data.objects.new("camera", lens)
scene.camera.location = (x, 0, height)
scene.collection.objects.link(scene.camera)

images = []
for place in options["lights"]:
    lamp = bpy.data.lights.new("lamp", "POINT")
    lamp.shadow_soft_size = 0
    lamp.energy = 4 * math.pi * math.pi * height**2  # an intensity of pi·height²
    lamp = bpy.data.objects.new("lamp", lamp)
    lamp.location = place
    scene.collection.objects.link(lamp)
    scene.render.filepath = options["out"] + ".exr"
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    image.colorspace_settings.name = "Non-Color"
    pixels = np.empty(n * n * 4, np.float32)
    image.pixels.foreach_get(pixels)
    images.append(pixels.reshape(n, n, 4)[::-1, :, :3])
    bpy.data.images.remove(image)
    bpy.data.objects.remove(lamp)
np.save(options["out"], np.stack(images))
