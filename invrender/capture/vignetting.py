"""What a lens loses towards the corners, by the table: a raw file may hold it, and no file says so.

The light on the table is known once the lights are, up to its albedo. Where its radiance falls off
from the photo's middle more than that light does, and nothing else is left to explain, the lens is
the cause (`invrender.rig.lens_gain`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from invrender.capture.robust import spread
from invrender.capture.settings import TABLE_METER, VIGNETTING
from invrender.capture.table import LitTable, distant_pairs
from invrender.files.images import Photo
from invrender.rig import Rig, lens_gain, squared_distance
from invrender.types import TINY


def find_vignetting(photo: Photo, rig: Rig, table: Callable[[], LitTable]) -> float:
    """The share of light that the photo's corners lack; 0 where the table does not show it.

    table: the photo's `lit_table` under the screen and the filled environment. Logarithms of the
    table's radiance some blocks apart are compared, as in `invrender.capture.clipped_lamps`, in
    brightness. The table is believed where that explains nearly all of its shading, and much more
    than without.
    """
    seen, at, use, lit, room = table()
    pairs = [pair for pair, _ in distant_pairs(use)]
    if not pairs:
        return 0.0
    albedo = (seen - np.log(np.maximum(lit + room, TINY))).mean(-1)
    aside = squared_distance(rig.project(at, photo.height, photo.width), photo.height, photo.width)

    def spreads(v: float) -> float:
        log = albedo + np.log(lens_gain(v, aside))
        return float(np.median([spread(log[i] - log[j]) for i, j in pairs]))

    tried = np.linspace(0, VIGNETTING.most, VIGNETTING.steps)
    left = [spreads(v) for v in tried]
    best = int(np.argmin(left))
    least = max(left[best], TABLE_METER.least_spread)
    told = least < VIGNETTING.plain and least < VIGNETTING.ratio * left[0]
    return float(tried[best]) if told else 0.0


def without_vignetting(photo: Photo, share: float) -> Photo:
    """The photo as brightened towards its corners, which lack a ``share`` of the light; what is
    saturated stays so."""
    if share == 0:
        return photo
    x, y = np.arange(photo.width) + 0.5, np.arange(photo.height) + 0.5
    pixels = np.stack(np.broadcast_arrays(x, y[:, None]), -1)
    aside = squared_distance(pixels, photo.height, photo.width)
    image = photo.image * lens_gain(share, aside)[..., None]
    return replace(photo, image=image.astype(np.float32))
