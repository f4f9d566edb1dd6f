"""Where the sample lies in one photo against another: turned by any angle, and shifted.

Both photos show it under other lights, so that only what these leave is compared: the logarithm of
the radiance about its local mean and over its local spread, for texture; and the size of its
gradients likewise, for relief, whose flanks are bright in one photo and dark in the other. The
turn and the shift are those of the greatest correlation (by FFT), with a prior on shifts, since
textures repeat.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from invrender.capture.crop import crop_part, in_photo
from invrender.files.images import Photo
from invrender.rig import Rig
from invrender.sampling import parabola_top
from invrender.types import TINY, Array, Mask


@dataclass(frozen=True)
class PlacementSettings:
    """Numbers of the comparison, chosen by hand; lengths in halves of the image's
    side."""

    turn_side: int = 64  # pixels a side of the crops by which a turn is found
    shift_side: int = 96  # and a shift
    wide: float = 1.25  # sides of the square that are compared: a sample's border is seen
    local: float = 0.12  # deviation of the Gaussian that means are taken with
    fine: float = 0.012  # and of the one that noise is smoothed with
    floor: float = 0.3  # of the spread over the image, that a local one has at least
    circle: float = 0.95  # radius of what is compared of a turned sample
    angles: int = 72  # that are tried
    finer: tuple[float, ...] = (2.0, 0.7)  # degrees: steps about the best one, one to each side
    farthest: float = 0.35  # shift
    least_shift: float = 0.02  # smaller ones are left to `invrender.refine.registration`
    usual: float = 0.2  # shift that takes `doubt` from the correlation
    doubt: float = 0.05
    least: float = 0.15  # correlation of what belongs together
    clearly: float = 0.08  # by how much a turned sample must be more alike
    blurs: tuple[float, ...] = (5.0, 2.5, 1.0)  # pixels, one alignment after another
    steps: int = 60  # of each, at most
    settled: float = 1e-5  # gain of the correlation below which they end
    dark: float = 0.01  # of the mean radiance, below which nothing counts
    askew: float = 0.2  # most that it moves a corner


PLACEMENT = PlacementSettings()


def find_place(photos: tuple[Photo, Photo], rigs: tuple[Rig, Rig]) -> tuple[Array, float]:
    """Where a photo shows the square of the sample that another one shows: a homography (3, 3) from
    that square, [-1, 1]², x right and y up, to its own, of a turn and a shift; and how alike both
    are there.

    photos, rigs: this one's and the other's, each with the camera as it was found.
    """
    s = PLACEMENT
    upright = [crop_part(p, r, s.turn_side) for p, r in zip(photos, rigs, strict=True)]
    turn = find_turn(upright[0], upright[1])
    c, d = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    place = np.array([[c, -d, 0], [d, c, 0], [0, 0, 1]])
    wide = np.diag([s.wide, s.wide, 1.0])
    if turn:  # the table has not turned with it
        wide = np.eye(3)
    parts = place @ wide, wide
    crops = [
        crop_part(p, r, s.shift_side, h, around=True)
        for p, r, h in zip(photos, rigs, parts, strict=True)
    ]
    seen = [in_photo(p, r, s.shift_side, h) for p, r, h in zip(photos, rigs, parts, strict=True)]
    shift, alike = find_shift(crops[0], crops[1], (seen[0], seen[1]))
    if np.hypot(*shift) > s.least_shift:
        place[:2, 2] = place[:2, :2] @ shift * wide[0, 0]
    # Where the square was missed, the camera is a degree or two off, which fine texture hides.
    crops[0] = crop_part(photos[0], rigs[0], s.shift_side, place @ wide, around=True)
    askew = find_askew(crops[0], crops[1])
    if askew is not None:
        straight = place @ wide @ askew @ np.linalg.inv(wide)
        again = crop_part(photos[0], rigs[0], s.shift_side, straight @ wide, around=True)
        windows = (seen[1].astype(np.float32),) * 2
        better = best_shift(features(again, s), features(crops[1], s), windows, s)[0]
        if better > alike + s.clearly:
            return straight / straight[2, 2], better
    return place, alike


def find_askew(image: Array, first: Array, s: PlacementSettings = PLACEMENT) -> Array | None:
    """The homography (3, 3) from the square, [-1, 1]², of ``first`` to that of ``image`` by which
    they correlate most (ECC, Evangelidis and Psarakis 2008); None where they have little in common
    or it is far off. A sample's border is what it finds where the texture is fine."""
    import cv2

    n = len(first)
    pixels = np.array([[n / 2, 0, n / 2 - 0.5], [0, -n / 2, n / 2 - 0.5], [0, 0, 1]])
    warp: Any = np.eye(3, dtype=np.float32)
    logs = [np.log(x.mean(-1) + s.dark * float(x.mean()) + TINY) for x in (first, image)]
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, s.steps, s.settled)
    for blur in s.blurs:
        there, here = (
            ndimage.gaussian_gradient_magnitude(x, blur, mode="nearest").astype(np.float32)
            for x in logs
        )
        try:
            warp = cv2.findTransformECC(there, here, warp, cv2.MOTION_HOMOGRAPHY, stop)[1]
        except cv2.error:  # it does not converge
            return None
    place = np.linalg.inv(pixels) @ warp @ pixels
    corners = np.array([[1, 1, 1], [1, -1, 1], [-1, 1, 1], [-1, -1, 1]]) @ place.T
    moved = corners[:, :2] / corners[:, 2:] - [[1, 1], [1, -1], [-1, 1], [-1, -1]]
    return place if np.abs(moved).max() < s.askew else None


def find_turn(image: Array, first: Array, s: PlacementSettings = PLACEMENT) -> float:
    """Degrees, counter-clockwise, by which the sample lies turned against another photo's.

    image, first: (N, N, 3) crops of the square. Nought where no turn is clearly better.
    """
    here, there = features(image, s), features(first, s)
    window = (_circle(len(image), s),) * 2
    step = 360 / s.angles
    angles = step * np.arange(s.angles)
    scores = [best_shift(_turned(here, a), there, window, s)[0] for a in angles]
    best, score = float(angles[int(np.argmax(scores))]), max(scores)
    straight = max(scores[k] for k in (-1, 0, 1))
    if score < max(straight + s.clearly, s.least):
        return 0.0
    for finer in s.finer:
        tried = [best - finer, best, best + finer]
        best = tried[
            int(np.argmax([best_shift(_turned(here, a), there, window, s)[0] for a in tried]))
        ]
    return (best + 180) % 360 - 180


def find_shift(
    image: Array, first: Array, seen: tuple[Mask, Mask], s: PlacementSettings = PLACEMENT
) -> tuple[Array, float]:
    """Shift (x right, y up) in halves of the side by which ``image`` shows what ``first`` does, and
    the correlation; no shift where nothing belongs together. seen: which pixels of both count."""
    windows = seen[0].astype(np.float32), seen[1].astype(np.float32)
    score, shift = best_shift(features(image, s), features(first, s), windows, s)
    return (shift if score >= s.least else np.zeros(2)), score


def features(image: Array, s: PlacementSettings) -> Array:
    """Texture and relief (2, N, N), each of about unit spread."""
    unit = len(image) / 2
    mean = float(image.mean()) + TINY
    log = np.log(np.maximum(image.mean(-1), 0) + 1e-2 * mean)
    log = ndimage.gaussian_filter(log, s.fine * unit, mode="nearest")
    down, right = np.gradient(log)
    size = np.log(np.hypot(down, right) + 0.1 * (np.hypot(down, right).mean() + TINY))
    return np.stack([_levelled(log, s), _levelled(size, s)])


def _levelled(image: Array, s: PlacementSettings) -> Array:
    """An image about its local mean, over its local spread."""
    width = s.local * len(image) / 2
    rest = image - ndimage.gaussian_filter(image, width, mode="nearest")
    spread = ndimage.gaussian_filter(rest * rest, width, mode="nearest")
    least = s.floor**2 * float(np.mean(rest * rest)) + TINY
    return np.asarray(rest / np.sqrt(spread + least), np.float32)


def _circle(side: int, s: PlacementSettings) -> Array:
    x = (np.arange(side) + 0.5) / side * 2 - 1
    return (np.hypot(x[:, None], x) < s.circle).astype(np.float32)


def _turned(features: Array, degrees: float) -> Array:
    """Features of the image turned clockwise."""
    return np.stack(
        [ndimage.rotate(f, -degrees, reshape=False, order=1, mode="nearest") for f in features]
    )


def best_shift(
    here: Array, there: Array, windows: tuple[Array, Array], s: PlacementSettings
) -> tuple[float, Array]:
    """The greatest correlation, less what a far shift costs, and the shift."""
    side = here.shape[-1]
    reach = int(s.farthest * side / 2)
    shape = (2 * side, 2 * side)

    def spectrum(x: Array) -> Any:
        return np.fft.rfft2(x, shape)

    def crossed(a: Any, b: Any) -> Array:
        """Sums over the overlap by shift, (2·reach + 1)², of b against a."""
        full = np.fft.irfft2(a * np.conj(b), shape)
        return np.roll(full, (reach, reach), (-2, -1))[..., : 2 * reach + 1, : 2 * reach + 1]

    u, v = (spectrum(w) for w in windows)
    product = crossed(spectrum(here * windows[0]), spectrum(there * windows[1]))
    own = crossed(spectrum(here**2 * windows[0]), v), crossed(u, spectrum(there**2 * windows[1]))
    norm = np.sqrt(np.maximum(own[0], TINY) * np.maximum(own[1], TINY))
    k = (np.arange(2 * reach + 1) - reach) / (side / 2)
    far = (k[:, None] ** 2 + k**2) / s.usual**2
    score = (product / norm).mean(0) - s.doubt * far
    i, j = divmod(int(np.argmax(score)), score.shape[1])
    row = k[i] + parabola_top(score[:, j], i) / (side / 2)
    column = k[j] + parabola_top(score[i], j) / (side / 2)
    return float(score[i, j]), np.array([column, -row])
