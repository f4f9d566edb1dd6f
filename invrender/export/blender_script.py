"""A script that makes the material in Blender, run there: ``blender --python NAME.py``.

The placeholders in braces are filled in by `invrender.export.folders.write_blender`.
"""

SCRIPT = '''\
"""Makes the material {name!r} in Blender 4.3 or newer, and a plane of the sample's size with it.

Run it in Blender's Scripting workspace, or as: blender --python {name}.py

The shader is invrender's own reflectance: a Diffuse BSDF of the diffuse albedo plus a Metallic BSDF
whose reflectance rises from the specular albedo to 1 (F82 with a white edge), GGX without multiple
scattering. Blender's own default, Multiscatter GGX, would make rough metal much brighter.
"""

from pathlib import Path

import bpy

NAME = {name!r}
SUFFIX = {suffix!r}
SIDES = {sides!r}  # metres
COLOUR = {colour!r}  # space of the albedos' files
GREEN_UP = {green_up!r}  # of the normals: OpenGL's, which Blender expects, or DirectX's
HEIGHT = {height!r}  # metres of black and white in the displacement, or None

FOLDER = Path(__file__).resolve().parent


def image(tree, key, space):
    node = tree.nodes.new("ShaderNodeTexImage")
    file = FOLDER / f"{{NAME}}_{{key}}{{SUFFIX}}"
    node.image = bpy.data.images.load(str(file), check_existing=True)
    node.image.colorspace_settings.name = space
    return node.outputs["Color"]


def green_turned(tree, colour):
    split = tree.nodes.new("ShaderNodeSeparateColor")
    turn = tree.nodes.new("ShaderNodeMath")
    join = tree.nodes.new("ShaderNodeCombineColor")
    turn.operation = "SUBTRACT"
    turn.inputs[0].default_value = 1.0
    tree.links.new(colour, split.inputs[0])
    tree.links.new(split.outputs[1], turn.inputs[1])
    for index, value in enumerate((split.outputs[0], turn.outputs[0], split.outputs[2])):
        tree.links.new(value, join.inputs[index])
    return join.outputs[0]


def make_material():
    material = bpy.data.materials.new(NAME)
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    normal = image(tree, "Normal", "Non-Color")
    bend = tree.nodes.new("ShaderNodeNormalMap")
    tree.links.new(normal if GREEN_UP else green_turned(tree, normal), bend.inputs["Color"])
    diffuse = tree.nodes.new("ShaderNodeBsdfDiffuse")
    tree.links.new(image(tree, "kd", COLOUR), diffuse.inputs["Color"])
    specular = tree.nodes.new("ShaderNodeBsdfMetallic")
    specular.distribution = "GGX"
    specular.fresnel_type = "F82"
    specular.inputs["Edge Tint"].default_value = (1, 1, 1, 1)
    tree.links.new(image(tree, "ks", COLOUR), specular.inputs["Base Color"])
    tree.links.new(image(tree, "Roughness", "Non-Color"), specular.inputs["Roughness"])
    total = tree.nodes.new("ShaderNodeAddShader")
    for index, shader in enumerate((diffuse, specular)):
        tree.links.new(bend.outputs["Normal"], shader.inputs["Normal"])
        tree.links.new(shader.outputs[0], total.inputs[index])
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(total.outputs[0], output.inputs["Surface"])
    if HEIGHT is not None:
        black, white = HEIGHT
        lift = tree.nodes.new("ShaderNodeDisplacement")
        lift.inputs["Scale"].default_value = white - black
        lift.inputs["Midlevel"].default_value = -black / (white - black) if white > black else 0.0
        tree.links.new(image(tree, "Displacement", "Non-Color"), lift.inputs["Height"])
        tree.links.new(lift.outputs[0], output.inputs["Displacement"])
        # Of the mesh, where it is subdivided; as a bump it would count the normals twice.
        material.displacement_method = "DISPLACEMENT"
    return material


def make_plane(material):
    """A rectangle in the xy plane, the image's top at +y."""
    x, y = (side / 2 for side in SIDES)
    mesh = bpy.data.meshes.new(NAME)
    mesh.from_pydata([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], [], [(0, 1, 2, 3)])
    corners = mesh.uv_layers.new(name="UVMap").data
    for corner, uv in zip(corners, ((0, 0), (1, 0), (1, 1), (0, 1))):
        corner.uv = uv
    mesh.materials.append(material)
    plane = bpy.data.objects.new(NAME, mesh)
    bpy.context.scene.collection.objects.link(plane)
    return plane


make_plane(make_material())
'''
