"""The ball's shadow on the sample, undone: a lamp that stands low throws it there.

The forward model has no ball. But where the ball is and what light comes from behind it is known,
and with it the shadow. How much of it the photo really shows, and how sharp, is fitted: the photo's
slopes are the shadow's and the sample's own, which know nothing of it. A shadow that the photo does
not show is not undone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from invrender.capture.crop import crop_part
from invrender.capture.mirror import Ball
from invrender.capture.near_lamp import Indices, connected
from invrender.capture.settings import BALL_SHADE, TABLE_METER
from invrender.capture.table import points_seen, seen_past_screen
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.rig import Rig, screen_middles
from invrender.sampling import resize_pattern
from invrender.sphere import resample_environment, sky_flux
from invrender.types import TINY, Array, Mask


def without_ball_shade(photo: Photo, lights: Lights, ball: Ball) -> Photo:
    """The photo with the sample as it were without the ball's shadow; what is saturated stays so.

    photo: in the lights' unit.
    """
    rig, side, few = lights.rig, BALL_SHADE.side, BALL_SHADE.coarse
    d, flux = sky_flux(lights.environment)
    lamp = flux.mean(-1) > BALL_SHADE.lamp * flux.mean(-1).sum()
    texel = np.pi / len(lights.environment)
    # Only the shadows of lamps are sharp.
    points = rig.sample_points(few, few).reshape(-1, 3)
    wide = _room_light(lights, ball, points, lamp) + _screen_light(lights, ball, points)
    whole = wide + _light(rig, ball, points, d[lamp], flux[lamp], texel)
    if _lost(whole).max() < BALL_SHADE.least:
        return photo
    zoom = (1, side / few, side / few, 1)
    wide = wide.reshape(2, few, few, 3)
    wide = ndimage.zoom(wide, zoom, order=1, mode="nearest", grid_mode=True)
    points = rig.sample_points(side, side).reshape(-1, 3)
    log = np.log(np.maximum(crop_part(photo, rig, side), TINY)).mean(-1)
    lamps = connected(lamp.reshape(len(lights.environment) // 2, -1))
    best, least = None, BALL_SHADE.most_left
    for spread in BALL_SHADE.spreads:
        towards = _narrowed(d, flux.mean(-1), lamps, spread)[lamp]
        sharp = _light(rig, ball, points, towards, flux[lamp], spread * texel)
        shade = np.log(np.maximum(1 - _lost(wide + sharp.reshape(wide.shape)), BALL_SHADE.darkest))
        strength, left = _fit(log, shade.mean(-1))
        if BALL_SHADE.weakest < strength < BALL_SHADE.strongest and left < least:
            best, least = strength * shade, left
    return photo if best is None else _without(photo, rig, best)


# Light below is (2, n, 3): the irradiance of points that face up, and the part that the ball takes.


def _lost(light: Array) -> Array:
    """The share that the ball takes."""
    return np.asarray(light[1] / np.maximum(light[0], TINY))


def _light(rig: Rig, ball: Ball, points: Array, d: Array, flux: Array, width: float) -> Array:
    """From directions d (m, 3) that send ``flux`` (m, 3) from spots ``width`` radians wide, where
    the screen does not hide them."""
    out = np.empty((2, len(points), 3))
    for band, seen in seen_past_screen(rig, points, d):
        out[0, band] = seen @ flux
        out[1, band] = (seen * _behind(ball, points[band], d, width)) @ flux
    return out


def _room_light(lights: Lights, ball: Ball, points: Array, lamp: Mask) -> Array:
    """From the room but for its lamps."""
    room, rows = np.array(lights.environment), TABLE_METER.environment_rows
    room[: len(room) // 2].reshape(-1, 3)[lamp] = 0
    d, flux = sky_flux(resample_environment(room, rows))
    return _light(lights.rig, ball, points, d, flux, np.pi / rows)


def _screen_light(lights: Lights, ball: Ball, points: Array) -> Array:
    """From the screen."""
    rig, cells = lights.rig, TABLE_METER.screen_cells
    if not rig.has_screen:
        return np.zeros((2, len(points), 3))
    light = resize_pattern(lights.shown, cells) * lights.gain
    cosines = rig.screen_cosines(points, cells, lights.device.falloff)
    way = screen_middles(rig, cells) - points[:, None]
    distance = np.linalg.norm(way, axis=-1, keepdims=True)
    width = rig.screen_sides[0] / cells / distance[..., 0]
    behind = _behind(ball, points, way / distance, width).reshape(cosines.shape)
    return np.einsum("anij,ijc->anc", np.stack([cosines, cosines * behind]), light)


def _behind(ball: Ball, points: Array, d: Array, width: float | Array) -> Array:
    """The share (n, m) of spots in directions d, (m, 3) or (n, m, 3), that the ball hides."""
    to = np.asarray(ball.position) - points
    distance = np.linalg.norm(to, axis=-1, keepdims=True)
    to = to / distance
    cosine = to @ d.T if d.ndim == 2 else np.einsum("ni,nmi->nm", to, d)
    inside = np.arcsin(np.clip(ball.radius_m / distance, 0, 1)) - np.arccos(np.clip(cosine, -1, 1))
    return np.clip(inside / width + 0.5, 0, 1)


def _narrowed(d: Array, flux: Array, lamps: list[Indices], spread: float) -> Array:
    """Directions (m, 3) of the sky's texels, those of each lamp drawn towards its middle."""
    out = np.array(d)
    for own in lamps:
        middle = flux[own] @ d[own] / flux[own].sum()
        out[own] = middle + spread * (d[own] - middle)
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def _fit(log: Array, shade: Array) -> tuple[float, float]:
    """How strongly a shade (N, N), a logarithm, stands in a logarithm of radiance, and the share of
    that one's slopes that is left without it, both where the shade's are steep."""
    seen, made = (
        np.stack(np.gradient(ndimage.gaussian_filter(a, BALL_SHADE.smooth))) for a in (log, shade)
    )
    use = np.abs(made) > BALL_SHADE.steep * np.abs(made).max()
    seen, made = seen[use], made[use]
    # The sum of absolute values is least: the sample's own slopes are outliers.
    strength, weight = 1.0, np.ones_like(made)
    for _ in range(BALL_SHADE.rounds):
        strength = float((weight * seen * made).sum() / max((weight * made * made).sum(), TINY))
        weight = 1 / (np.abs(seen - strength * made) + BALL_SHADE.steep * np.abs(made) + TINY)
    left = np.abs(seen - strength * made).sum() / max(np.abs(seen).sum(), TINY)
    return strength, float(left)


def _without(photo: Photo, rig: Rig, shade: Array) -> Photo:
    """The photo over exp(shade), a logarithm (N, N, 3) on the sample's square."""
    h, w = photo.height, photo.width
    corners = rig.project(rig.sample_corners, h, w)
    x0, y0 = np.clip(np.floor(corners.min(0)).astype(int), 0, [w, h])
    x1, y1 = np.clip(np.ceil(corners.max(0)).astype(int), 0, [w, h])
    pixels = np.stack(np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5), -1)
    points, down = points_seen(rig, pixels, h, w)
    at = points[..., :2] / rig.sample_size
    inside = down & (np.abs(at) < 0.5).all(-1)
    n = len(shade)
    place = np.stack([(0.5 - at[..., 1]) * n - 0.5, (at[..., 0] + 0.5) * n - 0.5])[:, inside]
    image = np.array(photo.image)
    part = image[y0:y1, x0:x1]
    for c in range(3):
        own = ndimage.map_coordinates(shade[..., c], place, order=1, mode="nearest")
        part[inside, c] *= np.exp(-own)
    return replace(photo, image=image)
