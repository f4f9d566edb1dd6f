"""Where the screen hangs and what it shows, read from its image in the mirror ball.

The known pattern is registered with the ball's image: the screen's shift and tilt, the display's
curve (a gamma a channel), its gain and the camera's blur are fitted together, by Levenberg's and
Marquardt's steps from coarse to fine. Each pixel is compared with what it should average of the
pattern. Pixels on the screen's edge hold a share of the room beside it; the more, the less certain
they are. An 8-bit file's colours are blurred more than its luma; how much is fitted.

What else a display does (it dims sideways, its channels mix, its black shines) and the tone curve
of an 8-bit file are fitted only where the errors ask for them: a score test (Rao 1948) says how
much they could explain before anything is fitted, and the fit must bear it out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, special
from scipy.spatial.transform import Rotation

from invrender.capture.ball_image import BallImage, screen_coordinates, trace_ball
from invrender.capture.least_squares import minimise
from invrender.capture.response import Response, curve_shares, likely_curves
from invrender.capture.robust import spread as robust_spread
from invrender.capture.settings import DISPLAY, JPEG_GAMMA, JPEG_LUMA, SCREEN_FIT
from invrender.files.images import Photo
from invrender.files.tone_curves import KNOTS
from invrender.lights import GAMMAS, IDEAL, STEEPEST_FALLOFF, Device
from invrender.rig import Rig
from invrender.sampling import means_of_blocks, resize_pattern
from invrender.types import TINY, Array, InputError


@dataclass(frozen=True)
class Screen:
    """The screen as the ball shows it.

    ``rig``: with the screen's shift and tilt; ``device``: what the display makes of the pattern;
    its radiance is ``gain`` (3,) times that. ``response``: the photo's tone curve, None where it is
    taken as straight. ``blur`` is the camera's in pixels, ``residual`` the fit's RMS over the mean
    gain, ``ideal_residual`` that of the screen as it should be, ``deviation`` the standard
    deviations that the fit expects of the shift (metres) and the tilt (degrees),
    ``gain_deviation`` that of the logarithm of the screen's light, ``falloff_deviation`` that of
    the display's falloff, nought where it is taken as it should be, ``pixels`` the number that lie
    on the screen and are not saturated, ``saturated`` the share that is.
    """

    rig: Rig
    device: Device
    gain: Array
    response: Response | None
    blur: float
    residual: float
    ideal_residual: float
    deviation: tuple[float, float]
    gain_deviation: float
    falloff_deviation: float
    pixels: int
    saturated: float


def fit_screen(
    photo: Photo,
    rig: Rig,
    image: BallImage,
    pattern: Array,
    device: Device = IDEAL,
    printed: Array | None = None,
) -> Screen:
    """Register the ``pattern`` (h, w, 3), relative radiance, with the ball's image of the screen.

    Gain and blur are fitted first, for the screen as it should be, a ``device`` that is known among
    that. Where that fits worse than to
    `SCREEN_FIT.poor`, or the screen is saturated, its pose and the display's curve are fitted too;
    where more than `SCREEN_FIT.no_curve` is saturated the curve cannot be told from the gain, and a
    camera's is taken as it usually is. Then what the errors ask for: the display's other
    properties, and an 8-bit file's tone curve, unless the photo is linear; ``printed``, ink and
    paper of a capture sheet, tells of that (`likely_curves`). Raises `InputError` if
    the ball cannot show the screen, or shows it saturated or dark.
    """
    fit = _Fit(photo, rig, image, pattern, device, printed)
    u = fit.start()
    for stage in SCREEN_FIT.stages[-2:]:
        u = fit.solve(u, *stage)
    ideal = fit.result(u)
    if ideal.residual < SCREEN_FIT.poor and ideal.saturated < SCREEN_FIT.saturated:
        return ideal
    if fit.curved_file and ideal.saturated >= SCREEN_FIT.no_curve:
        fit.hidden = True
        ideal = fit.result(u)
    if printed is not None and ideal.saturated >= SCREEN_FIT.no_curve and device == IDEAL:
        fit.assume_falloff()  # the paper will tell how much
    fit.free[:_COLOUR] = True
    fit.free[_GAMMA] = ideal.saturated < SCREEN_FIT.no_display
    if ideal.saturated >= SCREEN_FIT.no_curve:
        fit.set_gamma_prior(DISPLAY.gamma_deviation)
    if not fit.free[_GAMMA.start]:  # what is left of the screen tells little of its colour
        fit.prior[_GAIN, _GAIN] = _APART / SCREEN_FIT.white_deviation**2
    start, found = u, None
    # If the greatest blur leads astray, without it; a display that dims misleads the pose.
    for dims, first in ((False, 0), (False, 2), (True, 0), (True, 2)):
        if dims and not fit.free[_GAMMA.start]:
            break
        fit.free[_FALLOFF] = dims
        u = fit.start()
        for blurred, least in SCREEN_FIT.stages[first:]:
            u = fit.solve(u, blurred * max(1.0, fit.radius / SCREEN_FIT.stage_radius), least)
        better = fit.cost(start) - fit.cost(u) > SCREEN_FIT.better
        residual = fit.result(u).residual
        # Few pixels that nothing contradicts fit best of all, with a display like no other.
        likely = fit.is_display(u) and fit.size(u) > SCREEN_FIT.least_part * fit.size(start)
        # A screen far off has another room behind it, under which the nominal one may look worse.
        if better and likely and residual < (found[0] if found else ideal.residual):
            found = residual, dims, u
        if found and (dims or found[0] < SCREEN_FIT.good):
            break
    if found:
        fit.free[_FALLOFF], u = found[1:]
        u = fit.solve(u, *SCREEN_FIT.stages[-1])
    # A saturated pixel had at least so much light, which the ideal screen alone may not explain.
    if not found and ideal.saturated <= SCREEN_FIT.saturated:
        return ideal
    if ideal.saturated < SCREEN_FIT.no_display:
        u = fit.explain(u, fit.curved_file and ideal.saturated < SCREEN_FIT.no_curve)
    return replace(fit.result(u), ideal_residual=ideal.residual)


# Places of the unknowns: shift and tilt in units of their priors, log gamma and log gain a channel,
# log blur in pixels, the log of the further blur of an 8-bit file's colours; the display's falloff,
# black and mixing (off the diagonal, row by row), and the tone curve's logs: nought if absent.
_SHIFT, _TILT, _GAMMA, _GAIN, _BLUR, _COLOUR, _FALLOFF, _BLACK, _MIXING, _CURVE = (
    slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12, 13, 14, 15, slice(16, 22),
    slice(22, 22 + len(KNOTS)),
)  # fmt: skip
_COUNT = _CURVE.stop
_DEVICE = slice(_FALLOFF, _MIXING.stop)
_APART = np.eye(3) - 1 / 3  # of what channels differ from their mean
_PAIRS = [(i, j) for i in range(3) for j in range(3) if i != j]  # of channels: `_MIXING`


def _times(lines: Array, forms: Array) -> Array:
    """Lines (..., 6) times forms (6, m), by one product of matrices: (m, ...)."""
    return np.asarray(forms.T @ lines.reshape(-1, 6).T).reshape(-1, *lines.shape[:-1])


def _rows(image: Array, matrix: Array) -> Array:
    """Images (..., 3) times a matrix (3, m), by one product: (..., m)."""
    return np.asarray((image.reshape(-1, 3) @ matrix).reshape(*image.shape[:-1], -1))


def _cover(s: Array, slopes: bool) -> list[Array]:
    """Share of each sub-pixel (n, n, h, w) whose coordinate lies in [0, 1]; its derivative."""
    across = np.abs(s[:, -1:] - s[:, :1]) + np.abs(s[-1:] - s[:1])
    width = np.maximum(across / (len(s) - 1), SCREEN_FIT.least_width)
    cover = 0.5 + (0.5 - abs(s - 0.5)) / width
    out: list[Array] = [np.clip(cover, 0, 1)]
    if slopes:
        out.append(np.where((cover > 0) & (cover < 1), -np.sign(s - 0.5) / width, 0))
    return out


def _look_up(image: Array, s: Array, t: Array, slopes: bool) -> list[Array]:
    """Bilinear look-ups (3, ...) in (n, n, 3), row 0 at t = 1; their derivatives by s and t.

    Written by hand for the derivatives, which `scipy.ndimage` does not give.
    """
    n = len(image)
    last = n - SCREEN_FIT.last_cell
    x, y = (np.clip(q * n - 0.5, 0, last) for q in (s, 1 - t))
    i, j = y.astype(int), x.astype(int)
    fy, fx = y - i, x - j
    planes, k = np.moveaxis(image, -1, 0).reshape(3, n * n), i * n + j
    corners = [planes.take(k + d, 1) for d in (0, 1, n, n + 1)]
    top, bottom = (a + fx * (b - a) for a, b in (corners[:2], corners[2:]))
    out = [top + fy * (bottom - top)]
    if slopes:
        right = [b - a for a, b in (corners[:2], corners[2:])]
        inside = [((q > 0) & (q < last)) * n for q in (x, y)]
        out += [(right[0] + fy * (right[1] - right[0])) * inside[0], (top - bottom) * inside[1]]
    return out


def _blur(image: Array, sigma: float) -> Array:
    """Images (..., H, W, C) blurred by a Gaussian, averaged over each pixel of the kernel.

    It is smooth in sigma down to none, and its tails fall as a Gaussian's: beside a bright block a
    dark one has more of the neighbour's tail than of its own light.
    """
    import cv2  # it takes 0.1 s, and a capture is loaded without it

    radius = int(4 * sigma) + 2
    kernel = np.diff(special.ndtr((np.arange(-radius, radius + 2) - 0.5) / sigma))
    kernel /= kernel.sum()
    images = image.reshape(-1, *image.shape[-3:])
    border = cv2.BORDER_REPLICATE
    out = [cv2.sepFilter2D(i, -1, kernel, kernel, borderType=border) for i in images]
    return np.asarray(out).reshape(image.shape)


class _Fit:
    """The ball's image around the screen, the rays that its sub-pixels see, and the fit's steps."""

    def __init__(
        self, photo: Photo, rig: Rig, image: BallImage, pattern: Array, device: Device = IDEAL,
        printed: Array | None = None,
    ) -> None:  # fmt: skip
        self.rig, self.full = rig, pattern
        self.free = np.zeros(_COUNT, bool)
        self.free[_GAIN], self.free[_BLUR] = True, True
        self.free[_COLOUR] = self.coded = photo.clip_level is not None
        self.curved_file = self.coded and not photo.linear
        self.asked, self.hidden, self.undone = False, False, photo.curve_deviation
        self.assumed = False
        ball = image.ball
        self.step = step = max(1, round(ball.radius / SCREEN_FIT.finest))
        self.radius = ball.radius / step
        n = next(count for radius, count in SCREEN_FIT.sub_pixels if self.radius < radius)
        rows, columns = self._area(rig, image, step)
        area = photo.image[rows, columns]
        h, w = area.shape[0] // step, area.shape[1] // step
        area = area[: h * step, : w * step]
        self.reflectance = reflectance = np.asarray(rig.ball_reflectance, np.float32)
        self.observed = means_of_blocks(area, step, float) / reflectance
        self.level = np.full(3, photo.clip_level or np.inf) / reflectance
        self.saturated = area.reshape(h, step, w, step, 3).max((1, 3)) / reflectance >= self.level
        # What a file's white cuts off is cut off before colours are blurred.
        top = self.observed.max((0, 1))
        self.white = np.where(top >= self.level, top, math.inf)
        if self.coded:  # half the resolution of colours leaves errors: they are compared pooled
            encoded = np.maximum(self.observed, 0) ** (1 / JPEG_GAMMA)
            luma = (encoded @ np.array(JPEG_LUMA))[..., None]
            colours = _blur(encoded - luma, SCREEN_FIT.colour_pooling)
            self.observed = np.maximum(luma + colours, 0) ** JPEG_GAMMA
        # Mirrored rays of the sub-pixels (n, n, h, w) as lines in space, moment and direction
        # (Plücker): where one meets a plane is a fraction of linear forms in it.
        at = (np.arange(n) + 0.5) * step / n
        y = rows.start + step * np.arange(h)[:, None] + at[:, None, None, None]
        x = columns.start + step * np.arange(w) + at[:, None, None]
        point, mirrored, seen = trace_ball(rig, ball, np.stack(np.broadcast_arrays(x, y), -1))
        self.lines = np.concatenate([np.cross(point, mirrored), mirrored], -1)
        self.seen = seen & (mirrored[..., 2] > SCREEN_FIT.upward[0])
        # In double precision: near the minimum a step's gain shows in the last digits only.
        coarse = resize_pattern(pattern, min(SCREEN_FIT.cells, len(pattern)))
        self.pattern = np.maximum(coarse.astype(float), SCREEN_FIT.least_pattern)
        self.prior_mean = np.zeros(_COUNT)
        self.prior_mean[_GAMMA] = np.log(device.gamma)
        self.prior_mean[[_FALLOFF, _BLACK]] = device.falloff, device.black
        mixing = np.asarray(device.mixing)
        if photo.matrix is not None:  # what is red in Rec. 709 has some green in wider primaries
            mixing = np.maximum(np.linalg.inv(photo.matrix) @ mixing, 0)
        mixing = mixing / mixing.sum(1, keepdims=True)  # the rest is the gain's
        self.prior_mean[_MIXING] = [mixing[pair] for pair in _PAIRS]
        self.prior_mean[_BLUR] = math.log(SCREEN_FIT.expected_blur)
        self.prior_mean[_COLOUR] = math.log(SCREEN_FIT.colour_blur / step)
        self.prior = np.zeros((_COUNT, _COUNT))
        deviations = np.full(_COUNT, math.inf)
        deviations[:6] = 1
        deviations[[_BLUR, _COLOUR]] = SCREEN_FIT.blur_deviation
        deviations[[_FALLOFF, _BLACK]] = DISPLAY.falloff_deviation, DISPLAY.black_deviation
        deviations[_MIXING] = DISPLAY.mixing_deviation
        np.fill_diagonal(self.prior, 1 / deviations**2)
        self.prior_mean[_CURVE], self.prior[_CURVE, _CURVE] = likely_curves(printed)
        self.set_gamma_prior(SCREEN_FIT.gamma_deviation)
        self.focus(0.0)

    def set_gamma_prior(self, deviation: float) -> None:
        """The deviation of the display's log gamma, of the channels' mean."""
        apart = _APART / SCREEN_FIT.channel_deviation**2
        self.prior[_GAMMA, _GAMMA] = apart + 1 / 9 / deviation**2

    def assume_falloff(self) -> None:
        """Let the display dim to the sides as displays do."""
        self.prior_mean[_FALLOFF] = DISPLAY.usual_falloff
        self.prior[_FALLOFF, _FALLOFF] = 1 / DISPLAY.usual_deviation**2
        self.assumed = True

    def focus(self, blurred: float) -> None:
        """Take the image ``blurred`` further for what follows."""
        self.blurred, self.image, self.clipped = blurred, self.observed, self.saturated
        if blurred:
            self.image = ndimage.gaussian_filter(self.observed, (blurred, blurred, 0))
            self.clipped = ndimage.maximum_filter(self.saturated, (3, 3, 1))

    @staticmethod
    def _area(rig: Rig, image: BallImage, step: int) -> tuple[slice, slice]:
        """Rows and columns of the photo that may show the screen, wherever it hangs."""
        rows, columns, radius = image.rows, image.columns, image.ball.radius
        s, t, _ = screen_coordinates(rig, image.point, image.mirrored)
        reach = SCREEN_FIT.near
        near = image.visible & (image.mirrored[..., 2] > SCREEN_FIT.upward[1])
        with np.errstate(invalid="ignore"):
            near &= (abs(s - 0.5) < reach) & (abs(t - 0.5) < reach)
        if not near.any():
            raise InputError("the ball cannot show the screen: check the rig's sizes")
        y, x = np.nonzero(near)
        margin = math.ceil(SCREEN_FIT.window_margin * radius) + (SCREEN_FIT.edge + 4) * step
        return (
            slice(max(rows.start, rows.start + y.min() - margin),
                  min(rows.stop, rows.start + y.max() + 1 + margin)),
            slice(max(columns.start, columns.start + x.min() - margin),
                  min(columns.stop, columns.start + x.max() + 1 + margin)),
        )  # fmt: skip

    def moved(self, u: Array) -> Rig:
        """The rig with the screen where ``u`` puts it."""
        shift = u[_SHIFT] * SCREEN_FIT.shift_deviation * self.rig.sample_size
        tilt = u[_TILT] * SCREEN_FIT.tilt_deviation
        return replace(
            self.rig,
            screen_shift=tuple(np.add(self.rig.screen_shift, shift)),
            screen_tilt=tuple(np.add(self.rig.screen_tilt, tilt)),
        )

    def forms(self, u: Array) -> Array:
        """(..., 6, 3): a line times this, (a, b, c), meets the screen's plane at s = a/c, t = b/c.

        The unknowns ``u`` (..., 14) may be several.
        """
        e_x, e_y, corner = self.screen(u)
        a = np.concatenate([-e_y, np.cross(e_y, corner)], -1)
        b = np.concatenate([e_x, np.cross(corner, e_x)], -1)
        return np.stack([a, b, np.concatenate([0 * e_x, np.cross(e_x, e_y)], -1)], -1)

    def screen(self, u: Array) -> tuple[Array, Array, Array]:
        """The screen's sides and corner as `moved` has them, (..., 3) each."""
        tilt = np.asarray(u[..., _TILT] * SCREEN_FIT.tilt_deviation + self.rig.screen_tilt)
        turn = Rotation.from_rotvec(tilt.reshape(-1, 3), degrees=True).as_matrix()
        width, depth = self.rig.screen_sides
        turn = turn.reshape(*tilt.shape, 3)
        e_x, e_y = width * turn[..., 0], depth * turn[..., 1]
        level = sum(self.rig.screen_edges) / 2 + self.rig.screen_corner
        middle = level + u[..., _SHIFT] * SCREEN_FIT.shift_deviation * self.rig.sample_size
        return e_x, e_y, middle - (e_x + e_y) / 2

    def look(self, u: Array, slopes: bool = False) -> Array:
        """What the pixels average of the curved pattern and, last, the screen's share:
        (1, H, W, 4). Of a display that dims sideways (1, H, W, 5): before the share what the pixels
        average of white.

        With ``slopes`` their derivatives too, (n, H, W, ...): by shift and tilt where they are
        free, by falloff where that is, by log gamma, each channel's by its own, and by blur.
        """
        forms = self.forms(u)
        a, b, c = _times(self.lines, forms)
        front = self.seen & (c > 0)
        c = np.where(front, c, 1)
        s, t = a / c, b / c
        cover_s, *edge_s = _cover(s, slopes)
        cover_t, *edge_t = _cover(t, slopes)
        cover_s *= front
        on = (cover_s * cover_t > 0).any((0, 1))
        # Pixels last: numpy is slow along short axes.
        s, t, c, cover_s, cover_t = (q[:, :, on] for q in (s, t, c, cover_s, cover_t))
        lines = self.lines[:, :, on]
        cover = cover_s * cover_t
        gamma = np.exp(u[_GAMMA])
        shown = self.pattern**gamma
        light, *by_place = _look_up(shown, s, t, slopes)
        dims = bool(self.free[_FALLOFF] or u[_FALLOFF])
        white = np.ones_like(cover)
        if dims:
            e_x, e_y, _ = self.screen(u)
            up = np.cross(e_x, e_y)
            cosine = lines[..., 3:] @ (up / np.linalg.norm(up))
            log_cosine = np.log(np.maximum(cosine, SCREEN_FIT.upward[0]))
            white = np.exp(u[_FALLOFF] * log_cosine)
            light, by_place = light * white, [d * white for d in by_place]

        def stack(light: Array, white: Array, share: Array) -> Array:
            return np.stack([*light, white, share] if dims else [*light, share])

        parts = [stack(light * cover, white * cover, cover)]
        if slopes:
            edges = (edge_s[0][:, :, on] * cover_t, edge_t[0][:, :, on] * cover_s)
            by_s, by_t = (
                stack(d * cover + light * e, white * e, e)
                for d, e in zip(by_place, edges, strict=True)
            )
            if self.free[0]:
                step = SCREEN_FIT.difference
                change = (self.forms(u + step * np.eye(6, _COUNT)) - forms) / step
                moved = _times(lines, np.concatenate(list(change), -1))
                for da, db, dc in moved.reshape(6, 3, *s.shape):
                    parts.append(by_s * ((da - s * dc) / c) + by_t * ((db - t * dc) / c))
            if self.free[_FALLOFF]:
                by_falloff = log_cosine * cover
                parts.append(stack(light * by_falloff, white * by_falloff, 0 * cover))
            (curve,) = _look_up(shown * np.log(self.pattern) * gamma, s, t, False)
            parts.append(stack(curve * white * cover, 0 * cover, 0 * cover))
        out = np.zeros((len(parts), *on.shape, len(parts[0])))
        for part, image in zip(parts, out, strict=True):
            image[on] = part.mean((1, 2)).T
        return self.blur(out, u, slopes)

    @staticmethod
    def mixing(u: Array) -> Array:
        """How much of each channel appears in each, (3, 3); the rows sum to 1."""
        mixing = np.eye(3)
        for (i, j), value in zip(_PAIRS, u[_MIXING], strict=True):
            mixing[i, j] += value
            mixing[i, i] -= value
        return mixing

    def device(self, u: Array) -> Device:
        """The display that ``u`` describes."""
        gamma = tuple(np.clip(np.exp(u[_GAMMA]), *GAMMAS).tolist())
        red, green, blue = ((r, g, b) for r, g, b in self.mixing(u).tolist())
        falloff = float(np.clip(u[_FALLOFF], 0, STEEPEST_FALLOFF))
        return Device(falloff, gamma, float(u[_BLACK]), (red, green, blue))

    def blur(self, out: Array, u: Array, slope: bool) -> Array:
        """Images (n, H, W, C) blurred as the camera does; last, if asked for, the slope by that."""
        step = SCREEN_FIT.difference
        sigma, wider = (math.hypot(math.exp(u[_BLUR] + d), self.blurred) for d in (0, step))
        blurred = _blur(out, sigma)
        if not slope:
            return np.asarray(blurred)
        more = _blur(out[:1], wider)
        return np.concatenate([blurred, (more - blurred[:1]) / step])

    def size(self, u: Array) -> int:
        """How many pixels lie wholly on the screen."""
        return int((self.look(u)[0][..., -1] > SCREEN_FIT.inside).sum())

    @staticmethod
    def is_display(u: Array) -> bool:
        """Whether displays dim as ``u`` says."""
        return bool(0 <= u[_FALLOFF] <= DISPLAY.greatest_falloff)

    def start(self) -> Array:
        """The nominal pose, a straight curve and the gain that fits them best."""
        u = self.prior_mean.copy()
        u[_CURVE] = 0  # straight until the errors ask for a curve
        seen = self.look(u)[0]
        inside = seen[..., -1] > SCREEN_FIT.inside
        if inside.sum() < SCREEN_FIT.least_inside:
            raise InputError(
                "the ball's image shows too little of the screen: check the rig's sizes"
            )
        light = self.image[inside].mean(0) / seen[inside].mean(0)[:3]
        if not (light > 0).all():
            raise InputError("the screen is dark in the ball's image: is the pattern displayed?")
        u[_GAIN] = np.log(light)
        return u

    def background(self, image: Array, share: Array) -> tuple[Array, Array]:
        """The room's radiance (H, W, 3) continued behind the screen, and how much it varies."""
        margin = SCREEN_FIT.room_margin * (1 + self.blurred) + SCREEN_FIT.edge / 2
        room = ndimage.distance_transform_edt(share < SCREEN_FIT.outside) > margin
        if not room.any():
            level = np.broadcast_to(np.median(image, (0, 1)), image.shape)
            return level, level
        size = SCREEN_FIT.room_window
        weight = ndimage.uniform_filter(room.astype(np.float32), size) + SCREEN_FIT.least_share
        mean, square = (
            ndimage.uniform_filter(a * room[..., None], (size, size, 1)) / weight[..., None]
            for a in (image, image * image)
        )
        spread = np.sqrt(np.maximum(square - mean * mean, 0)) + SCREEN_FIT.room_spread * mean
        y, x = ndimage.distance_transform_edt(~room, return_distances=False, return_indices=True)
        return image[y, x], spread[y, x]

    def solve(self, u: Array, blurred: float, least: float) -> Array:
        """The fit from ``u`` on to the image ``blurred`` further (Levenberg and Marquardt).

        A step that gains ``least`` of the cost or less is the last one. What is not fitted, the
        errors' deviations and the room behind the screen, is as ``u`` has it.
        """
        self.focus(blurred)
        self.prepare(u)

        def whole(free: Array) -> Array:
            unknowns = u.copy()
            unknowns[self.free] = free
            return unknowns

        found = minimise(
            u[self.free],
            lambda free, _: (self.cost(whole(free)), None),
            lambda free, _: self.normal_equations(whole(free)),
            steps=SCREEN_FIT.steps,
            longest=SCREEN_FIT.longest_step,
            enough=lambda gained, cost: gained < least * (cost - gained),
        )
        return whole(found.unknowns)

    def prepare(self, u: Array) -> None:
        """The room behind the screen, the pixels to compare and what to expect of their errors, for
        the screen at ``u``."""
        seen = self.look(u)[0]
        share = seen[..., -1]
        self.room, spread = self.background(self.image, share)
        self.use = ndimage.distance_transform_edt(share < SCREEN_FIT.outside) <= SCREEN_FIT.edge
        self.deviation = 1.0
        error = self.errors(u, seen)
        level = float(np.exp(u[_GAIN]).mean())
        model = self.expected(u, seen)
        shot = np.sqrt(level * (model + SCREEN_FIT.dark_noise * level))
        inside = (share > SCREEN_FIT.inside)[..., None] & ~self.clipped
        relative = (error / shot)[inside]
        noise = float(robust_spread(relative)) if relative.size else SCREEN_FIT.first_noise
        noise = max(noise, SCREEN_FIT.least_noise)
        self.deviation = np.hypot(noise * shot, (1 - share)[..., None] * spread)

    def errors(self, u: Array, seen: Array) -> Array:
        """Observed less expected (H, W, 3), in deviations, where the pixels have ``seen`` that.

        A saturated pixel says only that there is at least so much light.
        """
        error = self.image - self.code(u, self.expected(u, seen))
        over = np.maximum(error + self.level - self.image, 0)
        return np.asarray(np.where(self.clipped, over, error) / self.deviation)

    def raw(self, u: Array, seen: Array) -> Array:
        """Relative radiance (..., 3) before the channels mix, or its derivative."""
        black = u[_BLACK]
        return np.asarray(seen[..., :3] * (1 - black) + black * seen[..., 3:4])

    def expected(self, u: Array, seen: Array) -> Array:
        """Radiance (..., H, W, 3) of the pixels; or its derivative by what changes ``seen``."""
        light = _rows(self.raw(u, seen), self.mixing(u).T * np.exp(u[_GAIN]))
        room = (1 - seen[..., -1:]) if seen.ndim == 3 else -seen[..., -1:]
        return np.asarray(light + room * self.room)

    def code(self, u: Array, model: Array, slopes: Array | None = None) -> Array:
        """Radiance (H, W, 3) as an 8-bit file has it; or (n, H, W, 3), the ``slopes`` as that
        changes them.

        The camera's tone curve comes first. A JPEG's colours, differences to luma, all three
        through a display's curve, are blurred.
        """
        if not self.coded:
            return model if slopes is None else slopes
        if self.free[_CURVE].any():
            curved, steep = self.curved(u, model)
            if slopes is not None:
                slopes = slopes * (steep * curved / np.maximum(model, TINY))
            model = curved
        if slopes is not None:
            slopes = np.where(model < self.white, slopes, 0)
        model = np.clip(model, SCREEN_FIT.least_radiance[0], self.white)
        mixed = self.blur_colours(u, model ** (1 / JPEG_GAMMA))
        mixed = np.maximum(mixed, SCREEN_FIT.least_radiance[1])
        if slopes is None:
            return np.asarray(mixed**JPEG_GAMMA)
        by_code = self.blur_colours(u, slopes * model ** (1 / JPEG_GAMMA - 1))
        return np.asarray(by_code * mixed ** (JPEG_GAMMA - 1))

    def curved(self, u: Array, model: Array) -> tuple[Array, Array]:
        """Radiance (H, W, 3) after the camera's tone curve, and how steep that is there."""
        value, steep = Response(tuple(u[_CURVE])).apply(model * self.reflectance)
        return value / self.reflectance, steep

    @staticmethod
    def blur_colours(u: Array, image: Array) -> Array:
        """Encoded images (..., H, W, 3) with their colours blurred as ``u`` says."""
        luma = _rows(image, np.array(JPEG_LUMA)[:, None])
        sigma = math.hypot(math.exp(u[_COLOUR]), SCREEN_FIT.colour_pooling)
        return np.asarray(luma + _blur(image - luma, sigma))

    def cost(self, u: Array) -> float:
        """Cauchy's loss of the errors and half the prior's square; infinite for no possible rig."""
        e_x, e_y, corner = self.screen(u)
        if not corner[2] + min(e_x[2], 0) + min(e_y[2], 0) > 0:  # it reaches below the table
            return math.inf
        seen = self.look(u)[0]
        r = self.errors(u, seen)[self.use]
        robust = SCREEN_FIT.robust
        loss = robust**2 / 2 * np.log1p((r / robust) ** 2).sum()
        return float(loss) + self.unlikely(u)

    def unlikely(self, u: Array) -> float:
        """The cost under the priors of what is fitted."""
        off = np.where(self.free, u - self.prior_mean, 0)
        return float(off @ self.prior @ off / 2)

    def normal_equations(self, u: Array) -> tuple[Array, Array]:
        """Gauss–Newton's matrix and right side for the free unknowns, with Cauchy's weights."""
        seen, *slopes = self.look(u, True)
        r = self.errors(u, seen)[self.use]
        model = self.expected(u, seen)
        by = np.zeros((_COUNT, *model.shape))
        *places, curves, blurs = slopes
        known = [*range(6)] * bool(self.free[0]) + [_FALLOFF] * bool(self.free[_FALLOFF]) + [_BLUR]
        by[known] = self.expected(u, np.stack([*places, blurs]))
        gain, mixing, light = np.exp(u[_GAIN]), self.mixing(u), self.raw(u, seen)
        for c in range(3):
            by[6 + c] = curves[..., c : c + 1] * (1 - u[_BLACK]) * mixing[:, c] * gain
            by[9 + c, ..., c] = light @ mixing[c] * gain[c]
        if self.free[_DEVICE].any():
            by[_BLACK] = (seen[..., 3:4] - seen[..., :3]) @ mixing.T * gain
            for k, (i, j) in enumerate(_PAIRS):
                by[_MIXING.start + k, ..., i] = gain[i] * (light[..., j] - light[..., i])
        if self.free[_CURVE].any():
            curved, _ = self.curved(u, model)
            by[_CURVE] = -np.moveaxis(curve_shares(curved * self.reflectance), -1, 0) * model
        by = self.code(u, model, by[self.free])
        if self.coded:
            step = SCREEN_FIT.difference
            more = u + step * (np.arange(_COUNT) == _COLOUR)
            change = (self.code(more, model) - self.code(u, model)) / step
            by[np.count_nonzero(self.free[:_COLOUR])] = change
        jacobian = np.moveaxis(by / self.deviation, 0, -1)[self.use]
        jacobian[self.clipped[self.use] & (r == 0)] = 0
        j = jacobian.reshape(r.size, -1)
        weighted = j / (1 + (r.reshape(-1, 1) / SCREEN_FIT.robust) ** 2)
        prior = self.prior[self.free]
        matrix = j.T @ weighted + prior[:, self.free]
        return matrix, weighted.T @ r.reshape(-1) - prior @ (u - self.prior_mean)

    def residual(self, error: Array) -> float:
        """Root mean square of absolute errors (n, 3), with Huber's weights."""
        if not error.size:
            return 0.0
        weight = np.minimum(1, 2 * np.median(error, 0) / np.maximum(error, TINY))
        return float(np.sqrt(((weight * error**2).sum(0) / weight.sum(0)).mean()))

    def explain(self, u: Array, curve: bool) -> Array:
        """The fit from ``u`` on with those of the display's other properties, and with ``curve`` of
        the file's tone curve, that the errors ask for, one after the other."""
        blocks = [_DEVICE] + [_CURVE] * curve
        self.asked = curve
        while blocks:
            tests = [self.score(u, block) for block in blocks]
            block, was = blocks.pop(int(np.argmax(tests))), self.free.copy()
            if max(tests) < self.least_gain(u):
                break
            tried = self.with_block(u, block)
            gained, needed = self.cost(u) - self.cost(tried), self.least_gain(tried)
            no_curve = block == _CURVE and not Response(tuple(tried[_CURVE])).is_likely
            if gained < needed or no_curve or not self.is_display(tried):
                self.drop(block)
                self.free = was
                self.prepare(u)
            else:
                u = tried
        return u

    def least_gain(self, u: Array) -> float:
        """By how much the cost must fall for further unknowns to be believed."""
        return max(SCREEN_FIT.better, DISPLAY.least_gain * self.cost(u))

    def with_block(self, u: Array, block: slice) -> Array:
        """The fit from ``u`` on with a further block of unknowns."""
        self.free[block] = True
        if block == _CURVE:  # a display's gamma and a camera's power look alike
            self.set_gamma_prior(DISPLAY.gamma_deviation / SCREEN_FIT.correlated)
        for stage in SCREEN_FIT.stages[-2:]:
            u = self.solve(u, *stage)
        place = np.arange(_COUNT)
        device = (place >= _DEVICE.start) & (place < _DEVICE.stop)
        while (device & (u < 0)).any():  # no display has that: it has none of it
            self.free &= ~(device & (u < 0))
            u = self.solve(np.where(device, np.maximum(u, 0), u), *SCREEN_FIT.stages[-1])
        return u

    def drop(self, block: slice) -> None:
        """Fit a block of unknowns no more."""
        self.free[block] = False
        if block == _CURVE:
            self.set_gamma_prior(SCREEN_FIT.gamma_deviation)

    def score(self, u: Array, block: slice) -> float:
        """By how much the cost may fall with a block of unknowns, by its slope and curvature."""
        was, likely = self.free.copy(), self.unlikely(u)
        self.free[block] = True
        matrix, right = self.normal_equations(u)
        lost = self.unlikely(u) - likely
        self.free = was
        return float(right @ np.linalg.solve(matrix, right)) / 2 - lost

    def result(self, u: Array) -> Screen:
        """What the fit says."""
        gain, device = np.exp(u[_GAIN]), self.device(u)
        seen = self.look(u)[0]
        inside = seen[..., -1] > SCREEN_FIT.inside
        unclipped = inside & ~self.clipped.any(-1)
        error = np.abs(self.errors(u, seen) * self.deviation)
        residual = self.residual(error[unclipped]) / float(gain.mean())
        covariance = self.covariance(u)
        spread = np.sqrt(np.diag(covariance)[:6])
        shift = SCREEN_FIT.shift_deviation * self.rig.sample_size
        return Screen(
            rig=self.moved(u),
            device=device,
            gain=gain,
            response=self.response(u, covariance),
            blur=math.exp(u[_BLUR]) * self.step,
            residual=residual,
            ideal_residual=residual,
            deviation=(
                float(np.linalg.norm(spread[:3])) * shift,
                float(np.linalg.norm(spread[3:])) * SCREEN_FIT.tilt_deviation,
            ),
            gain_deviation=self.gain_deviation(u, covariance),
            falloff_deviation=self.falloff_deviation(covariance),
            pixels=int(unclipped.sum()) * self.step**2,
            saturated=float(1 - unclipped.sum() / max(inside.sum(), 1)),
        )

    def covariance(self, u: Array) -> Array:
        """That of all unknowns, nought for those that are known. The display's curve counts as
        unknown even where it could not be fitted, and so does that of a file that may have one."""
        was = self.free.copy()
        if self.free[0] or self.coded:
            if self.coded or not self.free[_GAMMA].any():
                self.set_gamma_prior(DISPLAY.gamma_deviation)
            self.free[_GAMMA], self.free[_CURVE] = True, self.curved_file
        out = np.zeros((_COUNT, _COUNT))
        out[np.ix_(self.free, self.free)] = np.linalg.inv(self.normal_equations(u)[0])
        self.free = was
        return out

    def gain_deviation(self, u: Array, covariance: Array) -> float:
        """Standard deviation of the logarithm of the screen's light over the sample's, the
        channels' mean."""
        shown = self.pattern ** np.exp(u[_GAMMA])
        by = np.zeros(_COUNT)
        by[_GAIN] = 1 / 3
        log = np.log(self.pattern) * np.exp(u[_GAMMA])
        by[_GAMMA] = (shown * log).mean((0, 1)) / shown.mean((0, 1)) / 3
        span = self.curve_span(u)
        by[_CURVE] = span
        fitted = float(np.sqrt(by @ covariance @ by)) * SCREEN_FIT.correlated
        unknown = 0.0
        if self.hidden:
            unknown = self.usual_deviation(span)
        elif self.curved_file and not self.asked:  # straight, or as cameras' curves are
            unknown = float(span @ self.prior_mean[_CURVE])
        return math.hypot(fitted, unknown, self.undone)

    def falloff_deviation(self, covariance: Array) -> float:
        """Of the display's falloff, where it is fitted or assumed."""
        usual = DISPLAY.usual_deviation if self.assumed else 0.0
        if not self.free[_FALLOFF]:
            return usual
        fitted = SCREEN_FIT.correlated * math.sqrt(covariance[_FALLOFF, _FALLOFF])
        return min(fitted, usual) if self.assumed else fitted

    def curve_span(self, u: Array) -> Array:
        """What each knot of a tone curve adds to the logarithm of the screen's light over the
        sample's, which is so much darker."""
        white = np.exp(u[_GAIN]).mean(keepdims=True) * self.reflectance.mean()
        sample = np.minimum(DISPLAY.sample * white, DISPLAY.brightest_sample)
        return curve_shares(white)[0] - curve_shares(sample)[0]

    def usual_deviation(self, span: Array) -> float:
        """That of cameras' curves about their mean, of what ``span`` adds up."""
        return math.sqrt(float(span @ np.linalg.inv(self.prior[_CURVE, _CURVE]) @ span))

    def response(self, u: Array, covariance: Array) -> Response | None:
        """The file's tone curve: as fitted; as cameras' curves are, where it could not be asked
        since much is saturated; None where it is straight."""
        span = self.curve_span(u)
        if self.free[_CURVE].any():
            variance = span @ covariance[_CURVE, _CURVE] @ span
            fitted = SCREEN_FIT.correlated * math.sqrt(float(variance))
            return Response(tuple(u[_CURVE].tolist()), fitted)
        if not self.hidden:
            return None
        usual = tuple(self.prior_mean[_CURVE].tolist())
        return Response(usual, self.usual_deviation(span), measured=False)
