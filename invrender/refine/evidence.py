"""What a photo says of a sample's materials: as dielectrics, and as bare metals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from invrender.types import Array

ODDS_SCALE = (
    10.0  # of -2 log-likelihood; chosen by hand: evidence beyond it counts by its logarithm
)


@dataclass(frozen=True)
class MaterialEvidence:
    """The fits of `invrender.refine.lobes` to a photo, made twice: once as if each of the sample's
    materials were a dielectric with f0 near 0.04, once as if it were bare metal (k_d = 0).

    Images are (H, W) or (H, W, 3); what holds for the whole sample is the same everywhere. An array
    library's own kind of array with the channels on another axis serves as well (`nets.batch`).
    Log-likelihoods are compressed by `compress`.

    Attributes:
        dielectric_diffuse: k_d (H, W, 3) that the lobe leaves of the photo, pixel by pixel.
        dielectric_roughness: ρ (H, W) of the pixel's material.
        metal_specular: k_s (H, W, 3), pixel by pixel.
        metal_roughness: ρ (H, W) of the pixel's material.
        material_odds: how much likelier metal is, (H, W), by the residuals of the pixel's material.
        sample_odds: the same by the residuals of the sample, taken as one material.
        texture_odds: the same by the sample's texture: a wrong lobe leaves light in the albedo.
        dielectric_texture_roughness: posterior mean of ρ by the texture, as a dielectric.
        metal_texture_roughness: the same as metal.
        metal_material_specular: k_s (H, W, 3) of the pixel's material as metal.
        residual_costs: -2 log-likelihood of each ρ of `invrender.refine.lobes.ROUGHNESS` over the
            least of all, (2, ρ): as a dielectric and as metal, by residuals.
        texture_costs: the same by texture.
    """

    dielectric_diffuse: Any
    dielectric_roughness: Any
    metal_specular: Any
    metal_roughness: Any
    material_odds: Any
    sample_odds: Any
    texture_odds: Any
    dielectric_texture_roughness: Any
    metal_texture_roughness: Any
    metal_material_specular: Any
    residual_costs: Any
    texture_costs: Any


def compress(log_likelihood: Array) -> Array:
    """-2 log-likelihoods or their differences without their extremes: linear up to about
    `ODDS_SCALE`, logarithmic beyond."""
    return np.arcsinh(log_likelihood / ODDS_SCALE)
