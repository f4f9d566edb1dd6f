"""From the mirror ball's image to the light: the environment, and the pattern on the screen.

Everything follows single rays: a photo's pixel sees a point of the ball, and there, mirrored, a
direction. Nothing is taken as infinitely far or orthographic except the environment itself.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve

from invrender.capture.ball_image import BallImage, sample_image, screen_mask
from invrender.capture.mirror import mirror_normals
from invrender.capture.settings import UNFOLDING
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sphere import directions
from invrender.types import Array, InputError


def unfold_environment(
    photo: Photo, rig: Rig, image: BallImage, height: int = UNFOLDING.height, blur: float = 0.0,
    white: Array | None = None,
) -> tuple[Array, Array]:  # fmt: skip
    """The environment as the ball shows it: radiance (H, 2H, 3) and coverage (H, 2H) in [0, 1].

    Each texel averages `UNFOLDING.samples`² directions; for each the point of the ball that mirrors
    it into the camera is found and the photo looked up there. Coverage is the share of a texel that
    is above the horizon and not behind the screen; radiance is the mean over that share. The
    mirror's reflectance is divided out. ``blur``: the camera's, in pixels; as far as it spreads the
    screen's light, the room beside it counts as hidden. But what is there brighter than the screen
    can be, whose ``white`` has a radiance (3,), is a lamp: less the screen's own light it is the
    mean over a texel that shows nothing else, of which the coverage is nought.
    """
    ball, samples, half = image.ball, UNFOLDING.samples, height // 2

    def pool(a: Array) -> Array:
        return a.reshape(half, samples, 2 * height, samples, -1).sum((1, 3))

    margin = UNFOLDING.screen_margin + UNFOLDING.margin_a_blur * blur
    mask = screen_mask(rig, image, margin)
    wanted = directions(samples * height, 2 * samples * height)[: half * samples].astype(float)
    centre = np.asarray(ball.position)
    normal = mirror_normals(rig, centre, ball.radius_m, wanted, False)
    pixels = rig.project(centre + ball.radius_m * normal, *ball.size)
    free = sample_image(mask, pixels, image.origin) < UNFOLDING.hidden
    light = sample_image(photo.image[image.area], pixels, image.origin) * free[..., None]
    count, lamps = pool(free.astype(np.float32)), np.zeros((half, 2 * height, 1), np.float32)
    if (
        white is not None
        and (beside := _lamps_by_screen(photo, rig, image, mask, blur, white)).any()
    ):
        share = sample_image(np.asarray(beside.max(-1) > 0, np.float32), pixels, image.origin)
        shown = (share >= UNFOLDING.lamp_shown) & ~free
        light += sample_image(beside, pixels, image.origin) * shown[..., None]
        lamps = pool(shown.astype(np.float32))

    seen = np.where(count > 0, count + lamps, samples**2)
    environment = np.zeros((height, 2 * height, 3), np.float32)
    coverage = np.zeros((height, 2 * height), np.float32)
    environment[:half] = pool(light) / seen / np.asarray(rig.ball_reflectance)
    coverage[:half] = count[..., 0] / samples**2
    return environment, coverage


def _lamps_by_screen(
    photo: Photo, rig: Rig, image: BallImage, mask: Array, blur: float, white: Array
) -> Array:
    """(h, w, 3): what of the ball's image in the ``mask`` is brighter than the screen can be."""
    share = ndimage.gaussian_filter(screen_mask(rig, image, 0), max(blur, UNFOLDING.least_blur))
    screen = share[..., None] * (white * np.asarray(rig.ball_reflectance))
    light = np.maximum(photo.image[image.area] - screen, 0) * mask[..., None]
    brightest = UNFOLDING.brighter * np.mean(white * np.asarray(rig.ball_reflectance))
    return np.asarray(light * (light.mean(-1, keepdims=True) > brightest), np.float32)


def fill_environment(environment: Array, coverage: Array) -> Array:
    """Fill the upper hemisphere where coverage is nil, smoothly from what surrounds the gap.

    Harmonic on the sphere (Laplace's equation with the seen texels as its boundary), in the
    logarithm of the radiance, so that a lamp beside the screen does not spread behind it. What is
    known of lamps in the gap is added. The lower hemisphere is left as it is.
    """
    height, width = coverage.shape
    half = height // 2
    hole = coverage[:half] <= 0
    if not hole.any():
        return environment
    if hole.all():
        raise InputError("the mirror ball shows nothing but the screen: check the rig's sizes")
    known = environment[:half][~hole]
    floor = np.maximum(known.mean(0) * UNFOLDING.floor, UNFOLDING.least_floor)
    log = np.log(np.maximum(environment[:half], floor)).reshape(-1, 3).astype(np.float64)
    index = np.full(half * width, -1)
    unknown = np.flatnonzero(hole.reshape(-1))
    index[unknown] = np.arange(unknown.size)
    r, c = np.divmod(unknown, width)
    # Conductances of the grid's edges: length of the shared side over distance of the centres.
    sine = np.sin(np.pi * (np.arange(half) + 0.5) / height)
    side_up = np.sin(np.pi * np.arange(half + 1) / height)
    step_u, step_v = 2 * np.pi / width, np.pi / height
    neighbours = [
        (r, (c - 1) % width, step_v / (step_u * sine[r])),
        (r, (c + 1) % width, step_v / (step_u * sine[r])),
        (r - 1, c, side_up[r] * step_u / step_v),  # zero at the zenith
        (r + 1, c, np.where(r + 1 < half, side_up[r + 1] * step_u / step_v, 0)),
    ]
    diagonal = np.zeros(unknown.size)
    right = np.zeros((unknown.size, 3))
    triples = []
    here = np.arange(unknown.size)
    for nr, nc, weight in neighbours:
        flat = np.clip(nr, 0, half - 1) * width + nc
        diagonal += weight
        other = index[flat]
        inside = other >= 0
        triples.append((here[inside], other[inside], -weight[inside]))
        np.add.at(right, here[~inside], weight[~inside, None] * log[flat[~inside]])
    triples.append((here, here, diagonal))
    i, j, value = (np.concatenate(part) for part in zip(*triples, strict=True))
    matrix = sparse.csc_matrix((value, (i, j)), shape=(unknown.size,) * 2)
    solution = spsolve(matrix, right)
    filled = environment.copy()
    filled[:half].reshape(-1, 3)[unknown] += np.exp(solution)
    return filled
