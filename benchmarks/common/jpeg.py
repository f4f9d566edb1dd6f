"""Light as a JPEG file holds it."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from invrender.colour import linear_to_srgb


def jpeg(light: NDArray[np.floating[Any]], quality: int) -> bytes:
    """A file of linear values (H, W, 3), of which 1 and more is white."""
    data = (linear_to_srgb(light) * 255 + 0.5).astype(np.uint8)
    with io.BytesIO() as file:
        Image.fromarray(data).save(file, "JPEG", quality=quality)
        return file.getvalue()
