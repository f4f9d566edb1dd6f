"""What a photo's shading says of slopes, pixel by pixel, as inputs of the network.

Relative to its neighbourhood a pixel's colour is that of its albedo times that of its shading.
With n ∝ (p, q, 1) and the clue image B of a flat basis material, per colour channel,

    log(I/B) - mean of log(I/B) nearby  =  a + c + g_p·p + g_q·q + noise,   g = ∂B/∂(p, q) / B,

where a is grey variation of the albedo and c its variation in colour. Under light of many colours
from many places g differs between channels, and the posterior mean of (p, q) under Gaussian priors
is a small linear solve: photometric stereo with lights told apart by colour. The network learns
which basis material, and how much of it, to believe.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from nets.clues import SLOPED, WHITE

NEIGHBOURHOOD = 8  # pixels a side of the neighbourhood
SLOPE, LOG_NOISE = 0.2, 0.01  # standard deviations of slopes and of log I
ALBEDO_SPREADS = ((0.05, 0.03), (0.3, 0.08))  # those of grey and of colour: plain, and textured
SLOPE_MATERIALS = ((3, 0), (2, 1))  # place in `BASIS` and in `SLOPED`: white, and rough specular
SLOPE_FEATURES = 3 + 18 + 4 * len(SLOPE_MATERIALS)
LEAST_RADIANCE = 1e-3  # that counts as light, in units of a white plane
MOST_RELATIVE = 100.0  # |g|: a sharp lobe's flank on black
MOST_SLOPE = 3.0  # 72 degrees


def slope_features(photo: Tensor, plane: Tensor, derivatives: Tensor) -> list[Tensor]:
    """Features of a photo (B, 3, H, W), `SLOPE_FEATURES` channels in all.

    plane (B, 12, H, W): radiance of the basis materials, lying flat; derivatives (B, 18, H, W):
    slope clues, see `nets.clues.plane_clues`.
    """
    base = plane.unflatten(1, (-1, 3))
    lit = base[:, SLOPED].clamp(min=LEAST_RADIANCE).unsqueeze(1)
    g = derivatives.unflatten(1, (2, len(SLOPED), 3)) / lit  # along p and q, material, colour
    g = g.clamp(-MOST_RELATIVE, MOST_RELATIVE)
    log_photo = torch.log(photo + LEAST_RADIANCE)
    estimates = []
    for material, place in SLOPE_MATERIALS:
        ratio = log_photo - torch.log(base[:, material] + LEAST_RADIANCE)
        detail = ratio - _nearby(ratio)
        found = posteriors(detail, g[:, 0, place], g[:, 1, place], ALBEDO_SPREADS)
        estimates += found if material != WHITE else [*found, detail]
    return [asinh(g.flatten(1, 3)), *(x.clamp(-MOST_SLOPE, MOST_SLOPE) for x in estimates)]


def asinh(x: Tensor) -> Tensor:
    """sign(x)·log(|x| + √(x² + 1)), whose functions torch has vectorised, unlike its own asinh."""
    return torch.log(x.abs() + torch.sqrt(x * x + 1)).copysign(x)


def _nearby(x: Tensor) -> Tensor:
    """Means over `NEIGHBOURHOOD` × `NEIGHBOURHOOD` pixels, smooth between."""
    h, w = x.shape[-2:]
    coarse = F.avg_pool2d(x, (min(NEIGHBOURHOOD, h), min(NEIGHBOURHOOD, w)), ceil_mode=True)
    return F.interpolate(coarse, (h, w), mode="bilinear", align_corners=False)


def posteriors(
    detail: Tensor, g_p: Tensor, g_q: Tensor, spreads: Sequence[tuple[float, float]]
) -> list[Tensor]:
    """Posterior means (B, 2, H, W) of the slopes, ΣGᵀ(GΣGᵀ + R)⁻¹·detail, with
    R = grey²·11ᵀ + (colour² + noise²)·1, for each pair of ``spreads`` (grey, colour); by the 2 × 2
    form (GᵀR⁻¹G + Σ⁻¹)⁻¹GᵀR⁻¹·detail. The images are (B, 3, H, W)."""
    pairs = {"pp": (g_p, g_p), "qq": (g_q, g_q), "pq": (g_p, g_q), "x": (g_p, detail),
             "y": (g_q, detail)}  # fmt: skip
    products = {k: (a * b).sum(1, keepdim=True) for k, (a, b) in pairs.items()}
    totals = {id(a): a.sum(1, keepdim=True) for a in (g_p, g_q, detail)}
    sums = {k: totals[id(a)] * totals[id(b)] for k, (a, b) in pairs.items()}
    found = []
    for grey, colour in spreads:
        own = colour**2 + LOG_NOISE**2
        shared = grey**2 / (own + 3 * grey**2)
        # aᵀR⁻¹b by Sherman and Morrison.
        pp, qq, pq, x, y = ((products[k] - shared * sums[k]) / own for k in pairs)
        pp, qq = pp + SLOPE**-2, qq + SLOPE**-2
        found.append(torch.cat([qq * x - pq * y, pp * y - pq * x], 1) / (pp * qq - pq * pq))
    return found
