"""What every exporter is given, and normals as files hold them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from invrender.export.occlusion import ambient_occlusion
from invrender.export.textures import Texture
from invrender.maps import Maps
from invrender.types import Array


@dataclass(frozen=True)
class Material:
    """A named sample: its maps, its width in metres and, where known or wanted, its height (H, W)
    in metres and the environment it was captured in."""

    name: str
    maps: Maps
    width: float
    height: Array | None = None
    environment: Array | None = None

    @property
    def sides(self) -> tuple[float, float]:
        """Width and height of the sample in metres; pixels are square."""
        rows, columns = self.maps.shape
        return self.width, self.width * rows / columns

    @cached_property
    def occlusion(self) -> Array:
        """(H, W): ambient occlusion of the height, 1 where there is none."""
        if self.height is None:
            return np.ones(self.maps.shape, np.float32)
        return ambient_occlusion(self.height, self.width / self.maps.shape[1])


def normal_texture(normal: Array, convention: str) -> Texture:
    """n/2 + 1/2; "directx" has the green channel point down."""
    sign = np.array([1, -1 if convention == "directx" else 1, 1], np.float32)
    return Texture(normal * sign / 2 + 0.5)


def normals_seen(image: Array, convention: str) -> Array:
    """Unit normals from what `normal_texture` wrote."""
    sign = np.array([1, -1 if convention == "directx" else 1, 1], np.float32)
    n = (image[..., :3] * 2 - 1) * sign
    n /= np.sqrt(np.einsum("ijk,ijk->ij", n, n))[..., None]
    return n.astype(np.float32, copy=False)


def height_texture(height: Array) -> Texture:
    """Heights mapped to [0, 1], the lowest to 0; `height_range` undoes it."""
    low, high = height_range(height)
    return Texture((height - low) / max(high - low, 1e-12))


def height_range(height: Array) -> tuple[float, float]:
    """Metres of black and white in a height texture."""
    return float(height.min()), float(height.max())
