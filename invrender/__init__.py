"""invrender: one photo under a tablet's light pattern in, relightable material maps out.

Conventions, used everywhere (see docs/conventions.md): right-handed metres, origin at the sample's
centre, z up, x towards the camera; images are linear RGB float32 with row 0 at +y and column 0 at
-x; roughness is perceptual (alpha = roughness²); normals are unit vectors in memory.
"""

from invrender.maps import Maps, map_errors
from invrender.rig import Rig
from invrender.types import InputError

__all__ = ["InputError", "Maps", "Rig", "map_errors"]
