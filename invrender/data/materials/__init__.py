"""Materials to train and test on: made up, read from files, and varied."""

from invrender.data.materials.augment import augment, check_maps, jitter_maps, mix
from invrender.data.materials.files import (
    find_materials,
    handedness,
    is_directx,
    load_materials,
    read_material,
)
from invrender.data.materials.patterns import normals_from_height
from invrender.data.materials.procedural import PRESETS, RARE, procedural_material
from invrender.maps import crop_maps, resize_maps, rotate_maps, turn_maps, unit_normals
from invrender.sampling import resize

__all__ = [
    "PRESETS",
    "RARE",
    "augment",
    "check_maps",
    "crop_maps",
    "find_materials",
    "handedness",
    "is_directx",
    "jitter_maps",
    "load_materials",
    "mix",
    "normals_from_height",
    "procedural_material",
    "read_material",
    "resize",
    "resize_maps",
    "rotate_maps",
    "turn_maps",
    "unit_normals",
]
