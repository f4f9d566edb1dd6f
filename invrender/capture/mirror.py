"""The image of a mirror ball: where in a photo its outline, the horizon and any light appear."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from invrender.rig import Rig
from invrender.types import Array, InputError


@dataclass(frozen=True)
class Ball:
    """A mirror ball standing on the table, as a photo of `size` (H, W) pixels shows it.

    ``position`` (3,) of its centre and ``radius_m`` in metres, in the rig's coordinates: z = 0 for
    a hemisphere, z = ``radius_m`` for a full sphere. ``centre``
    (x, y) and ``radius`` are those of its outline in pixels (0, 0 is the photo's corner);
    ``ellipse`` is the outline's (centre x, centre y, semi-axis a, semi-axis b, angle of a in
    degrees from the photo's right towards down). ``confidence`` is in [0, 1]. ``camera_tilt``: the
    camera's, degrees as `Rig` has them, where the ball's rim determines it, and ``tilt_deviation``
    the expected error. ``reflectance`` (RGB)
    and ``reflectance_deviation``, the standard deviation of its logarithm: as measured, where it
    was.
    """

    position: tuple[float, float, float]
    radius_m: float
    size: tuple[int, int]
    centre: tuple[float, float]
    radius: float
    ellipse: tuple[float, float, float, float, float]
    confidence: float = 1.0
    camera_tilt: tuple[float, float, float] | None = None
    tilt_deviation: float | None = None
    reflectance: tuple[float, float, float] | None = None
    reflectance_deviation: float | None = None


def mirror_normals(rig: Rig, position: Array, radius: float, target: Array, near: bool) -> Array:
    """Unit normals (..., 3) of the ball where the camera sees a target reflected.

    ``target`` (..., 3): unit directions, or points in metres if ``near``. The normal halves the
    angle between the ways to camera and target; these depend on the point, little, since the ball
    is small: a fixed point with a contraction of about radius/distance.
    """
    target, camera = np.asarray(target, float), rig.camera
    normal = _unit(_unit(camera - position) + _unit(target - position if near else target))
    for _ in range(3):
        point = position + radius * normal
        to_camera = camera - point
        to_target = target - point if near else target
        normal = _unit(_unit(to_camera) + _unit(to_target))
    return normal


def _unit(v: Array) -> Array:
    """Vectors (..., 3) made unit ones; several times as fast as `numpy.linalg.norm` allows."""
    return np.asarray(v / np.sqrt(np.einsum("...i,...i->...", v, v))[..., None])


def outline_points(rig: Rig, position: Array, radius: float, count: int = 128) -> Array:
    """Points in space (count, 3) on the ball's outline as the camera sees it.

    The circle where rays from the camera touch the sphere, or a hemisphere's rim on the table where
    that circle runs below it.
    """
    axis = position - rig.camera
    d = float(np.linalg.norm(axis))
    if d <= radius:
        raise InputError("rig: the camera is inside the ball")
    axis = axis / d
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    along = np.cross(across, axis)
    angle = np.arange(count) * (2 * math.pi / count)
    ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * along
    sine = radius / d  # of half the angle under which the ball is seen
    points = position - axis * radius * sine + ring * radius * math.sqrt(1 - sine**2)
    rim = (points - position) * [1, 1, 0]
    rim = position + rim * (radius / np.linalg.norm(rim, axis=-1, keepdims=True))
    return np.where(points[:, 2:] < 0, rim, points)


def horizon_points(rig: Rig, position: Array, radius: float, count: int = 128) -> Array:
    """Points on the ball (count, 3) where the camera sees the horizon, z = 0, reflected."""
    angle = np.arange(count) * (2 * math.pi / count)
    flat = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], -1)
    return position + radius * mirror_normals(rig, position, radius, flat, False)


def make_ball(
    rig: Rig, position: Array, radius: float, size: tuple[int, int], confidence: float = 1.0
) -> Ball:
    """The `Ball` that stands at ``position`` (3,) with that radius in metres."""
    ring = rig.project(outline_points(rig, position, radius, 256), *size)
    centre, a, b, angle = _ellipse(ring)
    return Ball(
        (float(position[0]), float(position[1]), float(position[2])),
        float(radius),
        size,
        (float(centre[0]), float(centre[1])),
        math.sqrt(a * b),
        (float(centre[0]), float(centre[1]), a, b, angle),
        confidence,
    )


def place_ball(rig: Rig, size: tuple[int, int], x: float, y: float, r: float) -> Ball:
    """The ball whose outline in a photo of ``size`` (H, W) has that centre and radius in pixels.

    For a manual override, and for what detection finds. Raises `InputError` for a circle that is
    no ball or not whole in the photo.
    """
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(r) and r >= 1):
        raise InputError(
            f"ball: need a centre and a radius of a pixel or more, got {x:g}, {y:g}, {r:g}"
        )
    if not is_whole(size, x, y, r):
        raise InputError(
            f"ball: the circle {x:.0f}, {y:.0f}, {r:.0f} is not whole inside the "
            f"{size[1]} × {size[0]} photo"
        )
    radius = rig.ball_radius
    position = on_table(rig, size, x, y, rig.ball_height(radius))
    for _ in range(6):
        ball = make_ball(rig, position, radius, size)
        radius *= r / ball.radius
        shift = np.array([x - ball.centre[0], y - ball.centre[1]])
        at = rig.project(position, *size) + shift
        position = on_table(rig, size, float(at[0]), float(at[1]), rig.ball_height(radius))
    return make_ball(rig, position, radius, size)


def is_whole(size: tuple[int, int], x: float, y: float, r: float) -> bool:
    """Whether a photo of ``size`` (H, W) holds the circle whole."""
    return r <= x <= size[1] - r and r <= y <= size[0] - r


def ball_centre(rig: Rig, circle: Array) -> Array:
    """Centre (3,) of the ball with that circle: x, y and radius in metres."""
    return np.array([circle[0], circle[1], rig.ball_height(circle[2])])


def on_table(rig: Rig, size: tuple[int, int], x: float, y: float, height: float = 0.0) -> Array:
    """The point (3,), ``height`` metres above the table, that pixel (x, y) of a photo sees."""
    ray = rig.rays(np.array([x, y]), *size)
    if ray[2] >= 0:
        raise InputError("ball: that place in the photo is not on the table")
    return rig.camera - ray * ((rig.camera[2] - height) / ray[2])


def _ellipse(points: Array) -> tuple[Array, float, float, float]:
    """Centre, semi-axes and angle of the closed convex curve ``points`` (n, 2) by its moments."""
    x, y = (points - points.mean(0)).T
    x1, y1 = np.roll(x, -1), np.roll(y, -1)
    cross = x * y1 - x1 * y
    area = cross.sum() / 2
    cx, cy = ((x + x1) * cross).sum() / 6 / area, ((y + y1) * cross).sum() / 6 / area
    xx = ((x * x + x * x1 + x1 * x1) * cross).sum() / 12 / area - cx * cx
    yy = ((y * y + y * y1 + y1 * y1) * cross).sum() / 12 / area - cy * cy
    xy = ((x * y1 + 2 * x * y + 2 * x1 * y1 + x1 * y) * cross).sum() / 24 / area - cx * cy
    values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
    # The second moments of an ellipse are a²/4 and b²/4.
    b, a = 2 * np.sqrt(np.maximum(values, 0))
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1])) % 180
    return points.mean(0) + np.array([cx, cy]), float(a), float(b), angle
