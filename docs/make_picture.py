"""Write the README's picture, from the bundled capture: ``python docs/make_picture.py [-o FILE]``.

From left to right: the photo; diffuse albedo and roughness above normal and specular albedo; the
sample under two lamps that the photo never had; a ball of the exported material in another room,
path-traced by Mitsuba. Some minutes on two cores.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import invrender
from invrender.colour import linear_to_srgb
from invrender.data import EXAMPLE
from invrender.data.environments import procedural_environment, scale_environment
from invrender.export import export_maps
from invrender.render.point_lights import relight
from invrender.sphere import mitsuba_rows
from invrender.types import Array

SIDE, GAP = 512, 12  # pixels
LAMPS = ((-0.8, 0.1, 0.5), (0.5, 0.8, 0.4))  # in sizes of the sample, from its centre
COLOURS = ((1.0, 0.85, 0.65), (0.75, 0.85, 1.0))
ROOM, SPP = 12, 256  # seed of the room around the ball, samples a pixel


def main(argv: list[str] | None = None) -> None:
    """Refine the capture, relight and export the maps, and write the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=Path(__file__).with_name("example.jpg"))
    args = parser.parse_args(argv)
    capture = invrender.load_capture(EXAMPLE)
    result = invrender.reconstruct(invrender.find_lights(capture), size=SIDE // 2)
    with tempfile.TemporaryDirectory() as name:
        export_maps(result.maps, Path(name) / "scene", "mitsuba", tileable=True)
        ball = render_ball(Path(name) / "scene")
    lamps = capture.rig.sample_size * np.array(LAMPS)
    lit = relight(result.maps, capture.rig, lamps) * np.array(COLOURS)[:, None, None]
    encoded = result.maps.encoded()
    names = ("diffuse", "roughness"), ("normal", "specular")
    linear = ("normal", "roughness")
    shown = {n: image if n in linear else linear_to_srgb(image) for n, image in encoded.items()}
    half = (SIDE - GAP) // 2
    rows = [stack([tile(shown[n], half) for n in row], axis=1) for row in names]
    columns = [
        tile(linear_to_srgb(exposed(photo_part(capture.photo.image), 98)), SIDE),
        stack(rows),
        stack([tile(linear_to_srgb(exposed(x, 97)), half) for x in lit]),
        tile(linear_to_srgb(exposed(ball, 99)), SIDE),
    ]
    picture = (255 * stack(columns, axis=1) + 0.5).astype(np.uint8)
    Image.fromarray(picture).save(args.out, quality=90)


def photo_part(image: Array) -> Array:
    """The square of the photo that holds the sample and the ball beside it."""
    height, width = image.shape[:2]
    side, left = 3 * height // 4, width // 100
    top = (height - side) // 2
    return image[top : top + side, left : left + side]


def exposed(image: Array, percentile: float) -> Array:
    """Linear radiance, divided by a percentile and clipped to [0, 1]."""
    return np.clip(image / np.percentile(image, percentile), 0, 1)


def tile(image: Array, side: int) -> Array:
    """An image in [0, 1], grey or RGB, as (side, side, 3)."""
    rgb = np.broadcast_to(image.reshape(*image.shape[:2], -1), (*image.shape[:2], 3))
    pixels = Image.fromarray((255 * rgb + 0.5).astype(np.uint8))
    return np.asarray(pixels.resize((side, side), Image.Resampling.LANCZOS)) / np.float32(255)


def stack(images: list[Array], axis: int = 0) -> Array:
    """Images below each other (axis 0) or side by side (1), with white between them."""
    shape = list(images[0].shape)
    shape[axis] = GAP
    parts = [part for image in images for part in (np.ones(shape, np.float32), image)]
    return np.concatenate(parts[1:], axis)


def render_ball(folder: Path) -> Array:
    """Radiance (SIDE, SIDE, 3) of a ball of the exported material on a grey floor, in a room."""
    from invrender.render.path_traced import mi

    transform = mi.ScalarTransform4f()

    def texture(name: str) -> dict[str, Any]:
        to_uv = transform.scale([4, -2, 1])
        file = str(folder / f"{name}.exr")
        return {"type": "bitmap", "filename": file, "raw": True, "to_uv": to_uv}

    material = {
        "type": "normalmap",
        "normalmap": texture("normal"),
        "flip_invalid_normals": False,
        "use_shadowing_function": False,
        "bsdf": {
            "type": "blendbsdf",
            "weight": 0.5,
            "diffuse": {"type": "diffuse", "reflectance": texture("diffuse_x2")},
            "specular": {
                "type": "roughconductor",
                "material": "none",
                "distribution": "ggx",
                "alpha": texture("alpha"),
                "specular_reflectance": texture("specular_x2"),
            },
        },
    }
    floor = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.15}}
    room = mitsuba_rows(scale_environment(procedural_environment(ROOM, 512), 1.0))
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 5},
            "sensor": {
                "type": "perspective",
                "fov": 26,
                "to_world": transform.look_at([0, -5, 1.6], [0, 0, -0.02], [0, 0, 1]),
                "film": {
                    "type": "hdrfilm", "width": SIDE, "height": SIDE, "pixel_format": "rgb",
                },
                "sampler": {"type": "multijitter", "sample_count": SPP},
            },
            "ball": {
                "type": "sphere",
                "bsdf": material,
                "to_world": transform.rotate([1, 0, 0], -30),  # its pole away from the camera
            },
            "floor": {
                "type": "rectangle",
                "to_world": transform.translate([0, 0, -1]).scale([50, 50, 1]),
                "bsdf": floor,
            },
            "room": {
                "type": "envmap",
                "bitmap": mi.Bitmap(np.ascontiguousarray(room, np.float32)),
                "to_world": transform.rotate([1, 0, 0], 90),
            },
        }
    )  # fmt: skip
    return np.array(mi.render(scene, spp=SPP))


if __name__ == "__main__":
    main()
