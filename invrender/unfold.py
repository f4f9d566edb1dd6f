"""From the mirror ball's image to the light: the environment, and the pattern on the screen.

Everything follows single rays: a photo's pixel sees a point of the ball, and there, mirrored, a
direction. Nothing is taken as infinitely far or orthographic except the environment itself.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, sparse
from scipy.sparse.linalg import spsolve

from invrender.environments import directions, solid_angles
from invrender.errors import InputError
from invrender.images import Photo
from invrender.mirror import Ball, mirror_normals
from invrender.rig import Rig

Array = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]
# Pixels around the screen's image that may hold some of its light, and how many more for each of
# the camera's blur: the screen is often a hundred times as bright as the room beside it.
SCREEN_MARGIN, MARGIN_BLURS = 1.5, 1.5
# A veil over the ball is told from the table that is mirrored from 1.8 radii on.
BARE = 1.8
AT_ONCE = 2_000_000  # pairs of a point and a direction
VEILED = 0.7  # what it must leave of the residuals' cost to be believed


def screen_coordinates(rig: Rig, origin: Array, direction: Array) -> tuple[Array, Array, Mask]:
    """Where rays meet the screen: (s, t) along its edges, and whether within its rectangle."""
    e_x, e_y = rig.screen_edges
    normal = np.cross(e_x, e_y)
    along = direction @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((rig.screen_corner - origin) @ normal) / along
        point = origin + distance[..., None] * direction - rig.screen_corner
        s, t = point @ e_x / (e_x @ e_x), point @ e_y / (e_y @ e_y)
        hit = (distance > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return s, t, hit


def hidden_by_screen(rig: Rig, points: Array, direction: Array) -> Mask:
    """Whether the screen hides each of the directions (m, 3) from each of the points (n, 3)."""
    e_x, e_y = rig.screen_edges
    normal = np.cross(e_x, e_y)
    from_corner = np.asarray(points) - rig.screen_corner
    out = np.empty((len(from_corner), len(direction)), bool)
    step = max(1, AT_ONCE // max(len(direction), 1))

    def along(axis: Array, part: Array, t: Array) -> Array:
        return np.asarray((part @ axis)[:, None] + t * (direction @ axis)) / (axis @ axis)

    with np.errstate(divide="ignore", invalid="ignore"):
        for i in range(0, len(out), step):
            part = from_corner[i : i + step]
            t = -(part @ normal)[:, None] / (direction @ normal)
            a, b = along(e_x, part, t), along(e_y, part, t)
            out[i : i + step] = (t > 0) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
    return out


def room_irradiance(rig: Rig, points: Array, environment: Array) -> Array:
    """Irradiance (n, 3) of upward faces at points (n, 3) from the room (H, 2H, 3) that the screen
    does not hide from them."""
    d, flux = sky_flux(environment)
    lit = np.flatnonzero(flux.any(-1))
    out = np.empty((len(points), 3))
    step = max(1, AT_ONCE // max(len(lit), 1))
    for i in range(0, len(points), step):
        out[i : i + step] = ~hidden_by_screen(rig, points[i : i + step], d[lit]) @ flux[lit]
    return out


def sky_flux(environment: Array) -> tuple[Array, Array]:
    """Directions (m, 3) above the horizon of an environment's texels (H, 2H, 3), and what each
    sends through an upward face of unit area (m, 3)."""
    height = len(environment)
    half = height // 2
    d = directions(height, 2 * height)[:half].reshape(-1, 3).astype(float)
    weight = np.repeat(solid_angles(height, 2 * height)[:half], 2 * height) * d[:, 2]
    return d, environment[:half].reshape(-1, 3) * weight[:, None]


def trace_ball(rig: Rig, ball: Ball, pixels: Array) -> tuple[Array, Array, Mask]:
    """Points on the ball and mirrored unit directions, both (..., 3), for photo pixels (..., 2).

    The mask says which pixels see the hemisphere at all; the rest is undefined.
    """
    ray = rig.rays(pixels, *ball.size)
    centre = np.asarray(ball.position)
    to_ball = centre - rig.camera
    b = ray @ to_ball
    discriminant = b * b - to_ball @ to_ball + ball.radius_m**2
    distance = b - np.sqrt(np.maximum(discriminant, 0))
    point = rig.camera + distance[..., None] * ray
    normal = (point - centre) / ball.radius_m
    mirrored = ray - 2 * np.sum(ray * normal, -1, keepdims=True) * normal
    return point, mirrored, (discriminant > 0) & (point[..., 2] >= 0)


def window(ball: Ball, margin: float = 4.0) -> tuple[slice, slice]:
    """Rows and columns of the photo that hold the ball."""
    (x, y), r = ball.centre, max(ball.ellipse[2:4]) + margin
    h, w = ball.size
    return (
        slice(max(0, math.floor(y - r)), min(h, math.ceil(y + r))),
        slice(max(0, math.floor(x - r)), min(w, math.ceil(x + r))),
    )


def pixel_grid(rows: slice, columns: slice, samples: int = 1) -> Array:
    """Positions (H·samples, W·samples, 2) evenly within the pixels of a window."""
    y = rows.start + (np.arange((rows.stop - rows.start) * samples) + 0.5) / samples
    x = columns.start + (np.arange((columns.stop - columns.start) * samples) + 0.5) / samples
    return np.stack(np.broadcast_arrays(x[None, :], y[:, None]), -1)


def sample_image(image: Array, pixels: Array, origin: tuple[int, int] = (0, 0)) -> Array:
    """Bilinear look-ups (..., C) at pixels (..., 2); the image starts at ``origin`` (row, col)."""
    at = np.stack([pixels[..., 1] - origin[0] - 0.5, pixels[..., 0] - origin[1] - 0.5])
    planes = image[..., None] if image.ndim == 2 else image
    out = [
        ndimage.map_coordinates(planes[..., c], at, order=1, mode="nearest")
        for c in range(planes.shape[-1])
    ]
    return np.stack(out, -1) if image.ndim == 3 else out[0]


def screen_mask(rig: Rig, ball: Ball, margin: float) -> tuple[Array, tuple[slice, slice]]:
    """1 where the ball's image shows the screen, grown by ``margin`` pixels; and its window."""
    rows, columns = area = window(ball)
    point, mirrored, seen = trace_ball(rig, ball, pixel_grid(rows, columns))
    _, _, hit = screen_coordinates(rig, point, mirrored)
    distance = ndimage.distance_transform_edt(~(hit & seen))
    # The edge of the mask's pixels lies half a pixel outside their centres.
    return np.asarray(distance <= margin + 0.5, np.float32), area


def lift_veil(photo: Photo, rig: Rig, ball: Ball) -> Photo:
    """The photo without the glare that veils a part of the ball, if there is one.

    Between horizon and outline the ball mirrors the table, which the photo shows as well: what it
    shows more than that, over and over, is no image. That is fitted by a Gaussian in the photo with
    a colour of its own (least squares with Cauchy's loss), and taken from the whole ball where it
    explains the difference. A veil that ends before the horizon stays unseen.
    """
    area = rows, columns = window(ball)
    pixels = pixel_grid(rows, columns)
    point, mirrored, seen = trace_ball(rig, ball, pixels)
    table = point - mirrored * (point[..., 2:] / np.minimum(mirrored[..., 2:], -1e-3))
    at = rig.project(table, *ball.size)
    far = np.linalg.norm((table - np.asarray(ball.position))[..., :2], axis=-1)
    use = seen & (mirrored[..., 2] < -0.02) & (far > BARE * ball.radius_m)
    use &= (at > 1).all(-1) & (at < np.array(ball.size[::-1]) - 1).all(-1)
    # The sample may shine, and so look different from there.
    use &= ~(np.abs(table[..., :2]) < 0.51 * rig.sample_size).all(-1) & ~photo.clipped[area]
    mirror = np.asarray(rig.ball_reflectance)
    extra = photo.image[area][use] - mirror * sample_image(photo.image, at[use])
    spread = 1.48 * float(np.median(np.abs(extra))) if use.any() else 0.0
    if not spread > 0:
        return photo
    inside, outside = ((p - ball.centre) / ball.radius for p in (pixels, at[use]))

    def veil(p: Array, place: Array) -> Array:
        return np.asarray(np.exp(-((place - p[:2]) ** 2).sum(-1) / p[2] ** 2)[..., None] * p[3:])

    def off(p: Array) -> Array:
        seen = veil(p, inside[use]) - mirror * veil(p, outside)
        return np.asarray((seen - extra / spread).ravel())

    def cost(p: Array) -> float:
        return float(np.log1p(off(p) ** 2).sum())

    starts = []
    for angle in np.arange(12) * (math.pi / 6):
        start = np.array([math.cos(angle), math.sin(angle), 0.4, 0, 0, 0])
        near = ((inside[use] - start[:2]) ** 2).sum(-1) < 0.4**2
        if near.any():
            start[3:] = np.maximum(np.median(extra[near], 0) / spread, 0)
            starts.append(start)
    if not starts:
        return photo
    bounds = [-2, -2, 0.1, 0, 0, 0], [2, 2, 1, np.inf, np.inf, np.inf]
    start = min(starts, key=cost)
    p = optimize.least_squares(off, start, bounds=bounds, loss="cauchy", ftol=1e-6).x
    strength = veil(p, inside).sum(-1)
    # Nor is it believed where it would be stronger than anywhere it can be seen.
    sky = seen & (mirrored[..., 2] > 0)
    if not cost(p) < VEILED * cost(p * [1, 1, 1, 0, 0, 0]) or (
        strength[sky].max(initial=0) > strength[use].max()
    ):
        return photo
    image = photo.image.copy()
    lifted = np.maximum(image[area] - veil(p, inside) * spread, 0)
    image[area] = np.where(photo.clipped[area][..., None], image[area], lifted)
    return replace(photo, image=image)


def unfold_environment(
    photo: Photo, rig: Rig, ball: Ball, height: int = 128, samples: int = 4, blur: float = 0.0
) -> tuple[Array, Array]:
    """The environment as the ball shows it: radiance (H, 2H, 3) and coverage (H, 2H) in [0, 1].

    Each texel averages samples² directions; for each the point of the ball that mirrors it into
    the camera is found and the photo looked up there. Coverage is the share of a texel that is
    above the horizon and not behind the screen; radiance is the mean over that share. The mirror's
    reflectance is divided out. ``blur``: the camera's, in pixels; as far as it spreads the screen's
    light, the room beside it counts as hidden.
    """
    mask, (rows, columns) = screen_mask(rig, ball, SCREEN_MARGIN + MARGIN_BLURS * blur)
    origin = (rows.start, columns.start)
    half = height // 2
    wanted = directions(samples * height, 2 * samples * height)[: half * samples].astype(float)
    centre = np.asarray(ball.position)
    normal = mirror_normals(rig, centre, ball.radius_m, wanted, False)
    pixels = rig.project(centre + ball.radius_m * normal, *ball.size)
    free = sample_image(mask, pixels, origin) < 0.01
    light = sample_image(photo.image[rows, columns], pixels, origin) * free[..., None]

    def pool(a: Array) -> Array:
        return a.reshape(half, samples, 2 * height, samples, -1).sum((1, 3))

    count = pool(free.astype(np.float32))
    environment = np.zeros((height, 2 * height, 3), np.float32)
    coverage = np.zeros((height, 2 * height), np.float32)
    environment[:half] = pool(light) / np.maximum(count, 1) / np.asarray(rig.ball_reflectance)
    coverage[:half] = count[..., 0] / samples**2
    return environment, coverage


def fill_environment(environment: Array, coverage: Array) -> Array:
    """Fill the upper hemisphere where coverage is nil, smoothly from what surrounds the gap.

    Harmonic on the sphere (Laplace's equation with the seen texels as its boundary), in the
    logarithm of the radiance, so that a lamp beside the screen does not spread behind it. The lower
    hemisphere is left as it is.
    """
    height, width = coverage.shape
    half = height // 2
    hole = coverage[:half] <= 0
    if not hole.any():
        return environment
    if hole.all():
        raise InputError("the mirror ball shows nothing but the screen: check the rig's sizes")
    known = environment[:half][~hole]
    floor = np.maximum(known.mean(0) * 1e-3, 1e-9)
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
        (r - 1, c, side_up[r] * step_u / step_v),  # nought at the zenith
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
    filled[:half].reshape(-1, 3)[unknown] = np.exp(solution)
    return filled


def unfold_pattern(photo: Photo, rig: Rig, ball: Ball, size: int = 256, samples: int = 1) -> Array:
    """The screen as the ball shows it, (size, size, 3) radiance, row 0 at +y, column 0 at -x.

    For each point of the screen the point of the ball that mirrors it into the camera, near field.
    """
    rows, columns = window(ball)
    n = size * samples
    s = (np.arange(n) + 0.5) / n
    e_x, e_y = rig.screen_edges
    target = rig.screen_corner + s[None, :, None] * e_x + (1 - s)[:, None, None] * e_y
    centre = np.asarray(ball.position)
    normal = mirror_normals(rig, centre, ball.radius_m, target, True)
    pixels = rig.project(centre + ball.radius_m * normal, *ball.size)
    light = sample_image(photo.image[rows, columns], pixels, (rows.start, columns.start))
    light = light.reshape(size, samples, size, samples, 3).mean((1, 3))
    return (light / np.asarray(rig.ball_reflectance)).astype(np.float32)
