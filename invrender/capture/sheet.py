"""The capture sheet in a photo: the camera's pose and optics, and the light on its paper.

OpenCV finds the markers in a small tone-mapped copy. Their edges are then measured in the photo's
own radiance, where they are straight lines at half the change from ink to paper: blur does not move
these. One reprojection fit under what is known beforehand gives pose, field of view, principal
point and radial distortion with their covariance. A sheet seen straight down fixes the focal length
over the height, and little of each alone; the deviations say so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from invrender.capture.ball_image import sample_image
from invrender.capture.camera import is_whole
from invrender.capture.mirror import Ball
from invrender.capture.response import Response
from invrender.capture.settings import (
    CLIPPED_LAMPS,
    DISPLAY,
    GAUSSIAN_SPREAD,
    SCREEN_FIT,
    SHEET_FIT,
)
from invrender.capture.sheet_layout import (
    FAMILY,
    MODULES,
    PAPER,
    PAPER_DEVIATION,
    Sheet,
    capture_sheet,
    marker_dictionary,
)
from invrender.capture.table import room_irradiance, screen_irradiance
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.rig import Rig, fov_of, lens_gain, squared_distance
from invrender.sphere import resample_environment
from invrender.types import TINY, Array, InputError, Mask, Notice

Circle = tuple[float, float, float]


@dataclass(frozen=True)
class FoundSheet:
    """A capture sheet as a photo shows it.

    ids: (n,) the markers that were used; corners: (n, 4, 2) theirs, in pixels of the photo that
    `use_sheet` returns. tilt_deviation: of the camera's tilt, degrees; fov: of the photo as it was,
    and its deviation; place_deviation: of the camera's place (x, y, z), metres. principal: how far
    (x, y) the principal point lies from that photo's middle, in its widths; distortion: k1, of
    x·(1 + k1·r²) with r the tangent of the angle from the axis; each with its deviation. residual:
    of the corners, root mean square in pixels. white: (k, 3) places of plain paper, metres, and
    white_radiance (k, 3) what the photo shows there, at least, where it is white_saturated (k, 3);
    white_aside: (k,) their squared distance from the optical axis, a corner's being 1. printed:
    (m, 2) values of ink and of the paper beside it, of one channel each. turns: quarters by which
    the photo was turned, counter-clockwise.
    """

    ids: NDArray[np.int_]
    corners: Array
    tilt_deviation: float
    fov: float
    fov_deviation: float
    place_deviation: tuple[float, float, float]
    principal: tuple[float, float]
    principal_deviation: tuple[float, float]
    distortion: float
    distortion_deviation: float
    residual: float
    white: Array
    white_radiance: Array
    white_saturated: Mask
    white_aside: Array
    printed: Array
    turns: int = 0


@dataclass(frozen=True)
class _Camera:
    """Pose and optics, and how far the ink of a marker reaches beyond it; pixels and metres."""

    place: Array
    axes: Array
    focal: float
    centre: Array
    distortion: float = 0.0
    ink: float = 0.0

    def moved(self, step: Array) -> _Camera:
        """Changed by (place 3, turn 3 in radians, log focal, ink, distortion, centre 2), the last
        ones as far as they are there."""
        full = np.zeros(11)
        full[: len(step)] = step
        turn = Rotation.from_rotvec(full[3:6]).as_matrix()
        return _Camera(
            self.place + full[:3],
            self.axes @ turn.T,
            self.focal * math.exp(full[6]),
            self.centre + full[9:],
            self.distortion + full[8],
            self.ink + full[7],
        )

    def project(self, points: Array) -> Array:
        """Points of the table (..., 2) to pixels (..., 2)."""
        p = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], -1) - self.place
        p = p @ self.axes.T
        depth = np.maximum(-p[..., 2:], TINY)
        q = p[..., :2] / depth
        q = q * (1 + self.distortion * (q * q).sum(-1, keepdims=True))
        return np.asarray(self.centre + self.focal * q * [1, -1])


def use_sheet(capture: Capture) -> tuple[Capture, FoundSheet | None, tuple[Notice, ...]]:
    """The capture with photo and camera as its capture sheet shows them, where there is one.

    The photo is turned upright and, where the optics need it, resampled to a pinhole's with the
    optical axis in its middle; ``tilt_deviation`` is set. Raises `InputError` for another rig's
    sheet.
    """
    photo, rig = capture.photo, capture.rig
    try:
        sheet = capture_sheet(rig)
    except InputError:  # no paper is large enough
        return capture, None, ()
    marker = float(sheet.corners[0, 1, 0] - sheet.corners[0, 0, 0])
    focal = rig.focal(photo.width)
    ids, quads = _markers(photo, marker / rig.camera[2] * focal)
    own = _own(sheet, ids, quads)
    if own.sum() < SHEET_FIT.least_markers:
        return capture, None, _cut(int(own.sum()))
    ids, quads = ids[own], refine_corners(photo, quads[own])
    places = sheet.corners[np.searchsorted(sheet.ids, ids)]
    start = _from_homography(places, quads, focal, _middle(photo))
    lies = _quarters_to_nominal(start, rig)
    places = _rotated(places, lies)
    start = replace(start, place=_rotated(start.place, lies), axes=_rotated(start.axes, lies))
    turns = round(math.degrees(math.atan2(start.axes[0, 1], start.axes[0, 0])) / 90) % 4
    quads = _turned_pixels(quads, turns, photo)
    if turns:
        photo = replace(photo, image=np.rot90(photo.image, turns))
    if turns % 2 and capture.fov_from == "rig":  # stated of the photo as it should be
        focal = rig.focal(photo.width)
    start = _from_homography(places, quads, focal, _middle(photo))
    known = capture.fov_from
    if known == "exif" and not is_whole(photo):  # of the photo before it was cropped
        known = "unknown"
    fit, stated = _fit(photo, rig, known, places, quads, start), None
    if fit.pull > SHEET_FIT.contradiction and known in SHEET_FIT.focal_deviation:
        other = _fit(photo, rig, "unknown", places, quads, start)
        if other.pull < SHEET_FIT.contradiction:
            fit, known = other, "unknown"
            stated = _fov(photo.width, focal)
    side = float(np.median(np.linalg.norm(quads[:, 1] - quads[:, 0], axis=-1)))
    if fit.residual > SHEET_FIT.greatest_misfit * side:
        raise _another(sheet)
    full, deviation, residual = fit.camera, fit.deviation, fit.residual
    fov = _fov(photo.width, full.focal)
    principal = _pair((full.centre - _middle(photo)) / photo.width)
    straight = replace(full, distortion=0.0)
    bend = float(np.abs(straight.project(places) - full.project(places)).max())
    if bend > SHEET_FIT.least_bend and abs(full.distortion) > SHEET_FIT.sure * deviation[8]:
        photo, camera = _straightened(photo, full)
    else:
        photo, off = _centred(photo, full)
        pinhole = replace(start, centre=_middle(photo))
        camera = _fit(photo, rig, known, places, quads + off, pinhole, 8).camera
    shift = np.asarray(rig.camera_shift) + camera.place - rig.camera
    tilt = Rotation.from_matrix(camera.axes.T).as_rotvec(degrees=True)
    posed = replace(
        rig,
        fov=_fov(photo.width, camera.focal),
        camera_shift=tuple(shift.tolist()),
        camera_tilt=tuple(tilt.tolist()),
    )
    white, radiance, saturated = _white_radiance(
        photo, posed, _rotated(sheet.white, lies), sheet.white_side
    )
    corners = np.asarray(posed.project(_on_table(places), photo.height, photo.width))
    found = FoundSheet(
        ids=ids,
        corners=corners,
        tilt_deviation=math.degrees(math.hypot(*deviation[3:5])),
        fov=fov,
        fov_deviation=math.degrees(math.sin(math.radians(fov))) * float(deviation[6]),
        place_deviation=(float(deviation[0]), float(deviation[1]), float(deviation[2])),
        principal=principal,
        principal_deviation=_pair(deviation[9:] / photo.width),
        distortion=full.distortion,
        distortion_deviation=float(deviation[8]),
        residual=residual,
        white=_on_table(white),
        white_radiance=radiance,
        white_saturated=saturated,
        white_aside=squared_distance(
            posed.project(_on_table(white), photo.height, photo.width), photo.height, photo.width
        ),
        printed=_ink_and_paper(photo, corners),
        turns=turns,
    )
    used = replace(
        capture, photo=photo, rig=posed, fov_from="sheet", tilt_deviation=found.tilt_deviation
    )
    return used, found, _notices(found, stated, turns, lies)


# --- the markers --------------------------------------------------------------------------------


def _markers(photo: Photo, expected: float) -> tuple[NDArray[np.int_], Array]:
    """Numbers (n,) and corners (n, 4, 2) in pixels of all markers that small copies show, where
    they are about ``expected`` pixels wide."""
    ids: NDArray[np.int_] = np.zeros(0, int)
    quads: Array = np.zeros((0, 4, 2))
    for wanted in SHEET_FIT.copy_markers:
        scale = min(1.0, wanted / expected)
        more, found = _detected(photo.image[..., 1], scale, wanted)
        if len(more) >= len(ids):
            ids, quads = more, found
        if len(ids) == 0 or scale == 1:
            break
    return ids, quads


def _detected(image: Array, scale: float, wanted: float) -> tuple[NDArray[np.int_], Array]:
    """The markers that a copy of the radiances (h, w) at that scale shows."""
    import cv2

    height, width = image.shape
    step = max(1, math.floor(SHEET_FIT.skipped / scale))
    image = image[step // 2 :: step, step // 2 :: step]
    if scale < 1:  # OpenCV reads no strided images
        size = max(1, round(width * scale)), max(1, round(height * scale))
        image = np.asarray(
            cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA), np.float32
        )
    level = max(float(np.median(image)), SHEET_FIT.least_level * float(image.max()), TINY)
    toe, top = SHEET_FIT.toe, SHEET_FIT.brightest
    tone: Array = np.log(
        np.minimum(image * np.float32(1 / level), np.float32(top)) + np.float32(toe)
    )
    tone = (tone - np.float32(math.log(toe))) * np.float32(255 / math.log((top + toe) / toe))
    settings = cv2.aruco.DetectorParameters()
    settings.adaptiveThreshWinSizeMin = settings.adaptiveThreshWinSizeMax = SHEET_FIT.window
    settings.minMarkerPerimeterRate = 4 * SHEET_FIT.least_marker * wanted / max(image.shape)
    settings.errorCorrectionRate = SHEET_FIT.corrected
    settings.perspectiveRemovePixelPerCell = SHEET_FIT.cell_pixels
    settings.perspectiveRemoveIgnoredMarginPerCell = SHEET_FIT.cell_margin
    detector = cv2.aruco.ArucoDetector(marker_dictionary(), settings)
    quads, ids, _ = detector.detectMarkers(np.asarray(tone, np.uint8))
    if ids is None:
        return np.zeros(0, int), np.zeros((0, 4, 2))
    corners = (np.concatenate(quads) + 0.5) * [width, height] / tone.shape[::-1]
    return ids.ravel().astype(int), corners


def _own(sheet: Sheet, ids: NDArray[np.int_], quads: Array) -> Mask:
    """Which markers are this sheet's and lie as they should. Raises `InputError` where they are
    another sheet's."""
    import cv2

    own = np.array([i in sheet.ids for i in ids.tolist()], bool)
    strange = ids[~own] // FAMILY
    most = int(np.bincount(strange).max()) if len(strange) else 0
    if most > max(own.sum(), SHEET_FIT.least_markers - 1):
        raise _another(sheet)
    if own.sum() < SHEET_FIT.least_markers:
        return own
    places = sheet.corners[np.searchsorted(sheet.ids, ids[own])]
    side = float(np.median(np.linalg.norm(quads[own][:, 1] - quads[own][:, 0], axis=-1)))
    _, inside = cv2.findHomography(
        places.reshape(-1, 2), quads[own].reshape(-1, 2), cv2.RANSAC, SHEET_FIT.in_place * side
    )
    lie = inside.reshape(-1, 4).all(1) if inside is not None else np.zeros(own.sum(), bool)
    if lie.sum() < max(SHEET_FIT.least_in_place * len(lie), SHEET_FIT.least_markers):
        raise _another(sheet)
    out = own.copy()
    out[own] = lie
    return out


def _another(sheet: Sheet) -> InputError:
    return InputError(
        "the photo shows another capture sheet than this rig's, whose window is "
        f"{1000 * sheet.window:.1f} mm wide and whose ball stands {1000 * sheet.ball[0]:.1f} mm "
        "from its middle: print that with 'invrender pattern --rig rig.toml -o guide.pdf', or "
        "correct rig.toml, and lay it flat"
    )


def moved_circle(
    sheet: FoundSheet | None, circle: Circle | None, before: Photo, after: Photo
) -> Circle | None:
    """Where a circle (x, y, radius) of the photo lies in the one that `use_sheet` made of it."""
    if sheet is None or circle is None:
        return circle
    width, height = (before.width, before.height)[:: -1 if sheet.turns % 2 else 1]
    x, y = _turned_pixels(np.array(circle[:2]), sheet.turns, before)
    x += (after.width - width) / 2 - sheet.principal[0] * width
    y += (after.height - height) / 2 - sheet.principal[1] * width
    return float(x), float(y), circle[2]


def _cut(count: int) -> tuple[Notice, ...]:
    if count == 0:
        return ()
    text = (
        f"the photo shows only {count} of the capture sheet's markers, too few to use it: leave "
        "its ring of markers uncovered and in the picture"
    )
    return (Notice("sheet-hidden", text),)


def _notices(found: FoundSheet, stated: float | None, turns: int, lies: int) -> tuple[Notice, ...]:
    notices = []
    if stated is not None:
        text = (
            f"the capture sheet shows a field of view of {found.fov:.1f} ± "
            f"{found.fov_deviation:.1f}°, not the stated {stated:.1f}°, which was not used: "
            "correct it in rig.toml"
        )
        notices.append(Notice("fov-doubtful", text))
    if turns:
        text = (
            f"the photo was turned by {90 * turns}° counter-clockwise: the capture sheet shows "
            "which side is up"
        )
        notices.append(Notice("photo-turned", text))
    if lies:
        text = (
            f"the capture sheet lies turned by {90 * lies}° against camera and screen; it "
            "was taken as it lies"
        )
        notices.append(Notice("sheet-turned", text))
    return tuple(notices)


def refine_corners(photo: Photo, quads: Array) -> Array:
    """Markers' corners (n, 4, 2) measured in the photo: where lines along their edges meet.

    An edge is where the radiance, integrated across it from ink to paper, has its step.
    """
    for reach, pixels in SHEET_FIT.passes:
        quads = _refined(photo, quads, reach, pixels)
    return quads


def _refined(photo: Photo, quads: Array, reach: float, pixels: float) -> Array:
    """One pass: ``reach`` in modules to either side of an edge, but at most so many pixels."""
    start, end = quads, np.roll(quads, -1, 1)  # (n, 4, 2): the edges' ends
    along = end - start
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    outward = np.stack([along[..., 1], -along[..., 0]], -1) / length
    count, samples, inset = SHEET_FIT.edge_points, SHEET_FIT.edge_samples, SHEET_FIT.edge_inset
    u = (np.arange(count) + 0.5) / count * (1 - 2 * inset) + inset
    half = np.minimum(reach * length / MODULES, pixels)[..., None, :]  # (n, 4, 1, 1)
    t = (np.arange(samples) + 0.5) / samples * 2 - 1
    at = start[..., None, :] + along[..., None, :] * u[:, None]  # (n, 4, count, 2)
    at = at[..., None, :] + outward[..., None, None, :] * (half * t[:, None])[..., None, :, :]
    low = np.maximum(np.floor(at.min((0, 1, 2, 3))).astype(int) - 2, 0)
    high = np.ceil(at.max((0, 1, 2, 3))).astype(int) + 3
    part = photo.image[low[1] : high[1], low[0] : high[0]].mean(-1)
    seen = sample_image(part, at, (low[1], low[0]))  # (n, 4, count, samples)
    end_samples = SHEET_FIT.end_samples
    ink = np.median(seen[..., :end_samples], (-1, -2))[..., None]
    paper = np.median(seen[..., -end_samples:], (-1, -2))[..., None]
    dark = (paper - seen.mean(-1)) / np.maximum(paper - ink, TINY)  # share of the profile
    offset = (2 * dark - 1) * half[..., 0]  # (n, 4, count), pixels outwards
    a = np.stack([np.ones(count), u - 0.5], -1)
    line = offset @ np.linalg.pinv(a).T  # (n, 4, 2)
    for _ in range(SHEET_FIT.rounds):  # what lies over an edge does not count
        away = np.abs(offset - line @ a.T)
        spread = GAUSSIAN_SPREAD * np.median(away, -1, keepdims=True) + SHEET_FIT.least_spread
        weight = 1 / (1 + (away / (SHEET_FIT.outlier * spread)) ** 2)
        matrix = np.einsum("nec,ci,cj->neij", weight, a, a)
        line = np.linalg.solve(matrix, ((weight * offset) @ a)[..., None])[..., 0]
    # In the image plane: outward · x = c, of which two meet in a corner.
    ends = (
        np.stack([start, end], -2)
        + outward[..., None, :] * (line[..., :1] + line[..., 1:] * np.array([-0.5, 0.5]))[..., None]
    )
    normal = ends[..., 1, :] - ends[..., 0, :]
    normal = np.stack([normal[..., 1], -normal[..., 0]], -1)
    distance = (normal * ends[..., 0, :]).sum(-1)
    matrix = np.stack([np.roll(normal, 1, 1), normal], -2)
    values = np.stack([np.roll(distance, 1, 1), distance], -1)
    found = np.linalg.solve(matrix, values[..., None])[..., 0]
    # Across the edge of a shadow lines lie anywhere: what they say beyond their reach is not taken.
    reached = (
        np.linalg.norm(found - quads, axis=-1) < SHEET_FIT.farthest * half.max((1, 2, 3))[:, None]
    )
    return np.where(reached[..., None], found, quads)


# --- the camera ---------------------------------------------------------------------------------


def _from_homography(places: Array, quads: Array, focal: float, middle: Array) -> _Camera:
    """A pinhole from the plane's homography, with a given focal length in pixels."""
    import cv2

    matrix, _ = cv2.findHomography(
        places.reshape(-1, 2), (quads.reshape(-1, 2) - middle) / focal * [1, -1]
    )
    m = np.diag([1.0, 1.0, -1.0]) @ matrix
    m = m * (2 / (np.linalg.norm(m[:, 0]) + np.linalg.norm(m[:, 1])))
    if m[2, 2] > 0:  # the table lies before the camera
        m = -m
    u, _, v = np.linalg.svd(np.stack([m[:, 0], m[:, 1], np.cross(m[:, 0], m[:, 1])], -1))
    axes = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return _Camera(-axes.T @ m[:, 2], axes, focal, middle)


@dataclass(frozen=True)
class _Fit:
    """A camera; deviations of its numbers, as `_Camera.moved` has them; the corners' residual in
    pixels; and how many deviations focal length and axis lie from what was expected."""

    camera: _Camera
    deviation: Array
    residual: float
    pull: float


def _fit(
    photo: Photo, rig: Rig, known: str, places: Array, quads: Array, start: _Camera, free: int = 11
) -> _Fit:
    """The likeliest camera that sees the ``places`` (n, 4, 2) of the table at ``quads`` (n, 4, 2).

    known: where the field of view is known from; free: how many of the camera's numbers are fitted.
    ``start.focal`` is the expected focal length.
    """
    nominal = replace(rig, camera_shift=(0.0, 0.0, 0.0)).camera
    middle, height = _middle(photo), nominal[2]
    focal_deviation = SHEET_FIT.focal_deviation.get(known, SHEET_FIT.unknown_focal_deviation)
    free_focal = known not in SHEET_FIT.focal_deviation
    prior = np.array([
        *np.full(2, SHEET_FIT.place_deviation * height),
        SHEET_FIT.height_deviation[free_focal] * height,
        *np.full(3, math.pi),
        focal_deviation,
        SHEET_FIT.ink_deviation * np.linalg.norm(places[0, 1] - places[0, 0]),
        SHEET_FIT.distortion_deviation,
        *np.full(2, _centre_deviation(photo) * photo.width),
    ])[:free]  # fmt: skip
    outward = np.sign(places - places.mean(1, keepdims=True))

    def errors(z: Array, sigma: float) -> Array:
        camera = start.moved(z * scale)
        off = (camera.project(places + camera.ink * outward) - quads).ravel() / sigma
        away = [*(camera.place - nominal), *z[3:6] * scale[3:6],
                math.log(camera.focal / start.focal), camera.ink, camera.distortion,
                *(camera.centre - middle)]  # fmt: skip
        return np.concatenate([off, np.array(away)[:free] / prior])

    step, sigma = SHEET_FIT.step, SHEET_FIT.first_deviation
    scale = step * np.array([*[height] * 3, *[1.0] * 4, height, 1.0, *[start.focal] * 2])[:free]
    z = np.zeros(free)
    for _ in range(SHEET_FIT.fits):
        done = least_squares(
            errors, z, args=(sigma,), loss="soft_l1", f_scale=SHEET_FIT.robust, method="trf"
        )
        z = done.x
        off = errors(z, 1.0)[: quads.size]
        spread = GAUSSIAN_SPREAD * float(np.median(np.abs(off)))
        sigma = max(spread, SHEET_FIT.least_deviation)
    pulls = np.abs(errors(z, 1.0)[quads.size :])
    covariance = np.linalg.inv(done.jac.T @ done.jac)
    return _Fit(
        start.moved(z * scale),
        np.sqrt(np.diag(covariance)) * scale,
        float(np.sqrt((off**2).mean())),
        float(pulls[[6, *range(9, free)]].max()),
    )


def _centre_deviation(photo: Photo) -> float:
    """Expected distance of the optical axis from the photo's middle, in the photo's widths."""
    return SHEET_FIT.centre_deviation if is_whole(photo) else SHEET_FIT.cropped_deviation


def _middle(photo: Photo) -> Array:
    return np.array([photo.width, photo.height]) / 2


def _quarters_to_nominal(camera: _Camera, rig: Rig) -> int:
    """By how many quarters a sheet must be turned, counter-clockwise, for its camera to stand on
    the nominal side; none where it stands above the window's middle."""
    x, y = camera.place[:2]
    if math.hypot(x, y) < SHEET_FIT.least_aside * rig.optical_axis_x:
        return 0
    return round(-math.degrees(math.atan2(y, x)) / 90) % 4


def _rotated(vectors: Array, quarters: int) -> Array:
    """Vectors (..., 2 or 3) turned about z by quarters, counter-clockwise."""
    out = np.array(vectors, float)
    for _ in range(quarters):
        out[..., 0], out[..., 1] = -out[..., 1].copy(), out[..., 0].copy()
    return out


def _turned_pixels(pixels: Array, turns: int, photo: Photo) -> Array:
    """Where pixels (..., 2) of a photo lie once it is turned counter-clockwise by quarters."""
    width, height = photo.width, photo.height
    for _ in range(turns):
        pixels = np.stack([pixels[..., 1], width - pixels[..., 0]], -1)
        width, height = height, width
    return pixels


def _centred(photo: Photo, camera: _Camera) -> tuple[Photo, Array]:
    """The photo grown at its borders, by whole pixels, so that the optical axis is its middle; and
    by how much what it shows has moved (x, y). The new pixels are black where they are many."""
    off = np.round(camera.centre - _middle(photo)).astype(int)
    if not off.any():
        return photo, off
    (right, below), (left, above) = 2 * np.maximum(off, 0), 2 * np.maximum(-off, 0)
    few = np.abs(off).max() <= SHEET_FIT.largest_off * photo.width
    margins = ((above, below), (left, right), (0, 0))
    image = np.pad(photo.image, margins, "edge" if few else "constant")
    return replace(photo, image=image), np.array([left, above])


def _straightened(photo: Photo, camera: _Camera) -> tuple[Photo, _Camera]:
    """The photo as a pinhole takes it whose optical axis is the middle, and that pinhole."""
    import cv2

    more = 2 * np.ceil(np.abs(camera.centre - _middle(photo))).astype(int)
    width, height = photo.width + int(more[0]), photo.height + int(more[1])
    x = ((np.arange(width) + 0.5) - width / 2) / camera.focal
    y = ((np.arange(height) + 0.5) - height / 2) / camera.focal
    bend = camera.focal * (1 + camera.distortion * (x**2 + y[:, None] ** 2))
    at = (
        (camera.centre[0] - 0.5 + bend * x).astype(np.float32),
        (camera.centre[1] - 0.5 + bend * y[:, None]).astype(np.float32),
    )
    few = more.max() <= 2 * SHEET_FIT.largest_off * photo.width
    border = cv2.BORDER_REPLICATE if few else cv2.BORDER_CONSTANT

    def moved(image: Array) -> Array:
        image = np.ascontiguousarray(image)
        return np.asarray(cv2.remap(image, *at, cv2.INTER_LINEAR, borderMode=border))

    image = moved(photo.image)
    if photo.clip_level is not None:  # a channel beside a saturated one counts as that
        full = moved((photo.image >= photo.clip_level).astype(np.float32)) > 0
        image[full] = np.maximum(image[full], photo.clip_level)
    pinhole = replace(camera, centre=np.array([width, height]) / 2, distortion=0.0)
    return replace(photo, image=image), pinhole


def _fov(width: int, focal: float) -> float:
    """Degrees across a photo ``width`` pixels wide."""
    return fov_of(width / 2 / focal)


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _on_table(points: Array) -> Array:
    """Points (..., 2) of the table with their height, 0."""
    return np.concatenate([points, np.zeros((*points.shape[:-1], 1))], -1)


# --- the paper ----------------------------------------------------------------------------------


def _ink_and_paper(photo: Photo, corners: Array) -> Array:
    """Values (m, 2) of ink and of the paper beside it, of one channel of one marker each: medians
    along the middle of its black border, and as far outside. None of markers whose squares are so
    small that the lens mixes them, or of which something is saturated or outside the photo."""
    half = 0.5 / MODULES
    side = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=-1)
    corners = corners[side > SHEET_FIT.least_module * MODULES]
    along = np.linspace(half, 1 - half, SHEET_FIT.edge_samples)

    def values(inset: float) -> Array:
        low, high = np.full_like(along, inset), np.full_like(along, 1 - inset)
        s = np.concatenate([along, along, low, high])[:, None, None]
        t = np.concatenate([low, high, along, along])[:, None, None]
        upper = corners[:, 0] + s * (corners[:, 1] - corners[:, 0])
        lower = corners[:, 3] + s * (corners[:, 2] - corners[:, 3])
        column, row = np.floor(upper + t * (lower - upper)).astype(int).transpose(2, 0, 1)
        inside = (column >= 0) & (column < photo.width) & (row >= 0) & (row < photo.height)
        seen = photo.image[np.clip(row, 0, photo.height - 1), np.clip(column, 0, photo.width - 1)]
        seen = np.where(inside[..., None], seen, np.nan)
        level = math.inf if photo.clip_level is None else photo.clip_level
        middle = np.asarray(np.median(seen, 0))  # NaN where one is outside
        return np.where((seen >= level).any(0), np.nan, middle)

    pairs = np.stack([values(half), values(-half)], -1).reshape(-1, 2)
    return np.asarray(pairs[(pairs > 0).all(1)])


def _white_radiance(photo: Photo, rig: Rig, white: Array, side: float) -> tuple[Array, Array, Mask]:
    """The squares of paper that the photo shows whole: middles (k, 2), median radiance (k, 3), and
    where some of that is saturated (k, 3)."""
    count = SHEET_FIT.patch_points
    t = ((np.arange(count) + 0.5) / count - 0.5) * SHEET_FIT.patch_inside * side
    grid = np.stack(np.meshgrid(t, t), -1).reshape(-1, 2)
    pixels = rig.project(_on_table(white[:, None] + grid), photo.height, photo.width)
    column, row = np.floor(np.nan_to_num(pixels, nan=-1.0)).astype(int).transpose(2, 0, 1)
    inside = (column >= 0) & (column < photo.width) & (row >= 0) & (row < photo.height)
    use = inside.all(1)
    row, column = row[use], column[use]
    seen = photo.image[row, column]
    level = math.inf if photo.clip_level is None else photo.clip_level
    return white[use], np.median(seen, 1), (seen >= level).any(1)


def undone(sheet: FoundSheet | None, response: Response) -> FoundSheet | None:
    """The sheet as a photo shows it whose tone curve was undone."""
    if sheet is None:
        return None
    radiance = response.undo(Photo(sheet.white_radiance[None])).image[0]
    return replace(sheet, white_radiance=radiance)


@dataclass(frozen=True)
class PaperLight:
    """The light that the paper shows: the screen's ``gain`` (3,) and ``falloff``, and factors on
    what the ball shows of the room and, (3,), on what is guessed of it. ``deviation``: of the
    logarithm of the gain's mean; ``light``: of that of all light on the paper."""

    gain: Array
    falloff: float
    room: float
    lamps: Array
    deviation: float
    light: float


def clear_squares(found: FoundSheet) -> int:
    """How many squares of paper the photo shows unsaturated."""
    return int((~found.white_saturated.any(-1)).sum())


def light_on_paper(found: FoundSheet, lights: Lights, doubt: float = math.inf) -> PaperLight | None:
    """The most probable screen and room by the light on the paper, which shows both together.

    ``lights`` has the pattern, the gain by the ball, of which ``doubt`` is the logarithm's
    deviation (infinite: it is not asked), and the room, whose ``lamps`` are a guess. A factor on
    each, how the display dims to the sides, as far as that is in doubt, what the lens loses towards
    the corners and the paper's own reflectance are fitted together, under log-normal priors.
    Saturated paper has at least the light that the photo shows: without it, the rest would be taken
    as all, which lies in shadows. None where too little paper is to be seen.
    """
    full = found.white_saturated
    if clear_squares(found) < SHEET_FIT.least_patches:
        return None
    cells = SHEET_FIT.screen_cells
    guessed = np.zeros_like(lights.environment) if lights.lamps is None else lights.lamps
    given = np.maximum(np.broadcast_to(np.asarray(lights.gain, float), 3), TINY)
    dims, doubted = lights.device.falloff, lights.fit.get("falloff_deviation", 0.0)
    places = np.append(found.white, [lights.rig.ball_centre * [1, 1, 0]], 0)

    def shown(falloff: float) -> Array:
        device = replace(lights.device, falloff=falloff)
        return screen_irradiance(lights.rig, places, (lights.pattern, given, device), cells)

    screen, less = shown(dims)[:-1], 0.0
    steps = np.zeros_like(screen)
    if doubted:  # of the logarithm by a deviation of the falloff, which the ball's image stays with
        low = max(dims - doubted, 0.0)
        steps = np.log(shown(dims + doubted) / shown(low)) * (doubted / (dims + doubted - low))
        steps, less = steps[:-1] - steps[-1], steps[-1]
    rows = SHEET_FIT.environment_rows
    room, lamps = (
        room_irradiance(lights.rig, found.white, resample_environment(light, rows))
        for light in (lights.environment - guessed, guessed)
    )
    seen = found.white_radiance * (math.pi / PAPER)
    weight = 1 / (SHEET_FIT.patch_noise * np.maximum(seen, TINY))
    channels = min(SCREEN_FIT.white_deviation, doubt)

    # Unknowns: logarithms of the screen's factors, the room's, the lamps' and the paper's;
    # vignetting.
    def errors(x: Array) -> Array:
        bright = (
            screen * np.exp(x[:3] + steps * x[9]) + room * np.exp(x[3]) + lamps * np.exp(x[4:7])
        )
        lens = lens_gain(min(x[8], SHEET_FIT.most_vignetting), found.white_aside)
        off = (bright * np.exp(x[7]) / lens[:, None] - seen) * weight
        off = np.where(full, np.minimum(off, 0), off)
        # Its square is soft_l1's loss: paper in a shadow may be far off, what is known may not.
        off *= np.sqrt(2 / (1 + np.sqrt(1 + off**2)))
        prior = (
            x[:3].mean() / doubt,
            *((x[:3] - x[:3].mean()) / channels),
            x[3] / SHEET_FIT.room_deviation,
            x[4:7].mean() / CLIPPED_LAMPS.deviation,
            *((x[4:7] - x[4:7].mean()) / CLIPPED_LAMPS.channel_deviation),
            x[7] / (PAPER_DEVIATION / PAPER),
            x[8] / SHEET_FIT.vignetting_deviation,
            x[9],
        )
        return np.append(off.ravel(), prior)

    done = least_squares(errors, np.zeros(10))
    covariance = np.linalg.pinv(done.jac.T @ done.jac)
    factors, off = np.exp(done.x), float(done.x[9])
    screen = screen * np.exp(steps * off)
    by = np.zeros(10)
    by[9] = (screen * steps).mean(0) @ factors[:3]
    by[:3], by[4:7] = screen.mean(0) * factors[:3], lamps.mean(0) * factors[4:7]
    by[3] = room.mean(0).sum() * factors[3]
    by /= by[:7].sum()
    return PaperLight(
        given * factors[:3] * np.exp(-less * off),
        float(np.clip(dims + off * doubted, 0, DISPLAY.greatest_falloff)),
        float(factors[3]),
        factors[4:7],
        float(np.sqrt(covariance[:3, :3].mean())),
        float(np.sqrt(by @ covariance @ by)),
    )


def use_paper(
    sheet: FoundSheet | None, lights: Lights, ball: Ball
) -> tuple[Lights, tuple[Notice, ...]]:
    """The lights with the screen's gain by the paper where the ball's image of it is saturated;
    and what is doubtful about sheet, ball and gain together.

    Adds to ``lights.fit``: paper_gain, the gain by the paper over that by the ball, and
    paper_gain_deviation, of its logarithm.
    """
    if sheet is None:
        return lights, ()
    notices = []
    ratio = ball.radius_m / lights.rig.ball_radius
    if abs(math.log(ratio)) > SHEET_FIT.scale:
        text = (
            f"measured by the capture sheet, the ball's radius is {1000 * ball.radius_m:.2f} mm, "
            f"not {1000 * lights.rig.ball_radius:.2f}: either the sheet was printed at "
            f"{1 / ratio:.0%} of its size (the line in its window tells) or [ball] radius is wrong"
        )
        notices.append(Notice("sheet-scale", text))
    free = light_on_paper(sheet, lights) if lights.rig.has_screen else None
    if free is None:
        return lights, tuple(notices)
    off = float(np.mean(free.gain) / np.mean(lights.gain))
    fit = {**lights.fit, "paper_gain": off, "paper_gain_deviation": free.deviation}
    doubt = math.hypot(fit.get("gain_deviation", 0.0), fit.get("ball_reflectance_deviation", 0.0))
    agree = abs(math.log(off)) <= SHEET_FIT.gains_differ * math.hypot(free.deviation, doubt)
    saturated = fit.get("saturated", 0) > SCREEN_FIT.saturated
    both = light_on_paper(sheet, lights, doubt) if agree and doubt > 0 else free
    assert both is not None
    # Where the two contradict each other, the surer one is taken.
    by_paper = saturated and both.deviation < (SHEET_FIT.useful if agree else doubt)
    if by_paper or (agree and both.deviation < doubt):
        lights = _with_light(lights, both)
        # What is left of a tone curve lies between the paper and a darker sample.
        curve = fit.get("curve_exponent", 0.0) * SHEET_FIT.darker
        fit |= {"gain_deviation": both.deviation, "light_deviation": math.hypot(both.light, curve)}
        fit["room_raised"] = fit.get("room_raised", 1.0) * float(both.lamps.mean())
    if by_paper:
        text = (
            f"{fit['saturated']:.0%} of the screen is saturated in the ball; its radiance was "
            f"taken from the capture sheet's paper, to within {both.deviation:.0%}"
        )
        notices.append(Notice("gain-by-paper", text))
        fit["gain_by_paper"] = 1.0
    elif not agree:
        text = (
            f"the light on the capture sheet's paper is {off:.2f} times what the ball's image of "
            "the screen explains: check [ball] reflectance, and that the paper is plain and white"
        )
        notices.append(Notice("paper-contradicts-ball", text))
    return replace(lights, fit=fit), tuple(notices)


def _with_light(lights: Lights, paper: PaperLight) -> Lights:
    """The lights as bright as the paper shows them."""
    gain = paper.gain.astype(np.float32)
    lights = replace(lights, device=replace(lights.device, falloff=paper.falloff))
    if lights.lamps is None:
        return replace(lights, gain=gain)
    lamps = lights.lamps * paper.lamps.astype(np.float32)
    room = (lights.environment - lights.lamps) * np.float32(paper.room) + lamps
    return replace(lights, gain=gain, environment=room, lamps=lamps)
