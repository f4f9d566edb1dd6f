"""The rig: tablet, camera and mirror ball above a flat sample, and all of its geometry.

Right-handed metres, origin at the sample's centre, z up, x towards the camera and the ball.
The sample fills x, y in [-a, a]; the camera sits at (a + delta, 0, H) and looks straight down on
the ball, which stands at (a + delta, 0, 0). The w × d screen hangs at height h, its edge 2·delta
from the optical axis: x in [a - delta - w, a - delta], y in [-d/2, d/2]. A square of side l has
a = l/4 and is the sample's mirror image as the camera sees it (H = h). Nothing else in the package
repeats these numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from invrender.types import Array, InputError, Vec3

LONGEST = 1e6  # of any length, in whatever unit
BALL_SHAPES = ("hemisphere", "sphere")
_LENGTHS = ("_size", "_side", "_height", "_offset", "_radius", "_shift", "_bezel")


def fov_of(tangent: float) -> float:
    """The field of view in degrees of a photo whose half width is so many focal lengths."""
    return math.degrees(2 * math.atan(tangent))


def squared_distance(pixels: Array, height: float, width: float) -> Array:
    """That of pixels (..., 2) from the middle of a photo of that size, 1 in the corners."""
    half = np.array([width, height]) / 2
    return np.asarray(((pixels - half) ** 2).sum(-1) / (half**2).sum())


def lens_gain(share: float, aside: Array) -> Array:
    """By what radiance must be multiplied where a lens's corners lack a ``share`` of the light, at
    squared distances ``aside`` from the middle: (1 + c·r²)², as the fourth power of a cosine falls.
    """
    return np.asarray((1 + (1 / np.sqrt(1 - share) - 1) * aside) ** 2)


@dataclass(frozen=True)
class Rig:
    """Sizes in metres, angles in degrees. The defaults are a tablet and a 19 mm ball.

    ``screen_size``: of the lit area, a square's side or (along x, along y); None where there is no
    screen, and then ``sample_side`` and ``camera_height`` must be given. ``sample_side``: of the
    square sample, by default half of the screen's shorter side. ``screen_bezel``: width of the
    black border around the lit area, which hides what is behind. ``camera_height``: by default the
    screen's. ``ball_shape``: a "hemisphere" lies on its flat side, a "sphere" stands on the table.
    ``screen_shift`` and ``screen_tilt`` (a rotation vector about the screen's centre), and the
    same for the camera, say how a hand-held rig differs from the nominal one. Raises `InputError`
    for sizes that no rig has.

        rig = Rig(screen_size=(0.228, 0.16), screen_height=0.16, camera_offset=0.02)
        print(rig.sample_size)
    """

    screen_size: float | tuple[float, float] | None = 0.18
    screen_height: float = 0.153
    camera_offset: float = 0.017
    ball_radius: float = 0.0095
    fov: float = 73.7
    ball_reflectance: Vec3 = (0.9, 0.9, 0.9)
    ball_shape: str = "hemisphere"
    screen_shift: Vec3 = (0.0, 0.0, 0.0)
    screen_tilt: Vec3 = (0.0, 0.0, 0.0)
    camera_shift: Vec3 = (0.0, 0.0, 0.0)
    camera_tilt: Vec3 = (0.0, 0.0, 0.0)
    screen_bezel: float = 0.0
    camera_height: float | None = None
    sample_side: float | None = None

    def __post_init__(self) -> None:
        if self.ball_shape not in BALL_SHAPES:
            raise InputError(f"rig: ball shape must be one of {', '.join(BALL_SHAPES)}")
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "ball_shape"}
        values = {name: value for name, value in values.items() if value is not None}
        for name, value in values.items():
            if not np.all(np.isfinite(value)):
                raise InputError(f"rig: {name} must be finite")
        if self.screen_size is None and None in (self.sample_side, self.camera_height):
            raise InputError(
                "rig: without a screen the sample's size and the camera's height must be given"
            )
        if self.screen_size is not None and np.shape(self.screen_size) not in ((), (2,)):
            raise InputError("rig: screen_size must be one number or two")
        for name in ("screen_size", "ball_radius", "sample_side", "camera_height"):
            least = float(np.min(values.get(name, 1.0)))
            if not least > 0:
                raise InputError(f"rig: {name} must be positive, got {least:g}")
        if not self.screen_bezel >= 0:
            raise InputError(f"rig: screen_bezel must not be negative, got {self.screen_bezel:g}")
        if not self.screen_height > 0:
            raise InputError(
                f"rig: the screen must be above the table, got a height of {self.screen_height:g}"
            )
        if not self.camera_offset >= 0:
            raise InputError(f"rig: camera offset must not be negative, got {self.camera_offset:g}")
        lengths = [value for name, value in values.items() if name.endswith(_LENGTHS)]
        shortest = min(self.screen_height, self.ball_radius, self.sample_size)
        if self.has_screen:
            shortest = min(*self.screen_sides, shortest)
        if any(np.abs(v).max() > LONGEST for v in lengths) or shortest < 1 / LONGEST:
            raise InputError(
                f"rig: lengths must lie between {1 / LONGEST:g} and {LONGEST:g}; use metres"
            )
        if any(np.linalg.norm(t) > 180 for t in (self.screen_tilt, self.camera_tilt)):
            raise InputError("rig: a tilt is at most 180 degrees")
        if not self.camera[2] > 0:
            raise InputError("rig: the camera must be above the table; see its shift")
        if not 1 <= self.fov <= 170:
            raise InputError(f"rig: fov must be between 1 and 170 degrees, got {self.fov:g}")
        if not all(0 < r <= 1 for r in self.ball_reflectance):
            raise InputError("rig: ball reflectance must be above 0 and at most 1")
        if self.has_screen:
            corner, (e_x, e_y) = self.screen_body
            if corner[2] + min(e_x[2], 0) + min(e_y[2], 0) <= 0:
                raise InputError("rig: the tilted screen reaches below the table")

    # --- the sample -----------------------------------------------------------------------------

    @property
    def sample_size(self) -> float:
        """Side of the square sample, 2·a."""
        return min(self.screen_sides) / 2 if self.sample_side is None else self.sample_side

    @property
    def sample_corners(self) -> Array:
        """The sample's corners, (4, 3), one after another around it."""
        square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        return square * (self.sample_size / 2)

    def sample_points(self, height: int, width: int) -> Array:
        """Centres of an H × W grid of sample pixels, (H, W, 3), row 0 at +y."""
        half = self.sample_size / 2
        x = ((np.arange(width) + 0.5) / width * 2 - 1) * half
        y = (1 - (np.arange(height) + 0.5) / height * 2) * half
        points = np.zeros((height, width, 3))
        points[..., 0], points[..., 1] = x[None, :], y[:, None]
        return points

    def lens_distance(self, height: int, width: int) -> Array:
        """`squared_distance` (H, W) of the sample's pixels in a photo of 4 : 3."""
        at = self.project(self.sample_points(height, width), 3, 4)
        return squared_distance(at, 3, 4)

    # --- the screen -----------------------------------------------------------------------------

    @property
    def has_screen(self) -> bool:
        """Whether there is a screen; without one nothing else of it may be asked for."""
        return self.screen_size is not None

    @property
    def screen_sides(self) -> tuple[float, float]:
        """Width (along x) and depth (along y) of the screen's lit area."""
        size = self.screen_size
        if size is None:
            raise ValueError("the rig has no screen")
        wide, deep = (size[0], size[1]) if isinstance(size, (tuple, list)) else (size, size)
        return float(wide), float(deep)

    @cached_property
    def screen_edges(self) -> tuple[Array, Array]:
        """The lit area's sides as vectors, along +x and along +y where it is not tilted."""
        turn = Rotation.from_rotvec(self.screen_tilt, degrees=True)
        width, depth = self.screen_sides
        return turn.apply([width, 0.0, 0.0]), turn.apply([0.0, depth, 0.0])

    @cached_property
    def screen_corner(self) -> Array:
        """The lit area's corner at -x, -y: its point (s, t) is corner + s·e_x + t·e_y."""
        near = self.sample_size / 2 - self.camera_offset
        centre = np.array([near - self.screen_sides[0] / 2, 0.0, self.screen_height])
        centre = centre + np.asarray(self.screen_shift)
        e_x, e_y = self.screen_edges
        return centre - e_x / 2 - e_y / 2

    @cached_property
    def screen_body(self) -> tuple[Array, tuple[Array, Array]]:
        """Corner and sides of what hides the room: the lit area with its bezel."""
        e_x, e_y = self.screen_edges
        width, depth = self.screen_sides
        b_x, b_y = e_x * (self.screen_bezel / width), e_y * (self.screen_bezel / depth)
        return self.screen_corner - b_x - b_y, (e_x + 2 * b_x, e_y + 2 * b_y)

    # --- the camera -----------------------------------------------------------------------------

    @property
    def optical_axis_x(self) -> float:
        """x of the ball and of the nominal camera, a + delta."""
        return self.sample_size / 2 + self.camera_offset

    def screen_cosines(self, points: Array, cells: int, falloff: float = 0.0) -> Array:
        """∫ cos θ cos θ' / d² over each of the screen's ``cells`` × ``cells`` parts, by its middle.

        From ``points`` (..., 3) that face up, below the screen's front; (..., cells, cells), row 0
        at the pattern's top. Times a pattern's radiance and summed it is the irradiance. falloff:
        the display's (`invrender.lights.Device`), times cos(θ')^falloff. Noughts without a screen.
        """
        if not self.has_screen:
            return np.zeros((*np.shape(points)[:-1], cells, cells))
        e_x, e_y = self.screen_edges
        middle = screen_middles(self, cells)
        down = np.cross(e_y, e_x) / cells**2  # as long as a cell's area
        p = np.asarray(points)
        square = (p * p).sum(-1)[..., None] + (middle * middle).sum(-1) - 2 * p @ middle.T
        cosines = np.maximum(middle[:, 2] - p[..., 2:], 0)
        ahead = np.maximum((p @ down)[..., None] - middle @ down, 0)
        cosines *= ahead
        if falloff:
            cosines *= (ahead / (np.linalg.norm(down) * np.sqrt(square))) ** falloff
        return np.asarray(cosines / square**2).reshape(*p.shape[:-1], cells, cells)

    @property
    def camera(self) -> Array:
        """Position of the pinhole, (3,)."""
        height = self.screen_height if self.camera_height is None else self.camera_height
        nominal = np.array([self.optical_axis_x, 0.0, height])
        return nominal + np.asarray(self.camera_shift)

    @cached_property
    def camera_axes(self) -> Array:
        """Rows: the directions of the photo's right, its up, and towards the viewer (3, 3)."""
        return Rotation.from_rotvec(self.camera_tilt, degrees=True).as_matrix().T

    @property
    def off_nadir(self) -> float:
        """Degrees by which the camera looks past straight down."""
        return math.degrees(math.acos(min(1.0, float(self.camera_axes[2, 2]))))

    @property
    def ball_centre(self) -> Array:
        """Centre of the mirror ball below the nominal camera: a hemisphere's lies on the table, a
        sphere's its radius above."""
        return np.array([self.optical_axis_x, 0.0, self.ball_height(self.ball_radius)])

    def ball_height(self, radius: float) -> float:
        """Height of the centre of a ball of that radius above the table, in metres."""
        return radius if self.ball_shape == "sphere" else 0.0

    def turned(self, turn: Rotation, centre: Array) -> Rig:
        """Camera and screen turned about a point (3,); the ball's nominal place stays."""

        def moved(shift: Vec3, at: Array) -> Any:
            return tuple((shift + centre + turn.apply(at - centre) - at).tolist())

        def tilted(tilt: Vec3) -> Any:
            both = turn * Rotation.from_rotvec(tilt, degrees=True)
            return tuple(both.as_rotvec(degrees=True).tolist())

        rig = replace(
            self,
            camera_shift=moved(self.camera_shift, self.camera),
            camera_tilt=tilted(self.camera_tilt),
        )
        if not self.has_screen:
            return rig
        e_x, e_y = self.screen_edges
        screen = self.screen_corner + e_x / 2 + e_y / 2
        return replace(
            rig,
            screen_shift=moved(self.screen_shift, screen),
            screen_tilt=tilted(self.screen_tilt),
        )

    def focal(self, photo_width: int) -> float:
        """Focal length in pixels of a photo that wide."""
        return photo_width / 2 / math.tan(math.radians(self.fov) / 2)

    def project(self, points: Array, height: int, width: int) -> Array:
        """World points (..., 3) to photo pixels (..., 2): x right, y down, (0, 0) a corner.

        Pixel i of a row covers [i, i + 1]. Points behind the camera give NaN.
        """
        p = (np.asarray(points) - self.camera) @ self.camera_axes.T
        depth = np.where(p[..., 2] < 0, -p[..., 2], np.nan)
        f = self.focal(width)
        return np.stack([width / 2 + f * p[..., 0] / depth, height / 2 - f * p[..., 1] / depth], -1)

    def rays(self, pixels: Array, height: int, width: int) -> Array:
        """Unit directions (..., 3) from the camera through photo pixels (..., 2)."""
        pixels = np.asarray(pixels)
        f = self.focal(width)
        d = np.stack(
            [
                (pixels[..., 0] - width / 2) / f,
                (height / 2 - pixels[..., 1]) / f,
                -np.ones(pixels.shape[:-1]),
            ],
            -1,
        )
        d = d @ self.camera_axes
        return d / np.linalg.norm(d, axis=-1, keepdims=True)


def screen_middles(rig: Rig, cells: int) -> Array:
    """The middles (cells², 3) of a screen's ``cells`` × ``cells`` parts, row 0 at the pattern's
    top."""
    e_x, e_y = rig.screen_edges
    t = (np.arange(cells) + 0.5) / cells
    middle = rig.screen_corner + t[:, None] * e_x + (1 - t)[:, None, None] * e_y
    return np.asarray(middle.reshape(-1, 3))
