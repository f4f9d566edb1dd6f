"""Lamps that a photo clips, and a screen of doubtful gain, as bright as the table says they are.

A clipped pixel says only that there was at least so much light. But room and screen light the
table as well, and the screen's share of that, whose radiance the ball shows, has a shape and
colours of its own: the brighter the room, the flatter and less coloured the table's shading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize

from invrender.capture.ball_image import BallImage
from invrender.capture.environment import unfold_environment
from invrender.capture.response import curve_exponent
from invrender.capture.robust import cauchy_residuals, spread
from invrender.capture.settings import CLIPPED_LAMPS, TABLE_METER
from invrender.capture.table import distant_pairs, lit_table, room_irradiance
from invrender.colour import AXES
from invrender.files.images import Photo
from invrender.lights import Device
from invrender.rig import Rig, squared_distance
from invrender.types import TINY, Array, Mask


def clipped_light(
    photo: Photo, rig: Rig, image: BallImage, height: int, blur: float = 0.0,
    white: Array | None = None,
) -> Array:  # fmt: skip
    """(H, 2H, 3): what of the environment's radiance is clipped.

    A JPEG's colours are coarser than its brightness: of a small lamp of which some channel is
    clipped another may stay a little below white everywhere, and is as wrong.
    """
    area = image.area
    light = np.zeros(photo.image.shape, np.float32)
    if photo.clip_level is None or photo.image[area].max() < photo.clip_level:
        return np.zeros((height, 2 * height, 3), np.float32)
    pixels = photo.image[area]
    clipped = pixels >= photo.clip_level
    lamp, count = ndimage.label(clipped.any(-1))
    channels = np.zeros((count + 1, 3), bool)
    np.logical_or.at(channels, lamp, clipped)
    hidden = ~channels[lamp] & (lamp > 0)[..., None]
    clipped |= hidden & (pixels >= CLIPPED_LAMPS.beside * photo.clip_level)
    light[area] = pixels * clipped
    return unfold_environment(Photo(light), rig, image, height, blur, white)[0]


@dataclass(frozen=True)
class Raised:
    """What `raise_clipped` finds.

    environment: (H, 2H, 3), with the clipped texels raised ``factor`` times, in the channels' mean;
    gain: factor (3,) on the screen's; lamps: what of the environment is raised light, if any;
    deviation: of the logarithm of that light.
    """

    environment: Array
    factor: float
    gain: Array
    lamps: Array | None
    deviation: float


def raise_clipped(
    photo: Photo, rig: Rig, image: BallImage, screen: tuple[Array, Array, Device],
    environment: Array, gain_deviation: float = 0.0, blur: float = 0.0,
) -> Raised:  # fmt: skip
    """The filled environment (H, 2H, 3) with its clipped texels raised, and the screen's gain.

    The screen: pattern (h, w, 3), gain (3,) and display; ``gain_deviation`` is that of the
    logarithm of its gain, by the ball. One factor per channel is found for all clipped texels, and
    where the gain is in doubt one for the screen, the most probable ones under log-normal priors
    and a Lambertian table: the logarithms of its radiance some way apart are compared, robustly
    (Cauchy), since textures, papers and shadows have edges, and colour apart from brightness, which
    varies more. That the screen shades the table from the clipped lamps counts too. 1 where nothing
    is clipped, and where the gain is known.
    """
    white = screen[1] if rig.has_screen else None
    clipped = clipped_light(photo, rig, image, len(environment), blur, white)
    doubted = gain_deviation > CLIPPED_LAMPS.known_gain
    if not (clipped.any() or doubted):
        return Raised(environment, 1.0, np.ones(3), None, 0.0)
    seen, at, use, lit, room = lit_table(photo, rig, image.ball, screen, environment)
    aside = squared_distance(rig.project(at, photo.height, photo.width), photo.height, photo.width)
    power = curve_exponent(photo)
    lamplight = room_irradiance(rig, at, clipped)
    factors = _Factors(seen, use, lit, room, lamplight, aside, power)
    doubt = CLIPPED_LAMPS.gain_doubt * gain_deviation if doubted else 0.0
    x, y, camera, deviation = factors.fit(doubt)
    if doubted:  # textures, and a lamp that the screen hides, spoil the table's word
        told = factors.spread(x, y, camera).max() < CLIPPED_LAMPS.plain
        # What is saturated hides how bright it is, not that it is as bright as that.
        least, most = (CLIPPED_LAMPS.likely_gain * d for d in (-gain_deviation, doubt))
        if not (told and least < y.mean() < most):
            x, y, _, deviation = factors.fit(0.0)
    factor, gain = np.exp(x), np.exp(y)
    raised = environment + clipped * (factor - 1).astype(np.float32)
    lamps = np.minimum(clipped * factor, raised).astype(np.float32) if clipped.any() else None
    return Raised(np.asarray(raised, np.float32), float(factor.mean()), gain, lamps, deviation)


class _Factors:
    """Logarithms of the clipped light's factor and of the screen's, (3,) each, by the table.

    ``seen``: log radiance of the used blocks (n, 3); irradiance is
    factor·``lit`` + ``room`` + (factor - 1)·``lamps``. What a tone curve leaves, a power of light
    that deviates from 1 by ``power``, and what the lens loses with the distances ``aside`` (n,) are
    found as well: else the room's light or the screen's would stand for them.
    """

    def __init__(
        self, seen: Array, use: Mask, lit: Array, room: Array, lamps: Array, aside: Array,
        power: float,
    ) -> None:  # fmt: skip
        self.lit, self.room, self.lamps = lit, room, lamps
        self.aside = aside[:, None] * np.ones(3)
        self.camera = np.array([max(power, CLIPPED_LAMPS.least_power), CLIPPED_LAMPS.vignetting])
        apart = distant_pairs(use)
        self.pairs = [pair for pair, _ in apart]
        # Textures are alike over several blocks: so many pairs count as one.
        self.weights = [1 / lag for _, lag in apart]
        self.wanted = self._steps(seen)

    def _steps(self, log: Array) -> list[Array]:
        return [(log[i] - log[j]) @ AXES for i, j in self.pairs]

    def errors(self, x: Array, y: Array, camera: Array) -> list[Array]:
        """Of each lag, (pairs, 3), along `AXES`. camera: the power less 1, and the lens's loss."""
        light = np.exp(y) * self.lit + self.room + np.expm1(x) * self.lamps
        log = (1 + camera[0]) * np.log(np.maximum(light, TINY)) - camera[1] * self.aside
        steps = self._steps(log)
        return [w - s for w, s in zip(self.wanted, steps, strict=True)]

    def spread(self, x: Array, y: Array, camera: Array) -> Array:
        """The errors' spread (3,) along `AXES`, the median lag's."""
        errors = self.errors(x, y, camera)
        spreads = [np.maximum(spread(e, 0), TABLE_METER.least_spread) for e in errors]
        return np.asarray(np.median(spreads, 0)) if spreads else np.full(3, math.inf)

    def fit(self, doubt: float) -> tuple[Array, Array, Array, float]:
        """The most probable ones, what the camera does (2,), and the deviation of the clipped
        light's, the channels' mean; the screen's stays where ``doubt``, its deviation, is 0."""
        free = np.array([self.lamps.any(), doubt > 0]).repeat(3)
        if not free.any():
            return np.zeros(3), np.zeros(3), np.zeros(2), 0.0
        free = np.append(free, [True, True])

        def whole(z: Array) -> tuple[Array, Array, Array]:
            every = np.zeros(8)
            every[free] = z
            return every[:3], every[3:6], every[6:]

        def start(factor: float) -> Array:
            return np.repeat([factor, 0.0, 0.0], (3, 3, 2))[free]

        def residuals(z: Array, scales: list[Array]) -> Array:
            x, y, camera = whole(z)
            parts = [camera / self.camera]
            if free[0]:
                parts.append(_about(x, CLIPPED_LAMPS.mean, CLIPPED_LAMPS.deviation,
                                    CLIPPED_LAMPS.channel_deviation))  # fmt: skip
            if free[3]:
                parts.append(_about(y, 0.0, doubt, doubt * CLIPPED_LAMPS.channel_doubt))
            for error, scale, weight in zip(
                self.errors(x, y, camera), scales, self.weights, strict=True
            ):
                parts.append((weight * cauchy_residuals(error / scale)).ravel())
            return np.concatenate(parts)

        least = np.repeat([0.0, -CLIPPED_LAMPS.greatest, -CLIPPED_LAMPS.greatest], (3, 3, 2))[free]
        z = start(CLIPPED_LAMPS.mean)
        for turn in range(3):
            scales = [
                np.maximum(spread(e, 0), TABLE_METER.least_spread) for e in self.errors(*whole(z))
            ]
            if turn == 0 and free[0]:  # the Cauchy loss has more than one minimum
                starts = [start(s) for s in np.linspace(*CLIPPED_LAMPS.starts)]
                z = min(starts, key=lambda s: float((residuals(s, scales) ** 2).sum()))
            inside = CLIPPED_LAMPS.inside
            z = np.clip(z, least + inside, CLIPPED_LAMPS.greatest - inside)
            bounds = (least, CLIPPED_LAMPS.greatest)
            found = optimize.least_squares(residuals, z, "3-point", bounds, args=(scales,))
            z = np.asarray(found.x)
        covariance = np.linalg.pinv(found.jac.T @ found.jac)
        deviation = math.sqrt(float(covariance[:3, :3].mean())) if free[0] else 0.0
        return *whole(z), deviation


def _about(x: Array, mean: float, deviation: float, channels: float) -> Array:
    """Residuals (4,) of a log-normal prior: of the channels' mean, and of each about that."""
    return np.array([(x.mean() - mean) / deviation, *((x - x.mean()) / channels)])
