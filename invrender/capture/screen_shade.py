"""Lamps moved to where the edge of the screen's shadow on the sample says that they are.

A lamp's image in the ball is a few pixels wide, and unfolded it is spread over some texels and up
to one off. As far the screen's shadow is then wrong on the sample, and albedo makes up for it. The
photo shows the edge: its slopes are the shadow's and the sample's own, which know nothing of it. A
lamp's place and width are fitted to them, its light stays. An edge that the photo does not show
better than before moves nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage, optimize

from invrender.capture.crop import crop_part
from invrender.capture.near_lamp import Indices, connected
from invrender.capture.settings import SCREEN_SHADE, TABLE_METER
from invrender.capture.table import room_irradiance, screen_irradiance
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.rig import Rig
from invrender.sphere import resample_environment, sky_flux, solid_angles
from invrender.types import TINY, Array

Moved = tuple[Indices, Array]  # texels of a lamp, and the directions (m, 3) that they belong to


def place_lamps(photo: Photo, lights: Lights) -> Lights:
    """The lights with their lamps where the screen's shadow on the sample shows them, if it does.

    photo: in the lights' unit. The environment gets `SCREEN_SHADE.rows` rows where a lamp moves.
    """
    rig, side, few = lights.rig, SCREEN_SHADE.side, SCREEN_SHADE.coarse
    if not rig.has_screen:
        return lights
    d, flux = sky_flux(lights.environment)
    power, half = flux.mean(-1), len(lights.environment) // 2
    lamps = connected((power > SCREEN_SHADE.lamp * power.sum()).reshape(half, -1))
    lamps = [own for own in lamps if len(own) <= SCREEN_SHADE.texels]
    points = rig.sample_points(side, side).reshape(-1, 3)
    texel = np.pi / len(lights.environment)
    edges = [seen_past_edge(rig, points, d[own], texel) @ power[own] for own in lamps]
    if not edges:
        return lights
    rest = np.array(lights.environment)
    rest[:half].reshape(-1, 3)[np.concatenate(lamps)] = 0
    at = rig.sample_points(few, few).reshape(-1, 3)
    wide = room_irradiance(rig, at, resample_environment(rest, TABLE_METER.environment_rows))
    screen = lights.pattern, lights.gain, lights.device
    wide = wide + screen_irradiance(rig, at, screen, TABLE_METER.screen_cells)
    wide = wide.mean(-1).reshape(few, few)
    light = ndimage.zoom(wide, side / few, order=1, mode="nearest", grid_mode=True)
    light += np.sum(edges, 0).reshape(side, side)
    log = np.log(np.maximum(crop_part(photo, rig, side), TINY)).mean(-1)
    moved: list[Moved] = []
    for k in np.argsort([-np.ptp(edge) for edge in edges])[: SCREEN_SHADE.lamps]:
        own, edge = lamps[k], edges[k].reshape(side, side)
        if np.ptp(edge) > SCREEN_SHADE.least * light.mean():
            found = _fit(rig, points, log, light - edge, (d[own], power[own]), texel)
            if found is not None:
                moved.append((own, found[0]))
                light = light - edge + found[1]
    return _with_moved(lights, moved) if moved else lights


def seen_past_edge(rig: Rig, points: Array, d: Array, width: float) -> Array:
    """The share (n, m) of spots in directions d (m, 3), ``width`` radians wide to either side of
    their middle, that the screen does not hide from points (n, 3); tents, as the forward model's
    lamps are."""
    corner, (e_x, e_y) = rig.screen_body
    normal = np.cross(e_x, e_y) / np.linalg.norm(np.cross(e_x, e_y))
    cosine = np.maximum(d @ normal, SCREEN_SHADE.least_cosine)
    distance = ((corner - points) @ normal)[:, None] / cosine
    spot = distance * width / cosine
    hidden = np.ones_like(distance)
    for edge in (e_x, e_y):
        length = np.linalg.norm(edge)
        across = edge / length
        at = ((points - corner) @ across)[:, None] + distance * (d @ across)
        hidden *= _tent_below(at / spot) - _tent_below((at - length) / spot)
    return np.where(d @ normal > SCREEN_SHADE.least_cosine, 1 - hidden, 1)


def _tent_below(x: Array) -> Array:
    """The share below x of a tent over [-1, 1]."""
    x = np.clip(x, -1, 1)
    return np.where(x < 0, (1 + x) ** 2, 2 - (1 - x) ** 2) / 2


def _fit(
    rig: Rig, points: Array, log: Array, rest: Array, lamp: tuple[Array, Array], texel: float
) -> tuple[Array, Array] | None:
    """Directions of a lamp's texels and what it gives the sample (N, N), where the slopes of a
    logarithm of radiance (N, N) show its shadow; None where its place explains them no better.

    rest: irradiance (N, N) by all other light. lamp: its directions (m, 3) and their flux (m,).
    """
    d, flux = lamp
    lean = d[:, :2] / d[:, 2:]  # how far to the side for each metre up
    middle = flux @ lean / flux.sum()
    one = texel * (1 + middle @ middle)  # texel, as lean

    def light(p: Array) -> tuple[Array, Array]:
        """Of a lamp that is p[:2] texels elsewhere and exp(p[2]) as wide."""
        there = middle + p[:2] * one + np.exp(p[2]) * (lean - middle)
        way = np.column_stack([there, np.ones(len(there))])
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        seen = seen_past_edge(rig, points, way, texel * np.exp(p[2])) @ flux
        return way, seen.reshape(log.shape)

    def made(lamp: Array) -> Array:
        return _slopes(np.log(np.maximum(rest + lamp, TINY)))

    unmoved = light(np.zeros(3))[1]
    seen, found = _slopes(log), np.abs(made(unmoved)).max(0)
    reach = SCREEN_SHADE.reach * one * rig.screen_height / rig.sample_size * len(log)
    zone = ndimage.maximum_filter(found, 2 * int(reach) + 1) > SCREEN_SHADE.steep * found.max()
    seen = seen[:, zone]
    scale = float(np.median(np.abs(seen))) + TINY  # of the sample's own slopes
    doubts = np.array([SCREEN_SHADE.shift, SCREEN_SHADE.shift, SCREEN_SHADE.width])

    def left(lamp: Array) -> Array:
        """Whose squares are the slopes that a shadow leaves, beyond ``scale`` as they are."""
        slopes = (seen - made(lamp)[:, zone]).ravel() / scale
        return np.asarray(np.sqrt(2 * (np.hypot(1, slopes) - 1)))

    def residuals(p: Array) -> Array:
        return np.concatenate([left(light(p)[1]), p / doubts])

    sides = (-SCREEN_SHADE.shift, 0, SCREEN_SHADE.shift)
    starts = [np.array([x, y, SCREEN_SHADE.narrower]) for x in sides for y in sides]
    start = min(starts, key=lambda p: (residuals(p) ** 2).sum())
    best = optimize.least_squares(
        residuals, start, diff_step=SCREEN_SHADE.step, max_nfev=SCREEN_SHADE.rounds
    )
    # As it is, or no edge at all.
    others = min((left(lamp) ** 2).sum() for lamp in (unmoved, unmoved.mean()))
    return light(best.x) if 2 * best.cost < SCREEN_SHADE.better * others else None


def _slopes(image: Array) -> Array:
    """Down and to the right (2, N, N)."""
    return np.stack(np.gradient(ndimage.gaussian_filter(image, SCREEN_SHADE.smooth)))


def _with_moved(lights: Lights, moved: list[Moved]) -> Lights:
    """The lights with the radiance of lamps' texels in other directions."""
    rows = max(SCREEN_SHADE.rows, len(lights.environment))

    def elsewhere(environment: Array) -> Array:
        left, angle = np.array(environment), solid_angles(*environment.shape[:2])
        sky = left[: len(left) // 2].reshape(-1, 3)
        powers = [sky[own] * angle[own // left.shape[1], None] for own, _ in moved]
        sky[np.concatenate([own for own, _ in moved])] = 0
        fine = resample_environment(left, rows)
        for power, (_, way) in zip(powers, moved, strict=True):
            _splat(fine, way, power)
        return fine

    lamps = None if lights.lamps is None else elsewhere(lights.lamps)
    coverage = lights.coverage
    if coverage is not None:
        coverage = resample_environment(coverage[..., None].repeat(3, -1), rows)[..., 0]
    return replace(
        lights, environment=elsewhere(lights.environment), lamps=lamps, coverage=coverage
    )


def _splat(environment: Array, d: Array, power: Array) -> None:
    """Add light of some power (m, 3), radiance times solid angle, from directions d (m, 3), to the
    four texels about each; in place."""
    rows = len(environment)
    x = np.arctan2(d[:, 1], d[:, 0]) % (2 * np.pi) * (rows / np.pi) - 0.5
    y = np.clip(np.arccos(np.clip(d[:, 2], -1, 1)) * (rows / np.pi) - 0.5, 0, rows - 1)
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    angle = solid_angles(rows, 2 * rows)
    for down in (0, 1):
        for right in (0, 1):
            r = np.minimum(row + down, rows - 1)
            share = np.abs(1 - down - (y - row)) * np.abs(1 - right - (x - column))
            light = power * (share / angle[r])[:, None]
            np.add.at(environment, (r, (column + right) % (2 * rows)), light)
