"""invrender: one photo under a tablet's light pattern in, relightable material maps out.

    capture = invrender.load_capture("my-capture")
    result = invrender.reconstruct(invrender.find_lights(capture))
    result.save("out")

Conventions, used everywhere (see docs/conventions.md): right-handed metres, origin at the sample's
centre, z up, x towards the camera; images are linear RGB float32 with row 0 at +y and column 0 at
-x; roughness is perceptual (alpha = roughness²); normals are unit vectors in memory.

Importing this loads nothing else: each name brings what it needs when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lazy_loader import attach

if TYPE_CHECKING:
    from invrender.capture.lights import find_lights
    from invrender.data.simulate import simulate
    from invrender.files.capture import Capture, load_capture
    from invrender.lights import Device, Lights
    from invrender.maps import Estimate, Maps
    from invrender.pipeline import reconstruct
    from invrender.render.image import render
    from invrender.report.metrics import evaluate
    from invrender.report.result import Result
    from invrender.rig import Rig
    from invrender.types import InputError

__all__ = [
    "Capture",
    "Device",
    "Estimate",
    "InputError",
    "Lights",
    "Maps",
    "Result",
    "Rig",
    "evaluate",
    "find_lights",
    "load_capture",
    "reconstruct",
    "render",
    "simulate",
]

__getattr__, __dir__, _ = attach(
    __name__,
    ["render"],  # the package, which can be called
    {
        "capture.lights": ["find_lights"],
        "data.simulate": ["simulate"],
        "files.capture": ["Capture", "load_capture"],
        "lights": ["Device", "Lights"],
        "maps": ["Estimate", "Maps"],
        "pipeline": ["reconstruct"],
        "report.metrics": ["evaluate"],
        "report.result": ["Result"],
        "rig": ["Rig"],
        "types": ["InputError"],
    },
)
