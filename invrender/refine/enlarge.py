"""Maps of a large photo from those of the photo shrunk: materials and lights are judged at `WHOLE`
pixels a side, where networks and priors are made, and details follow the photo.

A guided filter (He, Sun, Tang 2013): slopes and albedos are linear in the logarithm of the photo
around each small pixel, and what is linear there goes on to the details, without the photo's noise.
Roughness is interpolated: with the photo it does not vary. Maps and photo are sharpened before they
are interpolated, so that what is shrunk again is what it was. All is done in bands of rows, in
bounded memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from scipy.linalg import solve_banded
from scipy.ndimage import uniform_filter
from scipy.sparse import eye_array

from invrender.maps import Maps, constant_maps
from invrender.refine.gauss_newton import linearise
from invrender.refine.theta import dielectric_share, to_theta
from invrender.render.renderer import Renderer
from invrender.sampling import resize, resize_weights
from invrender.types import TINY, Array, Mask

WHOLE = 256  # pixels of the longer side at which a sample is judged as a whole
# Of the guided filter, by hand (docs/research-log/2026-11-30-large-from-small.md): pixels a side of
# its window; deviation of the photo's logarithm that tells nothing; what is added to the photo
# before, of its mean; n·z of the steepest normal.
GUIDE_SIZE, GUIDE_NOISE, DARK, STEEPEST_SLOPE = 5, 0.03, 0.02, 0.1
# By hand too: what dielectrics' albedo takes of the details that are not explained yet; and the
# light, of the sample's mean, that tells little of an albedo.
TAKEN, LITTLE_LIGHT = 0.5, 0.2
LIGHT_SAMPLES = 64  # of the specular lobe
LARGE_SAMPLES = 16  # of the specular lobe, in the rendering of maps that are large: noise of 1%
# Pixels a side up to which a photo's noise is white: beyond, it is interpolated. By hand.
WHITE_UP_TO = 1024
COUPLED = 1  # pixel, of an image that is enlarged and shrunk again
BELOW = 2  # octaves below the details that are looked at too
WHOLE_OCTAVE = 3.5  # areas, of the one below, of an octave that tells noise
MOST_RISE = 1.0  # of a texture's variance from an octave to the next: noise has four; by hand
LEAST = 1e-100  # a variance that is none, in any unit
SEEN = 4  # of so many bands one tells the finest octave's covariance
BAND_PIXELS = 1 << 16  # pixels at once


def fitting(photo: Array, longest: int) -> tuple[int, int]:
    """Height and width of a photo or maps (H, W, n) shrunk until the longer is ``longest``."""
    height, width = photo.shape[:2]
    scale = longest / max(height, width)
    return max(1, round(height * scale)), max(1, round(width * scale))


def enlarge(maps: Maps, photo: Array) -> Maps:
    """Maps of a photo (H, W, 3) from those of it shrunk."""
    height, width = photo.shape[:2]
    dark = DARK * photo.mean((0, 1)) + np.float32(TINY)

    def log(band: slice) -> Array:
        return np.log(np.maximum(photo[band], 0) + dark).astype(np.float32, copy=False)

    guide, details = _guide(log, height, width, maps.shape)
    slopes = maps.normal[..., :2] / np.maximum(maps.normal[..., 2:], STEEPEST_SLOPE)
    detailed = np.concatenate([maps.diffuse, maps.specular, slopes], -1)
    sharp = _sharpened(detailed, height, width)
    parts = [sharp, maps.roughness[..., None], _following(guide, detailed)]
    interpolated = _interpolation(np.concatenate(parts, -1), height, width)
    out = constant_maps(height, width)
    for band in _bands(height, width):
        full = interpolated(band)
        found, out.roughness[band] = full[:, :8], full[:, 8]
        detail = details(band)
        for k in range(found.shape[1]):
            found[:, k] += (full[:, 9 + 3 * k : 12 + 3 * k] * detail).sum(1)
        albedos = np.clip(found[:, :6], 0, 1)
        # What a surface mirrors it cannot scatter too.
        diffuse = np.minimum(albedos[:, :3], 1 - albedos[:, 3:])
        out.diffuse[band] = np.swapaxes(diffuse, 1, 2)
        out.specular[band] = np.swapaxes(albedos[:, 3:], 1, 2)
        n_z = 1 / np.sqrt(1 + (found[:, 6:] ** 2).sum(1))
        out.normal[band] = np.stack([found[:, 6] * n_z, found[:, 7] * n_z, n_z], -1)
    return out


def explain_details(
    maps: Maps, picture: Array, photo: Array, clipped: Mask, small: Maps, renderer: Renderer
) -> None:
    """Let dielectrics' albedo take `TAKEN` of what ``picture`` (H, W, 3), a rendering of enlarged
    maps, lacks of the photo's details; the maps and the picture in place.

    small: the maps that were enlarged. Where the photo is saturated nothing is taken.
    """
    height, width = photo.shape[:2]
    theta = to_theta(small)
    light = linearise(renderer, theta, LIGHT_SAMPLES)[1][..., range(3), range(3)]
    level = LITTLE_LIGHT * light.mean() + np.float32(TINY)

    def lacks(band: slice) -> Array:
        return np.where(clipped[band][..., None], 0, photo[band] - picture[band])

    _, details = _guide(lacks, height, width, small.shape)
    share = TAKEN * dielectric_share(theta)[..., None] / (light**2 + level**2)
    interpolated = _interpolation(np.concatenate([light * share, light], -1), height, width)
    for band in _bands(height, width):
        full = interpolated(band)
        change = np.swapaxes(full[:, :3] * details(band), 1, 2)
        change[clipped[band]] = 0
        diffuse = np.clip(maps.diffuse[band] + change, 0, 1 - maps.specular[band])
        picture[band] += (diffuse - maps.diffuse[band]) * np.swapaxes(full[:, 3:], 1, 2)
        maps.diffuse[band] = diffuse


def _guide(
    image: Callable[[slice], Array], height: int, width: int, low: tuple[int, int]
) -> tuple[Array, Callable[[slice], Array]]:
    """Means (h, w, 3) of an image (H, W, 3) told in bands of rows, and what tells its details
    beyond them, (rows, 3, W), without their noise.

    Octave by octave, of twice the pixels a side: colours' covariance C of a texture is alike in two
    of them but for a factor, while noise is white and of each colour by itself. That tells its
    variances N, and the details are (C - N)·C⁻¹ of what is seen (Wiener).
    """
    sizes = [low]
    while 2 * max(sizes[-1]) < max(height, width):
        sizes.append((2 * sizes[-1][0], 2 * sizes[-1][1]))
    levels = [_shrunk(image, height, width, sizes[-1])]
    below = [tuple(max(n >> k, 1) for n in low) for k in range(1, BELOW + 1)]
    for size in [*sizes[-2::-1], *below]:
        levels.insert(0, resize(levels[0], *size))
    octaves = [b - _enlarged(a, *b.shape[:2]) for a, b in pairwise(levels)]
    last = _interpolation(_sharpened(levels[-1], height, width), height, width)
    finest = lambda band: np.swapaxes(image(band), 1, 2) - last(band)  # noqa: E731
    some = [np.swapaxes(finest(b), 1, 2) for b in [*_bands(height, width)][::SEEN]]
    seen = [_covariance(o) for o in [*octaves, np.concatenate(some)]]
    sides = [float(max(x.shape[:2])) ** 2 for x in levels] + [float(max(height, width)) ** 2]
    gains = _gains(seen, sides)
    clean = np.zeros_like(levels[BELOW])
    for octave, gain in zip(octaves[BELOW:], gains[BELOW:-1], strict=True):
        clean = _enlarged(clean, *octave.shape[:2]) + octave @ gain
    coarse = _interpolation(_sharpened(clean, height, width), height, width)

    def details(band: slice) -> Array:
        return np.einsum("rcw,cd->rdw", finest(band), gains[-1]) + coarse(band)

    return levels[BELOW], details


def _enlarged(image: Array, height: int, width: int) -> Array:
    """Interpolated to so many pixels; shrunk again it is as it was."""
    return resize(_sharpened(image, height, width), height, width)


def _covariance(colours: Array) -> Array:
    flat = colours.reshape(-1, 3)
    return np.asarray(flat.T @ flat / len(flat), np.float64)


def _gains(seen: list[Array], sides: list[float]) -> list[Array]:
    """What octaves with these covariances have of their textures, (3, 3) each. sides: squares of
    the pixels a side between which they lie, one more."""
    areas = np.diff(sides)
    whole = [i for i in range(1, len(seen)) if areas[i] > WHOLE_OCTAVE * areas[i - 1]]
    j = max(i for i in [1, *whole] if i == 1 or sides[i] < WHITE_UP_TO**2)
    apart = ~np.eye(3, dtype=bool)
    fine, coarse = seen[j], seen[j - 1]
    alike = float((fine * coarse)[apart].sum() / (np.sum(coarse[apart] ** 2) + LEAST))
    rises = min(max(alike, 0.0), MOST_RISE)
    left = np.diag(fine - rises * coarse) / (areas[j] - rises * areas[j - 1])
    noise = np.diag(np.maximum(left, 0))
    gains = []
    for covariance, area in zip(seen, areas, strict=True):
        values, axes = np.linalg.eigh(covariance - area * noise)
        texture = (axes * np.maximum(values, 0)) @ axes.T
        both = texture + area * noise
        inverse = np.linalg.inv(both + max(TINY * np.trace(both), LEAST) * np.eye(3))
        gains.append((inverse @ texture).astype(np.float32))
    return gains


def _bands(height: int, width: int) -> Iterator[slice]:
    rows = max(1, BAND_PIXELS // width)
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


def _shrunk(
    image: Callable[[slice], Array], height: int, width: int, low: tuple[int, int]
) -> Array:
    """The means (h, w, n) of an image (H, W, n) that is told in bands of rows."""
    narrow = (resize(x := image(band), len(x), low[1]) for band in _bands(height, width))
    return resize(np.concatenate(list(narrow)), *low)


def _interpolation(image: Array, height: int, width: int) -> Callable[[slice], Array]:
    """What tells (h, w, n) interpolated to so many pixels in bands of rows: (rows, n, W)."""
    low, _, n = image.shape
    wide = np.swapaxes(resize(image, low, width), 1, 2).reshape(low, -1)
    weights = eye_array(low, format="csr") if low == height else resize_weights(low, height)
    return lambda band: (weights[band] @ wide).reshape(-1, n, width)


def _following(guide: Array, images: Array) -> Array:
    """By how much channels of images (h, w, n) change with those of their guide (h, w, 3) around
    each pixel: (h, w, 3·n)."""
    mean = _around(guide)
    spread = _around(guide[..., :, None] * guide[..., None, :])
    spread -= mean[..., :, None] * mean[..., None, :]
    inverse = np.linalg.inv(spread + np.float32(GUIDE_NOISE**2) * np.eye(3, dtype=np.float32))
    together = _around(guide[..., :, None] * images[..., None, :])
    together -= mean[..., :, None] * _around(images)[..., None, :]
    change = np.swapaxes(_around(inverse @ together), -1, -2)
    return np.ascontiguousarray(change.reshape(*images.shape[:2], -1), np.float32)


def _around(image: Array) -> Array:
    """Means over the square around each pixel of (h, w, ...)."""
    size = (GUIDE_SIZE, GUIDE_SIZE) + (1,) * (image.ndim - 2)
    return np.asarray(uniform_filter(image, size, mode="nearest"))


def _sharpened(image: Array, height: int, width: int) -> Array:
    """What (h, w, n) has to be, so that interpolated to so many pixels and shrunk again it is as
    it is."""
    for axis, size in enumerate((height, width)):
        few = image.shape[axis]
        if few < size:
            there_and_back = resize_weights(size, few) @ resize_weights(few, size)
            diagonals = np.zeros((2 * COUPLED + 1, few), np.float32)
            for k in range(-COUPLED, COUPLED + 1):
                part = there_and_back.diagonal(k)
                diagonals[COUPLED - k, max(k, 0) : max(k, 0) + len(part)] = part
            flat = np.swapaxes(image, 0, axis)
            sharp = solve_banded((COUPLED, COUPLED), diagonals, flat.reshape(few, -1))
            image = np.swapaxes(sharp.reshape(flat.shape), 0, axis)
    return np.ascontiguousarray(image, np.float32)
