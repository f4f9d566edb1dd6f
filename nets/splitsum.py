"""Split-sum lighting in torch: what basis materials with the predicted normals would show.

Karis 2013, "Real Shading in Unreal Engine 4": ∫ f L cos ≈ prefiltered light · BRDF table. The
environment is masked by the screen as seen from five points of the sample, so it is one for all
pixels; the screen is near, so its mirrored point is found for each pixel. Light enters as images
that numpy prepares once a capture (`prefilter_sky`, `prefilter_screen`); `normal_clues` looks them
up, differentiably with respect to the normals.

A sky image lies on Lambert's disc, direction d at d.xy / √(1 + d.z), over [-SKY_EXTENT,
SKY_EXTENT]²: beyond the unit disc is below the horizon. A screen image spans (s, t) in
[-SCREEN_MARGIN, 1 + SCREEN_MARGIN]². Both have row 0 at +y and column 0 at -x.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors.torch import load_file
from scipy import fft
from scipy.ndimage import map_coordinates
from torch import Tensor

from invrender.rig import Rig
from invrender.sphere import directions, resample_environment, solid_angles
from invrender.types import Array

LEVELS = tuple(k / 7 for k in range(8))  # roughness of the paper's 8 mip levels
SKY_EXTENT = 1.25
SKY_SIZE = 40
SKY_ROWS = 64  # of the equirectangular image that is filtered
SCREEN_MARGIN = 0.5
SCREEN_SIZE = 48
# Of lobes filtered on a grid: their least width in texels (about a texel's standard deviation), and
# the least α², which keeps a mirror's finite.
TEXEL_WIDTH, LEAST_ALPHA_SQUARED = 0.4, 1e-6
LOWEST_Z = -0.95  # of a direction on Lambert's disc, whose border is -1
GOLDEN = (5**0.5 - 1) / 2  # steps of an even sequence on the circle
LEAST_SCREEN_COS = 0.02  # between a ray and the screen's axis: 89 degrees
LEAST_N_V = 1e-3  # n·v of a normal that looks away from the camera
BRDF_TABLE = Path(__file__).with_name("weights") / "brdf_table.safetensors"
FAR = 1e3  # coordinates that are outside any image


# --- preparation, numpy ---------------------------------------------------------------------------


def mask_environment(environment: Array, rig: Rig) -> Array:
    """Black where the screen is seen from any of the sample's corners or its centre, and below
    the table."""
    d = directions(*environment.shape[:2]).astype(np.float64)
    hidden = d[..., 2] <= 0
    if not rig.has_screen:
        return np.where(hidden[..., None], 0, environment).astype(np.float32)
    corner, (e_x, e_y) = rig.screen_body
    m = np.cross(e_x, e_y)
    half = rig.sample_size / 2
    cos = d @ m
    for x, y in ((0, 0), (-1, -1), (1, -1), (-1, 1), (1, 1)):
        offset = corner - np.array([x * half, y * half, 0])
        with np.errstate(divide="ignore", invalid="ignore"):
            p = d * (offset @ m / cos)[..., None] - offset
        s, t = p @ e_x / (e_x @ e_x), p @ e_y / (e_y @ e_y)
        hidden |= (cos > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return np.where(hidden[..., None], 0, environment).astype(np.float32)


def _lobe(cos: Array, roughness: float | None, texel: float = 0.0) -> Array:
    """Weight of light at angle arccos(cos) from the mirror direction, for n = v = r: D·(n·l).

    ``roughness`` None is the cosine lobe. ``texel`` (radians) keeps it as wide as a texel.
    """
    if roughness is None:
        return np.maximum(cos, 0)
    a2 = roughness**4 + (TEXEL_WIDTH * texel) ** 2 + LEAST_ALPHA_SQUARED
    h2 = np.clip((1 + cos) / 2, 0, 1)  # cos² of the half vector's angle
    return np.maximum(cos, 0) * a2 / (a2 * h2 + 1 - h2) ** 2


@cache
def _sky_kernel(roughness: float | None) -> NDArray[np.complex128]:
    """Fourier coefficients along φ of the lobe between rows: (frequency, row out, row in)."""
    rows, columns = SKY_ROWS, 2 * SKY_ROWS
    theta = (np.arange(rows) + 0.5) * np.pi / rows
    phi = np.arange(columns) * 2 * np.pi / columns
    c, s = np.cos(theta), np.sin(theta)
    cos = c[:, None, None] * c[None, :, None] + s[:, None, None] * s[None, :, None] * np.cos(phi)
    lobe = _lobe(cos, roughness, np.pi / rows) * solid_angles(rows, columns)[None, :, None]
    lobe /= lobe.sum((1, 2), keepdims=True)
    return np.fft.rfft(lobe[:, : rows // 2], axis=2).transpose(2, 0, 1)


@cache
def _disc_lookup(size: int) -> Array:
    """(row, column) in the equirectangular image of each pixel of the disc, (2, size, size)."""
    x = ((np.arange(size) + 0.5) / size * 2 - 1) * SKY_EXTENT
    px, py = np.meshgrid(x, -x)
    r2 = px**2 + py**2
    theta = np.arccos(np.clip(1 - r2, -1, 1))
    phi = np.arctan2(py, px) % (2 * np.pi)
    return np.stack([theta / np.pi * SKY_ROWS - 0.5, phi / (2 * np.pi) * 2 * SKY_ROWS - 0.5])


def prefilter_sky(
    environment: Array, roughness: Sequence[float | None] = LEVELS, size: int = SKY_SIZE
) -> Array:
    """Filter an environment for each roughness (None: the cosine lobe, E/π): (N, size, size, 3).

    Light from below the table is left out. A constant hemisphere of radiance L gives L where the
    whole lobe sees it.
    """
    env = resample_environment(environment, SKY_ROWS)[: SKY_ROWS // 2].astype(np.float64)
    spectrum = np.fft.rfft(env, axis=1).transpose(1, 0, 2)  # (frequency, row, RGB)
    rows, columns = _disc_lookup(size)
    out = np.empty((len(roughness), size, size, 3), np.float32)
    for k, rho in enumerate(roughness):
        kernel = _sky_kernel(rho)
        image = np.fft.irfft((kernel @ spectrum).transpose(1, 0, 2), n=2 * SKY_ROWS, axis=1)
        image = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
        image[:, 0], image[:, -1] = image[:, -2], image[:, 1]
        for c in range(3):
            out[k, ..., c] = map_coordinates(
                image[..., c], [rows + 1, columns + 1], order=1, mode="nearest"
            )
    return np.maximum(out, 0)


@cache
def _screen_kernel(roughness: float, height: float) -> Array:
    """The lobe's footprint on a screen at ``height`` (in its own size), straight above."""
    n = 2 * SCREEN_SIZE - 1
    pixel = (1 + 2 * SCREEN_MARGIN) / SCREEN_SIZE
    x = (np.arange(n) - n // 2) * pixel / height
    tan2 = x[None, :] ** 2 + x[:, None] ** 2
    cos = 1 / np.sqrt(1 + tan2)
    weight = _lobe(cos, roughness, pixel / height) * cos**3 * (pixel / height) ** 2
    gamma = (np.arange(4096) + 0.5) / 4096 * np.pi / 2
    total = (_lobe(np.cos(gamma), roughness, pixel / height) * np.sin(gamma)).sum()
    return weight / (total * 2 * np.pi * (np.pi / 2) / 4096)


def prefilter_screen(
    pattern: Array, roughness: Sequence[float], height: float, size: int = SCREEN_SIZE
) -> Array:
    """Filter the screen's radiance (P, P, 3) for each roughness: (N, size, size, 3).

    ``height``: of the screen above the sample, in its own size. Outside it is black.
    """
    pixels = round(size / (1 + 2 * SCREEN_MARGIN))
    start = (size - pixels) // 2
    image = np.zeros((size, size, 3))
    image[start : start + pixels, start : start + pixels] = area_resize(pattern, pixels)
    kernels = [_screen_kernel(r, round(height, 2)) for r in roughness]
    return np.stack([np.maximum(_convolve(image, k), 0) for k in kernels]).astype(np.float32)


def _convolve(image: Array, kernel: Array) -> Array:
    """The part of image (H, W, C) ∗ kernel (h, w) that lies on the image; scipy.signal's
    fftconvolve does the same, but its import takes a second."""
    (h, w), (kh, kw) = image.shape[:2], kernel.shape
    size = [fft.next_fast_len(a + b - 1, real=True) for a, b in ((h, kh), (w, kw))]
    product = fft.rfft2(image, size, axes=(0, 1)) * fft.rfft2(kernel, size)[..., None]
    full = fft.irfft2(product, size, axes=(0, 1))
    top, left = (kh - 1) // 2, (kw - 1) // 2
    return np.asarray(full[top : top + h, left : left + w])


def area_resize(image: Array, size: int) -> Array:
    """(H, W, C) to (size, size, C): means over areas, bilinear where it is enlarged."""
    x = torch.as_tensor(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
    if min(image.shape[:2]) >= size:
        y = F.interpolate(x, (size, size), mode="area")
    else:
        y = F.interpolate(x, (size, size), mode="bilinear", align_corners=False)
    return y[0].permute(1, 2, 0).numpy()


@cache
def brdf_table() -> Tensor:
    """`compute_brdf_table`'s, as a file holds it: computing it takes a quarter of a second."""
    return load_file(BRDF_TABLE)["brdf"]


def compute_brdf_table(size: int = 32, samples: int = 4096) -> NDArray[np.float32]:
    """∫ of the specular lobe under white light, k_s·B + A: (2, ρ, n·v), texel centres.

    Both axes go from 0 to 1. By visible normals with the height-correlated Smith term.
    """
    i = np.arange(samples)
    u1, u2 = (i * GOLDEN) % 1, (i + 0.5) / samples
    sin, cos = np.sin(2 * np.pi * u1), np.cos(2 * np.pi * u1)
    grid = (np.arange(size) + 0.5) / size
    table = np.zeros((2, size, size))
    for a, rho in enumerate(grid):
        alpha = rho * rho
        for b, nv in enumerate(grid):
            w = np.array([alpha * np.sqrt(1 - nv * nv), 0, nv])
            w /= np.linalg.norm(w)
            z = (1 - u2) * (1 + w[2]) - w[2]
            r = np.sqrt(np.maximum(1 - z * z, 0))
            h = np.stack([alpha * (r * cos + w[0]), alpha * (r * sin), z + w[2]])
            h /= np.linalg.norm(h, axis=0)
            vh = h[0] * np.sqrt(1 - nv * nv) + h[2] * nv
            lz = 2 * vh * h[2] - nv
            up = lz > 0
            lz = np.where(up, lz, 1)
            root_l = np.sqrt(alpha**2 * (1 - lz**2) + lz**2)
            root_v = np.sqrt(alpha**2 * (1 - nv**2) + nv**2)
            weight = np.where(up, lz * (nv + root_v) / (nv * root_l + lz * root_v), 0)
            fresnel = np.clip(1 - vh, 0, 1) ** 5
            table[:, a, b] = (weight * (1 - fresnel)).mean(), (weight * fresnel).mean()
    return table.astype(np.float32)


# --- look-ups, torch ------------------------------------------------------------------------------


def view_directions(position: Tensor, rig: Tensor) -> Tensor:
    """Unit vectors (B, 3, H, W) to the camera from positions (B, 2, H, W), see `pack_rig`."""
    x = torch.cat([position, torch.zeros_like(position[:, :1])], 1)
    v = rig[:, 0:3, None, None] - x
    return v * torch.rsqrt((v * v).sum(1, keepdim=True))


def reflect(view: Tensor, normal: Tensor) -> Tensor:
    """The mirror direction 2(n·v)n - v."""
    return 2 * (view * normal).sum(1, keepdim=True) * normal - view


def look_up_sky(sky: Tensor, direction: Tensor) -> Tensor:
    """Bilinear look-up of images (B, C, S, S) on the disc along unit directions (B, 3, H, W)."""
    q = torch.rsqrt(1 + direction[:, 2:].clamp(min=LOWEST_Z)) / SKY_EXTENT
    x, y = direction[:, :1] * q, direction[:, 1:2] * q
    return sample(sky, torch.cat([x, y], 1))


def sample(image: Tensor, position: Tensor, padding: str = "border") -> Tensor:
    """Bilinear look-up of (B, C, h, w) at (B, 2, H, W) in [-1, 1]², x right and y up."""
    # Torch's backward pass writes out of bounds where a coordinate is NaN.
    at = torch.nan_to_num(position).clamp(-FAR, FAR)
    grid = torch.stack([at[:, 0], -at[:, 1]], -1).expand(len(image), -1, -1, -1)
    return F.grid_sample(image, grid, padding_mode=padding, align_corners=False)


def hit_screen(position: Tensor, direction: Tensor, rig: Tensor) -> Tensor:
    """(s, t), (B, 2, H, W), where rays from sample positions meet the screen's plane.

    Far off where they do not meet it.
    """
    corner, e_x, e_y = (rig[:, k : k + 3, None, None] for k in (3, 6, 9))
    x = torch.cat([position, torch.zeros_like(position[:, :1])], 1)
    m = torch.linalg.cross(e_x, e_y, dim=1)
    m = F.normalize(m, dim=1)
    cos = (direction * m).sum(1, keepdim=True).clamp(min=LEAST_SCREEN_COS)
    r = ((corner - x) * m).sum(1, keepdim=True) / cos
    p = x + r * direction - corner
    s = (p * e_x).sum(1, keepdim=True) / (e_x * e_x).sum(1, keepdim=True)
    t = (p * e_y).sum(1, keepdim=True) / (e_y * e_y).sum(1, keepdim=True)
    return torch.cat([s, t], 1).clamp(-8, 8)


def look_up_screen(screen: Tensor, st: Tensor) -> Tensor:
    """Bilinear look-up of screen images (B, C, S, S) with their margin at (s, t)."""
    return sample(screen, (st * 2 - 1) / (1 + 2 * SCREEN_MARGIN))


def brdf_factors(n_v: Tensor, roughness: float, table: Tensor) -> tuple[Tensor, Tensor]:
    """(B, A) of k_s·B + A at n·v (any shape) for one roughness, linear in the table."""
    size = table.shape[-1]
    row = min(max(roughness * size - 0.5, 0), size - 1)
    r0 = min(int(row), size - 2)
    line = torch.lerp(table[:, r0], table[:, r0 + 1], row - r0)
    at = torch.nan_to_num(n_v * size - 0.5).clamp(0, size - 1)
    i = at.detach().floor().clamp(max=size - 2).long()
    f = at - i
    b, a = ((1 - f) * line[k][i] + f * line[k][i + 1] for k in (0, 1))
    return b, a


def normal_clues(
    normal: Tensor,
    position: Tensor,
    to_camera: Tensor,
    rig: Tensor,
    sky: Tensor,
    screen: Tensor | None,
    table: Tensor,
    basis: Sequence[tuple[float, float]],
    albedo: float = 0.6,
) -> tuple[Tensor, Tensor | None]:
    """Radiance of the basis materials (ρ, k_d), k_s = albedo - k_d, with these normals.

    normal, to_camera (B, 3, H, W), unit; position (B, 2, H, W); rig (B, 12); sky
    (B, 3·(R + 1), S, S): for each roughness in the order in which the basis first names it, then
    E/π; screen likewise without E, or None. Returns the environment's images (B, 3·len(basis), H,
    W) and the specular images of the screen (B, 3·R, H, W).
    """
    levels = list(dict.fromkeys(rho for rho, _ in basis))
    mirror = reflect(to_camera, normal)
    n_v = (normal * to_camera).sum(1, keepdim=True).clamp(LEAST_N_V, 1)
    factors = {rho: brdf_factors(n_v, rho, table) for rho in levels}
    light = look_up_sky(sky[:, : 3 * len(levels)], mirror).chunk(len(levels), 1)
    diffuse = look_up_sky(sky[:, 3 * len(levels) :], normal)
    images = []
    for rho, k_d in basis:
        b, a = factors[rho]
        images.append(k_d * diffuse + light[levels.index(rho)] * ((albedo - k_d) * b + a))
    active = None
    if screen is not None:
        seen = look_up_screen(screen, hit_screen(position, mirror, rig)).chunk(len(levels), 1)
        white = [albedo * factors[rho][0] + factors[rho][1] for rho in levels]
        active = torch.cat([s * w for s, w in zip(seen, white, strict=True)], 1)
    return torch.cat(images, 1), active


def pack_rig(rig: Rig) -> Array:
    """Camera, the screen's corner and its two edges, (12,), in units of half the sample's size."""
    parts = [rig.camera, rig.screen_corner, *rig.screen_edges]
    return (np.concatenate(parts) / (rig.sample_size / 2)).astype(np.float32)
