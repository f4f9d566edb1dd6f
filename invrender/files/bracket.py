"""A bracket: several exposures of one set-up, held by hand, as one photo of linear radiance.

The photos are laid over the shortest exposure by a homography (Evangelidis and Psarakis's ECC, in
OpenCV), and their common tone curve is found from what all of them show, with the exposures' ratios
where EXIF does not tell them: linear least squares for the logarithms, as Debevec and Malik (1997)
do it, of robust means. Then every pixel is the mean of the exposures that are neither saturated
nor dark there, weighted by exposure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy import ndimage

from invrender.files.images import Photo
from invrender.files.tone_curves import FIXED, KNOTS, curve_prior
from invrender.sampling import knot_shares
from invrender.types import Array, InputError, Mask, Notice


@dataclass(frozen=True)
class BracketSettings:
    """The numbers of a bracket; chosen by hand where no source is named."""

    aligned_pixels: int = 640  # of the longer side, in which the photos are aligned
    steps: tuple[int, float] = (60, 1e-5)  # of the alignment: at most, and least gain of ECC
    smoothing: int = 5  # pixels, of the alignment's Gaussian
    same_scene: float = 0.6  # correlation of the aligned photos, at least
    same_exposure: float = 0.1  # logarithm of two exposures' ratio, at least, of the extremes
    exif_error: float = 0.02  # standard deviation of the logarithm of EXIF's exposure
    unknown_exposure: float = 3.0  # the same, where EXIF is silent
    samples: int = 20_000  # pixels, for the tone curve
    curved: float = 8.0  # by how much a straight curve's squared errors must be larger
    bin: float = 0.15  # of the logarithm, of the pixels whose median is taken
    least_bin: int = 30  # pixels in one
    bin_deviation: float = 0.03  # of that median
    bin_noise: float = 0.3  # of its pixels' spread, added to that
    limit: float = 0.7  # of the logarithm, above the darkest usable value
    certain: float = 1e-3  # deviation of what is fixed
    usable: tuple[float, float] = (0.01, 0.9)  # linear values, of white, that say something
    # What a photo is exposed for: dark light in the longest, bright light in the shortest one.
    exposed: tuple[float, float] = (0.2, 0.65)
    fading: float = 0.7  # of white, from which a value counts less
    beside: int = 7  # pixels a side, around a value, that count with it
    least_common: int = 500  # pixels that two photos must both show well
    blurred: float = 0.35  # of the sharpest photo's fine detail, at least
    fine: tuple[float, float] = (1.5, 3.0)  # pixels, of the Gaussians whose difference is fine
    unsteady: float = 0.12  # median deviation of the logarithms from which the light changed


BRACKET = BracketSettings()


def merge_bracket(photos: Sequence[Photo], names: Sequence[str]) -> Photo:
    """One photo of linear radiance from several exposures of one set-up; names: of their files.

    The result is in the unit of the shortest exposure, and lies over that. Raises `InputError` for
    photos of different sizes or scenes, for one that is blurred, and for equal exposures.

        photo = merge_bracket([read_photo(p) for p in paths], [p.name for p in paths])
    """
    if len({p.image.shape for p in photos}) > 1:
        raise InputError(f"{', '.join(names)} differ in size: a bracket's photos must not")
    if any(not np.array_equal(p.matrix, photos[0].matrix) for p in photos):  # type: ignore[arg-type]
        photos = [p.in_rec709() for p in photos]
    brightness = [float(np.median(p.image)) for p in photos]
    told = [p.exposure for p in photos]
    known = all(t is not None for t in told) and len(set(told)) > 1
    order = np.argsort(told if known else brightness)  # type: ignore[arg-type]
    photos, names = [photos[i] for i in order], [names[i] for i in order]
    white = float(min(p.clip_level or np.inf for p in photos))
    if not math.isfinite(white):
        white = max(float(p.image.max()) for p in photos)
    images = [photos[0].image / white]
    for photo, name in zip(photos[1:], names[1:], strict=True):
        images.append(_aligned(photo.image / white, images[0], name, names[0]))
    usable = [_usable(image) for image in images]
    _check_sharpness(images, usable, names)
    exposures = [p.exposure for p in photos] if known else None
    curve, logs, deviation, off = _tone_curve(images, usable, exposures)
    if logs[-1] - logs[0] < BRACKET.same_exposure:
        raise InputError(
            f"{', '.join(names)} have the same exposure: a bracket needs another one, twice as "
            "long or more"
        )
    merged = _merge(images, curve, logs)
    top = float(np.exp(np.interp(0.0, np.log(KNOTS), curve)))
    shares = ", ".join(f"{math.exp(x):.3g}" for x in logs)
    note = Notice("photo-bracket", f"{', '.join(names)} were merged; their exposures are {shares}")
    warnings = {w.code: w for p in photos for w in p.warnings}
    if not known and photos[0].clip_level is not None:
        text = (
            f"{', '.join(names)} do not say how long they were exposed, so that their tone curve "
            "is a guess, and with it the screen's light: keep the EXIF of the photos"
        )
        warnings["bracket-unknown"] = Notice("bracket-unknown", text)
    if off > BRACKET.unsteady:
        text = (
            f"the exposures {', '.join(names)} differ by more than their exposure (a lamp that "
            "flickers, or something that moved): take them again in steady light"
        )
        warnings["bracket-unsteady"] = Notice("bracket-unsteady", text)
    return replace(
        photos[0], image=(merged * white).astype(np.float32), exposure=None,
        clip_level=None if photos[0].clip_level is None else white * top, linear=True,
        curve_deviation=deviation,
        notes=(*photos[0].notes, note), warnings=tuple(warnings.values()),
    )  # fmt: skip


def _usable(image: Array) -> Mask:
    """(H, W): pixels that are neither saturated nor dark in any channel."""
    low, high = BRACKET.usable
    return np.asarray((image.min(-1) > low) & (image.max(-1) < high))


def _ranks(image: Array) -> Array:
    """An image (H, W) of brightness, whatever the exposure and the tone curve: smooth ranks."""
    grey = (np.clip(image.mean(-1), 0, 1) ** 0.5 * 255).astype(np.uint8)
    return np.asarray(cv2.equalizeHist(grey).astype(np.float32) / 255)


def _aligned(image: Array, reference: Array, name: str, first: str) -> Array:
    """The image laid over the reference; what lies outside it is NaN."""
    h, w = image.shape[:2]
    scale = min(1.0, BRACKET.aligned_pixels / max(h, w))
    size = round(w * scale), round(h * scale)
    small: list[Array] = [
        np.asarray(cv2.resize(a, size, interpolation=cv2.INTER_AREA), np.float32)
        for a in (reference, image)
    ]
    mask = (np.minimum(*(a.max(-1) for a in small)) > BRACKET.usable[0]).astype(np.uint8)
    # What is saturated in the longer exposure has no detail there.
    mask &= (small[1].min(-1) < BRACKET.usable[1]).astype(np.uint8)
    start = np.eye(3, dtype=np.float32)
    moved: Any = start
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, *BRACKET.steps)
    try:
        found, moved = cv2.findTransformECC(
            _ranks(small[0]), _ranks(small[1]), start, cv2.MOTION_HOMOGRAPHY, criteria, mask,
            BRACKET.smoothing,
        )  # fmt: skip
    except cv2.error:
        found = 0.0
    if found < BRACKET.same_scene:
        raise InputError(
            f"{name} does not show what {first} shows: a bracket is the same set-up, exposed "
            "longer and shorter, from the same place"
        )
    # From the centres of the small image's pixels to those of the photo's, both at whole numbers.
    x, y = size[0] / w, size[1] / h
    zoom = np.array([[x, 0, x / 2 - 0.5], [0, y, y / 2 - 0.5], [0, 0, 1]])
    full = np.linalg.inv(zoom) @ np.asarray(moved) @ zoom
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    outside = (np.nan,) * 3
    return np.asarray(
        cv2.warpPerspective(image, full, (w, h), None, flags, cv2.BORDER_CONSTANT, outside)
    )


def _check_sharpness(images: Sequence[Array], usable: Sequence[Mask], names: Sequence[str]) -> None:
    """Raise `InputError` for a photo with much less fine detail than another one."""
    detail = []
    common = np.logical_and.reduce(usable)
    if common.sum() < BRACKET.least_common:
        return
    for image in images:
        log = np.log(np.maximum(np.nan_to_num(image.mean(-1)), BRACKET.usable[0]))
        band = [ndimage.gaussian_filter(log, s) for s in BRACKET.fine]
        detail.append(float(np.median(np.abs(band[0] - band[1])[common])))
    for name, share in zip(names, np.array(detail) / max(detail), strict=True):
        if share < BRACKET.blurred:
            raise InputError(f"{name} is blurred: take it again, or leave it out")


def _tone_curve(
    images: Sequence[Array], usable: Sequence[Mask], exposures: Sequence[float | None] | None
) -> tuple[Array, Array, float, float]:
    """Logarithms of light over value at the knots; of the exposures over the first one; the
    deviation of the logarithm of bright light in that over dark light in the last one; and the
    median deviation that is left."""
    knots = np.log(KNOTS)
    count, n = len(knots), len(images)
    pairs = []
    for k in range(1, n):
        both = usable[k] & usable[k - 1]
        if both.sum() < BRACKET.least_common:
            raise InputError(
                "two exposures of the bracket have too little in common: nothing is well exposed "
                "in both; take one in between"
            )
        step = max(1, int(both.sum()) // BRACKET.samples)
        shorter, longer = (
            np.log(images[i][both][::step]).ravel().astype(float) for i in (k - 1, k)
        )
        pairs.append((k, shorter, longer))

    # The prior as rows of a triangle, whose square is the inverse covariance.
    mean, covariance = curve_prior(np.asarray(KNOTS), FIXED)
    triangle = np.linalg.cholesky(np.linalg.inv(covariance)).T
    rows = [np.pad(triangle, ((0, 0), (0, n)))]
    right = [triangle @ mean]
    known = BRACKET.exif_error if exposures else BRACKET.unknown_exposure
    for place, deviation, value in [
        (FIXED, BRACKET.certain, 0.0),
        (count, BRACKET.certain, 0.0),
        *(
            (
                count + k,
                known,
                math.log((exposures[k] or 1) / (exposures[0] or 1)) if exposures else 0,
            )
            for k in range(1, n)
        ),
    ]:
        rows.append(np.eye(1, count + n, place) / deviation)
        right.append(np.array([value / deviation]))
    # Medians by brightness, not pixels: many noisy ones would draw the curve flat.
    for k, shorter, longer in pairs:
        bins = np.floor((shorter + longer) / (2 * BRACKET.bin)).astype(int)
        for i in np.unique(bins):
            low, high = shorter[bins == i], longer[bins == i]
            ratio = float(np.median(high - low))
            x, y = np.median(low + high) / 2 + np.array([-0.5, 0.5]) * ratio
            # Near the limits of what is used, noise decides what is.
            near = x < math.log(BRACKET.usable[0]) + BRACKET.limit
            if len(low) < BRACKET.least_bin or near:
                continue
            spread = float(np.median(np.abs(high - low - ratio)))
            deviation = math.hypot(BRACKET.bin_deviation, BRACKET.bin_noise * spread)
            row = np.append(knot_shares(x, knots) - knot_shares(y, knots), np.zeros(n))
            row[count + k], row[count + k - 1] = 1, -1
            rows.append(row[None] / deviation)
            right.append(np.array([ratio / deviation]))
    matrix, values = np.concatenate(rows[1:]), np.concatenate(right[1:])
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right))[0]
    # A straight file is likelier than the family says, and contradicted by what is not straight.
    straight = np.zeros(count + n)
    straight[count:] = np.linalg.lstsq(matrix[:, count:], values)[0]
    worse = np.square(matrix @ straight - values).sum()
    worse -= np.square(matrix @ solution - values).sum()
    system = np.concatenate(rows)
    span = np.zeros(count + n)
    span[-1] = 1
    if worse < BRACKET.curved:
        solution, system = straight, system[:, count:]
    else:
        low, high = np.log(BRACKET.exposed)
        span[:count] = knot_shares(high, knots) - knot_shares(low, knots)
    span = span[-system.shape[1] :]
    deviation = float(np.sqrt(span @ np.linalg.pinv(system.T @ system) @ span))
    curve, logs = solution[:count], solution[count:]

    def light(log: Array) -> Array:
        return np.asarray(log + np.interp(log, knots, curve))

    off = [np.median(np.abs(light(b) - light(a) - logs[k] + logs[k - 1])) for k, a, b in pairs]
    return curve, logs, deviation, float(max(off))


def _merge(images: Sequence[Array], curve: Array, logs: Array) -> Array:
    """The radiance (H, W, 3), in the first exposure's unit."""
    low, high = BRACKET.usable
    total = np.zeros(images[0].shape)
    weights = np.zeros(images[0].shape)
    for k, (image, log) in enumerate(zip(images, logs, strict=True)):
        value = np.maximum(np.nan_to_num(image), 1e-6)
        light = value * np.exp(np.interp(np.log(value), np.log(KNOTS), curve) - log)
        full = np.nan_to_num(image, nan=1.0).max(-1)
        # Beside what is saturated, a JPEG's colours and the lens's glow are wrong too.
        full = ndimage.maximum_filter(full, BRACKET.beside)[..., None]
        weight = np.exp(log) * np.clip((high - full) / (high - BRACKET.fading), 0, 1)
        weight = weight * np.clip(value / low, 1e-3, 1)
        if k == 0:  # where nothing is well exposed the shortest one counts
            weight = np.maximum(weight, 1e-6)
        total += weight * light
        weights += weight
    return np.asarray(total / weights)
