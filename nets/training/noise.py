"""What lies between the light that is meant and what a photo and its mirror ball show of it.

On the screen: intensity, display curve, white balance, dimming to the sides, mixing. On the pattern
and the room as the ball shows them: mosaic, eroded borders, clipped lamps, a reflectance that is
not the mirror's. On the photo: blur, noise, clipping, what is left of a tone curve.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, zoom

from invrender.data.simulate_setup import RANGES
from invrender.lights import IDEAL, Device
from invrender.rig import Rig, lens_gain
from invrender.sphere import resample_environment
from invrender.types import Array
from nets.splitsum import area_resize

# Of displays as they are: the share of captures that have one. Standard deviations of what is found
# of its falloff's exponent, and of each share of its mixing; of the logarithm of the reflectance
# that a ball is believed to have, and of each channel's; of the shoulder that is left when a JPEG's
# tone curve is undone, and of the exponent where that is done badly; the shares of photos with such
# a curve, and with a lens whose dark corners nobody has undone. By hand, near what the captures of
# `python -m benchmarks device` have (docs/research-log/2026-11-30-what-is-left-of-a-camera.md).
REAL_DISPLAYS = 0.5
FALLOFF_ERROR, MIXING_ERROR = 0.1, 0.005
MIRROR_ERROR, MIRROR_TINT = 0.03, 0.01
TONED, SHOULDER_ERROR = 0.3, 0.05  # the share of photos first
BADLY_TONED, EXPONENT_ERROR = 0.4, 0.12
VIGNETTED, DARKEST_CORNER = 0.5, 0.2
TURNED = 0.4  # the share of rooms whose display shows the pattern in any orientation


def draw_devices(rng: np.random.Generator) -> tuple[Device, Device]:
    """(the display as the ball showed it, as it really is): dimming and mixing. Its curve, black
    and white are those of `draw_pattern` and `display`."""
    if rng.random() >= REAL_DISPLAYS:
        return IDEAL, IDEAL
    falloff = rng.uniform(RANGES["falloff"].low, RANGES["falloff"].high)
    total = rng.uniform(RANGES["mixing"].low, RANGES["mixing"].high, 3)
    others = 1 - np.eye(3)
    share = rng.uniform(0, 1, (3, 3)) * others
    mixing = share / share.sum(1, keepdims=True) * total[:, None]
    found = np.maximum(mixing + MIXING_ERROR * rng.standard_normal((3, 3)), 0) * others
    error = FALLOFF_ERROR * rng.standard_normal()
    return _device(max(falloff + error, 0.0), found), _device(falloff, mixing)


def _device(falloff: float, mixing: Array) -> Device:
    """Of mixing (3, 3) without its diagonal; white stays white."""
    m = mixing + np.diag(1 - mixing.sum(1))
    rows = [(float(a), float(b), float(c)) for a, b, c in m]
    return Device(float(falloff), mixing=(rows[0], rows[1], rows[2]))


def mirror_error(rng: np.random.Generator) -> Array:
    """(3,) factor of all light that the ball shows, where its reflectance is not what is believed.

    Half of the balls are known.
    """
    if rng.random() < 0.5:
        return np.ones(3, np.float32)
    error = MIRROR_ERROR * rng.standard_normal() + MIRROR_TINT * rng.standard_normal(3)
    return np.exp(error).astype(np.float32)


def draw_pattern(rng: np.random.Generator, pattern: Array) -> Array:
    """The pattern as a screen shows it whose curve and white balance the ball showed, at times
    turned as a tablet may be, or mirrored."""
    if rng.random() < TURNED:
        pattern = np.rot90(pattern, int(rng.integers(4)))
        pattern = pattern[:, ::-1] if rng.random() < 0.5 else pattern
    if rng.random() < 0.6:
        return pattern
    curve = 2.2 ** rng.uniform(-1, 1)
    return (pattern**curve * np.exp(np.log(1.25) * rng.uniform(-1, 1, 3))).astype(np.float32)


def display(rng: np.random.Generator, pattern: Array) -> Array:
    """What a real screen shows of a pattern: intensity, display curve, white balance."""
    shown = pattern * np.exp(0.3 * rng.standard_normal())
    if rng.random() < 0.7:
        shown = np.clip(shown, 0, None) ** np.exp(0.08 * rng.standard_normal())
        shown = shown * np.exp(0.06 * rng.standard_normal(3))
        shown = shown + rng.uniform(0, 0.01) * shown.max()  # black is never black
    return shown.astype(np.float32)


def fit_gain(shown: Array, pattern: Array, rng: np.random.Generator) -> Array:
    """The RGB gain that a user's software finds for what the screen shows: a little off, and more
    so at times, as from a small JPEG."""
    gain = (shown * pattern).sum((0, 1)) / np.maximum((pattern**2).sum((0, 1)), 1e-9)
    error = 0.01 if rng.random() < 0.65 else 0.06
    return gain * np.exp(error * (rng.standard_normal(3) + rng.standard_normal()))


def capture_pattern(rng: np.random.Generator, shown: Array) -> Array:
    """What the ball shows of the screen: a mosaic with eroded borders."""
    n = int(rng.integers(16, 64))
    small = area_resize(shown, n)
    if rng.random() < 0.5:
        border = np.ones((n, n, 1), np.float32)
        border[0] *= rng.uniform(0, 1)
        border[-1] *= rng.uniform(0, 1)
        border[:, 0] *= rng.uniform(0, 1)
        border[:, -1] *= rng.uniform(0, 1)
        small = small * border
    small = small * np.exp(0.02 * rng.standard_normal(small.shape))
    return np.asarray(zoom(small, (64 / n, 64 / n, 1), order=0, grid_mode=True, mode="nearest"))


def captured_environment(rng: np.random.Generator, env: Array, white: float) -> Array:
    """What the ball shows of the room: coarser, at times clipped, a little off in colour."""
    height = int(rng.choice([32, 48, 64]))
    seen = resample_environment(env, height)
    if rng.random() < 0.3:  # lamps brighter than the photo's white
        seen = np.minimum(seen, white * np.exp(rng.uniform(np.log(2), np.log(50))))
    error = 0.03 if rng.random() < 0.65 else 0.15
    seen = seen * np.exp(0.02 * rng.standard_normal(3)) * np.exp(error * rng.standard_normal())
    return resample_environment(seen.astype(np.float32), 64)


def lens_and_curve(rng: np.random.Generator, image: Array, rig: Rig) -> Array:
    """Radiance (H, W, 3) as some cameras have it still when everything known was undone: darker
    towards the photo's corners, and raised to a power."""
    if rng.random() < VIGNETTED:
        loss, aside = rng.uniform(0, DARKEST_CORNER), rig.lens_distance(*image.shape[:2])
        image = image / lens_gain(loss, aside)[..., None]
    if rng.random() < BADLY_TONED:
        middle = max(float(np.median(image)), 1e-8)
        image = middle * (image / middle) ** (1 + EXPONENT_ERROR * rng.standard_normal())
    return image


def sensor(rng: np.random.Generator, image: Array) -> Array:
    """A camera's noise, blur, clipping and tone curve on radiance (H, W, 3)."""
    if rng.random() < 0.5:
        image = gaussian_filter(image, (s := rng.uniform(0.2, 0.8), s, 0))
    top = np.percentile(image, 99.5) * np.exp(rng.uniform(np.log(0.8), np.log(8)))
    top = max(float(top), 1e-8)
    electrons = np.exp(rng.uniform(np.log(1500), np.log(60000)))
    read = np.exp(rng.uniform(np.log(2e-4), np.log(2e-3)))
    x = np.clip(image / top, 0, None)
    x = x + np.sqrt(x / electrons + read**2) * rng.standard_normal(image.shape)
    x = np.clip(x, 0, 1)
    if rng.random() < TONED:
        k = max(SHOULDER_ERROR * rng.standard_normal(), -0.5)
        x = (1 + k) * x / (1 + k * x)
    return (x * top).astype(np.float32)
