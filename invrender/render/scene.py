"""A rig under its lights as Dr.Jit arrays, and its pixels.

The screen is a rectangle corner + s·e_x + t·e_y, (s, t) in [0, 1]², that emits gain × pattern ×
cos(θ)^falloff towards the sample and hides the environment behind it; its border may be a black
bezel. The environment is an equirectangular image at infinity. Any field of a `Scene` may carry
gradients; what a scene lacks is None and is never traced into a kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from invrender.lights import IDEAL, Device, Lights
from invrender.render.backend import Float, ad, dr, vector
from invrender.rig import Rig
from invrender.types import InputError

LEAST_COS = 1e-6  # at the screen, of directions that meet it: its power has a finite derivative


@dataclass
class Scene:
    """One rig under its lights. Scalars and vectors have width 1, textures are flat RGB.

    corner, edge_x, edge_y: of the screen with its bezel. pattern: values of relative radiance in
    ``pattern_shape`` (rows, columns), row 0 at +y. environment: H·2H·3, row 0 at +z. falloff: the
    display's exponent, None where it dims to no side. bezel: its shares of the screen's width and
    depth on each side, None where there is none; only `Fast`, whose edges are soft, differentiates
    by it.
    """

    camera: Any
    corner: Any
    edge_x: Any
    edge_y: Any
    pattern: Any | None
    pattern_shape: tuple[int, int]
    gain: Any
    environment: Any | None
    env_height: int
    scale: Any
    half: Any  # half-width of the sample, metres
    falloff: Any | None = None
    bezel: tuple[Any, Any] | None = None

    @property
    def scalar(self) -> type:
        """Float or Float64: the precision of everything."""
        return type(self.scale)


def make_scene(
    rig: Rig,
    pattern: Any | None,
    environment: Any | None,
    gain: Any = 1.0,
    scale: float = 1.0,
    scalar: type = Float,
    device: Device = IDEAL,
) -> Scene:
    """A `Scene` from (h, w, 3) pattern and (H, 2H, 3) environment arrays, either may be None.

    A rig without a screen leaves out the pattern. gain: RGB radiance of the pattern's white; scale
    multiplies the environment; device: the display that shows the pattern. Raises `InputError` for
    wrong shapes and for negative or non-finite lights.
    """
    vec3 = vector(scalar, 3)
    flat_env, flat_pattern = None, None
    env_height, pattern_shape = 0, (0, 0)
    if environment is not None:
        environment = _checked(environment, "environment", "(H, 2H, 3)")
        if environment.shape[1] != 2 * environment.shape[0]:
            raise InputError(f"environment must be (H, 2H, 3), got {environment.shape}")
        if np.any(environment):
            flat_env = scalar(aligned(environment.ravel(), scalar))
            env_height = environment.shape[0]
    if pattern is not None and rig.has_screen:
        pattern = _checked(pattern, "pattern", "(H, W, 3)")
        pattern = device.shown(pattern)
        # A black screen matters where it hides something.
        if np.any(pattern) or flat_env is not None:
            flat_pattern = scalar(aligned(pattern.ravel(), scalar))
            pattern_shape = (pattern.shape[0], pattern.shape[1])
    none = np.zeros(3)
    corner, (edge_x, edge_y) = rig.screen_body if rig.has_screen else (none, (none, none))
    # Opaque, so that new values of the pose, the gain or the scale do not compile new kernels.
    opaque = lambda v: dr.opaque(scalar, float(v))  # noqa: E731
    place = lambda p: vec3(*(opaque(c) for c in p))  # noqa: E731
    lit = flat_pattern is not None
    bezel = None
    if lit and rig.screen_bezel != 0:
        width, depth = rig.screen_sides
        b = rig.screen_bezel
        bezel = opaque(b / (width + 2 * b)), opaque(b / (depth + 2 * b))
    return Scene(
        camera=place(rig.camera),
        corner=place(corner),
        edge_x=place(edge_x),
        edge_y=place(edge_y),
        pattern=flat_pattern,
        pattern_shape=pattern_shape,
        gain=place(np.broadcast_to(np.asarray(gain, dtype=float), 3)),
        environment=flat_env,
        env_height=env_height,
        scale=opaque(scale),
        half=opaque(rig.sample_size / 2),
        falloff=opaque(device.falloff) if lit and device.falloff != 0 else None,
        bezel=bezel,
    )


def scene_under(lights: Lights, scale: float = 1.0, scalar: type = Float) -> Scene:
    """The `Scene` of lights, all of them times ``scale``."""
    gain = np.asarray(lights.gain) * scale
    return make_scene(
        lights.rig, lights.pattern, lights.environment, gain, scale, scalar, lights.device
    )


def _checked(image: Any, name: str, shape: str) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise InputError(f"{name} must be {shape}, got {image.shape}")
    if not np.all(np.isfinite(image)) or image.min() < 0:
        raise InputError(f"{name} has negative or non-finite values")
    return image


def _bilinear(texture: Any, height: int, width: int, x: Any, y: Any, wrap: bool) -> Any:
    """RGB at pixel coordinates (x, y), texel centres at + 0.5; columns wrap or clamp."""
    scalar = type(x)
    uint, sint = dr.uint32_array_t(scalar), dr.int32_array_t(scalar)
    vec3 = vector(scalar, 3)
    x, y = x - 0.5, dr.clip(y - 0.5, 0, height - 1)
    floor_x, floor_y = dr.floor(x), dr.minimum(dr.floor(y), max(height - 2, 0))
    ix, iy = sint(floor_x), uint(floor_y)
    if wrap:
        x0 = uint(dr.select(ix < 0, ix + width, dr.select(ix >= width, ix - width, ix)))
        x1 = dr.select(x0 + 1 >= width, 0, x0 + 1)
    else:
        x0 = uint(dr.clip(ix, 0, width - 1))
        x1 = uint(dr.clip(ix + 1, 0, width - 1))
    y1 = dr.minimum(iy + 1, height - 1)
    fetch = lambda r, c: dr.gather(vec3, texture, r * width + c)  # noqa: E731
    fx, fy = x - floor_x, y - floor_y
    return dr.lerp(
        dr.lerp(fetch(iy, x0), fetch(iy, x1), fx), dr.lerp(fetch(y1, x0), fetch(y1, x1), fx), fy
    )


def pattern_at(scene: Scene, s: Any, t: Any, texel: float = 0.0) -> Any:
    """Radiance straight ahead, gain × pattern, at the screen's (s, t): bilinear, clamped at the
    border, black on the bezel.

    texel: side of the square of (s, t) over which the bezel's edge is averaged, none if 0.
    """
    rows, columns = scene.pattern_shape
    lit: Any = 1
    if scene.bezel is not None:
        for p, b in ((s, scene.bezel[0]), (t, scene.bezel[1])):
            inside = dr.minimum(p - b, 1 - b - p)  # distance from the edge
            lit *= dr.clip(inside / texel + 0.5, 0, 1) if texel else dr.select(inside > 0, 1, 0)
        s, t = ((p - b) / (1 - 2 * b) for p, b in zip((s, t), scene.bezel, strict=True))
    x, y = s * columns, (1 - t) * rows
    return scene.gain * lit * _bilinear(scene.pattern, rows, columns, x, y, wrap=False)


def dimming(scene: Scene, cos: Any) -> Any:
    """Radiance towards an angle of cosine ``cos`` from the screen's normal, relative to straight
    ahead; 1 where the display dims to no side."""
    return 1 if scene.falloff is None else dr.maximum(cos, LEAST_COS) ** scene.falloff


def equirect_uv(d: Any) -> tuple[Any, Any]:
    """(u, v) in [0, 1] of a unit direction: φ = 2πu from +x towards +y, v = 0 at the zenith."""
    phi = dr.atan2(d.y, d.x)
    u = phi * (0.5 / dr.pi)
    return dr.select(u < 0, u + 1, u), dr.safe_acos(d.z) / dr.pi


def environment_at(scene: Scene, d: Any) -> Any:
    """Environment radiance along unit directions d, bilinear, as Mitsuba's ``envmap`` reads it."""
    h = scene.env_height
    u, v = equirect_uv(d)
    return scene.scale * _bilinear(scene.environment, h, 2 * h, u * (2 * h), v * h, wrap=True)


@dataclass
class ScreenFrame:
    """The screen's plane as points see it: what `hit` needs of them, computed once.

    normal: unit, upwards. along_s, along_t: edges over their squared lengths. distance: height of
    the plane above a point. s, t: the point's foot. area: of the screen.
    """

    normal: Any
    along_s: Any
    along_t: Any
    distance: Any
    s: Any
    t: Any
    area: Any

    def hit(self, d: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Where rays x + r·d meet the plane: (s, t, r, cos, ahead), cos positive from below.

        Rays that are not ahead have (s, t) of no meaning and r = distance.
        """
        cos = dr.dot(d, self.normal)
        ahead = (cos > LEAST_COS) & (self.distance > 0)
        r = self.distance / dr.select(ahead, cos, 1)
        s = dr.fma(r, dr.dot(d, self.along_s), self.s)
        t = dr.fma(r, dr.dot(d, self.along_t), self.t)
        return s, t, r, cos, ahead


def screen_frame(scene: Scene, x: Any) -> ScreenFrame:
    """The `ScreenFrame` of points x."""
    cross = dr.cross(scene.edge_x, scene.edge_y)
    area = dr.norm(cross)
    normal = cross / area
    along_s = scene.edge_x / dr.squared_norm(scene.edge_x)
    along_t = scene.edge_y / dr.squared_norm(scene.edge_y)
    offset = x - scene.corner
    return ScreenFrame(
        normal, along_s, along_t, -dr.dot(offset, normal),
        dr.dot(offset, along_s), dr.dot(offset, along_t), area,
    )  # fmt: skip


def hit_screen(scene: Scene, x: Any, d: Any) -> tuple[Any, Any, Any, Any, Any]:
    """Where rays x + r·d meet the screen's plane: (s, t, r, cos, hit).

    cos is the angle at the screen (positive from below); hit tells whether (s, t) is inside.
    """
    s, t, r, cos, ahead = screen_frame(scene, x).hit(d)
    return s, t, r, cos, ahead & (s >= 0) & (s < 1) & (t >= 0) & (t < 1)


def aligned(array: np.ndarray, kind: type) -> np.ndarray:
    """A copy at a 64-byte boundary, in the precision of the Dr.Jit array type ``kind``.

    Dr.Jit takes numpy memory as it is and compiles its alignment into kernels: left to chance,
    the same call would now and then compile anew.
    """
    floats = np.float64 if kind is ad.Float64 else np.float32
    array = array.astype(np.uint32 if dr.is_integral_v(kind) else floats)
    buffer = np.empty(array.nbytes + 64, np.uint8)
    start = -buffer.ctypes.data % 64
    out = buffer[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    out[...] = array
    return out


@dataclass
class View:
    """What a pixel needs besides its material: position, direction to the camera, random offset."""

    x: Any
    to_camera: Any
    hash: Any


def make_view(
    scene: Scene, height: int, width: int, seed: int = 0, start: int = 0, count: int | None = None
) -> View:
    """Pixel centres of an H × W image of the sample, row 0 at +y; pixels start to start + count."""
    scalar = scene.scalar
    uint, vec3 = dr.uint32_array_t(scalar), vector(scalar, 3)
    count = height * width if count is None else count
    i = dr.arange(uint, count) + dr.opaque(uint, start)
    w, h = dr.opaque(uint, width), dr.opaque(uint, height)
    row = i // w
    u = (scalar(i - row * w) + 0.5) / scalar(w)
    v = (scalar(row) + 0.5) / scalar(h)
    x = vec3((2 * u - 1) * scene.half, (1 - 2 * v) * scene.half, 0)
    return View(x, dr.normalize(scene.camera - x), hash_bits(i, dr.opaque(uint, seed)))


def hash_bits(i: Any, seed: Any) -> Any:
    """PCG output permutation: a random 32-bit integer a pixel and seed (Jarzynski, Olano 2020)."""
    state = (i ^ (seed * 0x9E3779B9)) * 747796405 + 2891336453
    word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737
    return (word >> 22) ^ word


def unit(bits: Any, scalar: type) -> Any:
    """32 random bits to (0, 1)."""
    return dr.fma(scalar(bits >> 9), 2.0**-23, 2.0**-24)
