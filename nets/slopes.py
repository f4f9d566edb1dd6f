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

import torch
import torch.nn.functional as F
from torch import Tensor

NEAR = 8  # pixels a side of the neighbourhood
SLOPE, NOISE = 0.2, 0.01  # standard deviations of slopes and of log I
ALBEDO_SPREADS = ((0.05, 0.03), (0.3, 0.08))  # those of grey and of colour: plain, and textured
MATERIALS = ((3, 0), (2, 1))  # place in `BASIS` and in `SLOPED`: white, and rough specular
SLOPE_FEATURES = 3 + 18 + 4 * len(MATERIALS)


def slope_features(photo: Tensor, plane: Tensor, derivatives: Tensor) -> Tensor:
    """Features (B, SLOPE_FEATURES, H, W) of a photo (B, 3, H, W).

    plane (B, 12, H, W): radiance of the basis materials, lying flat; derivatives (B, 18, H, W):
    slope clues, see `nets.clues.plane_clues`.
    """
    relative = (derivatives / _order(plane).clamp(min=1e-3)).clamp(-100, 100)
    estimates = []
    for material, place in MATERIALS:
        base = plane[:, 3 * material : 3 * material + 3]
        ratio = torch.log((photo + 1e-3) / (base + 1e-3))
        detail = ratio - _nearby(ratio)
        g_p, g_q = (relative[:, k : k + 3] for k in (3 * place, 9 + 3 * place))
        estimates += [posterior(detail, g_p, g_q, *spreads) for spreads in ALBEDO_SPREADS]
        if material == 3:
            estimates.append(detail)
    return torch.cat([torch.asinh(relative), *(x.clamp(-3, 3) for x in estimates)], 1)


def _order(plane: Tensor) -> Tensor:
    """The radiance that each channel of the slope clues is a derivative of."""
    white, rough, glossy = (plane[:, 3 * m : 3 * m + 3] for m in (3, 2, 0))
    return torch.cat([white, rough, glossy] * 2, 1)


def _nearby(x: Tensor) -> Tensor:
    """Means over `NEAR` × `NEAR` pixels, smooth between."""
    h, w = x.shape[-2:]
    coarse = F.avg_pool2d(x, (min(NEAR, h), min(NEAR, w)), ceil_mode=True)
    return F.interpolate(coarse, (h, w), mode="bilinear", align_corners=False)


def posterior(detail: Tensor, g_p: Tensor, g_q: Tensor, grey: float, colour: float) -> Tensor:
    """Posterior mean (B, 2, H, W) of the slopes, ΣGᵀ(GΣGᵀ + R)⁻¹·detail, with
    R = grey²·11ᵀ + (colour² + noise²)·1; by the 2 × 2 form (GᵀR⁻¹G + Σ⁻¹)⁻¹GᵀR⁻¹·detail."""
    own = colour**2 + NOISE**2
    shared = grey**2 / (own + 3 * grey**2)

    def whitened(a: Tensor, b: Tensor) -> Tensor:
        """aᵀR⁻¹b by Sherman and Morrison."""
        product = (a * b).sum(1, keepdim=True)
        sums = a.sum(1, keepdim=True) * b.sum(1, keepdim=True)
        return (product - shared * sums) / own

    pp = whitened(g_p, g_p) + SLOPE**-2
    qq = whitened(g_q, g_q) + SLOPE**-2
    pq = whitened(g_p, g_q)
    x, y = whitened(g_p, detail), whitened(g_q, detail)
    det = pp * qq - pq * pq
    return torch.cat([qq * x - pq * y, pp * y - pq * x], 1) / det
