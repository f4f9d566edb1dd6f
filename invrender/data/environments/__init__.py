"""Environment light: from files, and procedural rooms, skies, studios and nights.

An environment is an equirectangular image (H, W, 3) of linear radiance, usually W = 2H: row 0 at
the zenith (+z), column u at φ = 2π·u/W, φ = atan2(y, x). Its unit is arbitrary until
`scale_environment` says what it gives on the table.
"""

from invrender.data.environments.files import find_environments, read_environment
from invrender.data.environments.lamps import add_light
from invrender.data.environments.procedural import KINDS, procedural_environment
from invrender.sphere import (
    directions,
    irradiance,
    mitsuba_rows,
    resample_environment,
    rotate_environment,
    scale_environment,
    solid_angles,
)

__all__ = [
    "KINDS",
    "add_light",
    "directions",
    "find_environments",
    "irradiance",
    "mitsuba_rows",
    "procedural_environment",
    "read_environment",
    "resample_environment",
    "rotate_environment",
    "scale_environment",
    "solid_angles",
]
