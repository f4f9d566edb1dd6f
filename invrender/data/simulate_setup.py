"""What people build: displays, balls, cameras and hands, drawn from the ranges of `RANGES`.

Each quantity has random numbers of its own, so that one more option leaves the others as they are.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from invrender.capture.sheet_layout import INK_REFLECTANCE
from invrender.data.simulate_camera import HALF_WIDTH, Camera
from invrender.data.tablets import find_tablet
from invrender.lights import IDEAL, Device, Lamp
from invrender.rig import Rig, fov_of
from invrender.types import Array, InputError, Vec3

PHOTO_KINDS = ("raw", "bracket", "jpeg")


@dataclass(frozen=True)
class Range:
    """Where a quantity is drawn from: uniformly between ``low`` and ``high``, by its logarithm if
    ``log``; ``what`` it is, with its unit."""

    low: float
    high: float
    what: str
    log: bool = False


# Measured on displays, balls and phones, or what their makers state; chosen by hand where nobody
# does. docs/reference-simulate.md shows this table.
RANGES = {
    "falloff": Range(0.3, 1.6, "display: exponent of the dimming to the sides"),
    "mixing": Range(0.01, 0.09, "display: share of a channel's light that comes from the others"),
    "gamma": Range(0.92, 1.12, "display: exponent that is left of its curve"),
    "gamma_rgb": Range(-0.02, 0.02, "the same: what each channel adds"),
    "black": Range(0.0005, 0.008, "display: black's light, relative to white's", True),
    "gain": Range(1.5, 3.0, "display: radiance of white (the room's irradiance is 0.5)"),
    "gain_rgb": Range(0.85, 1.15, "the same: factor of each channel", True),
    "bezel": Range(0.004, 0.015, "display: black border, metres"),
    "screen_height": Range(0.12, 0.18, "display: height above the table, metres"),
    "screen_shift": Range(-0.005, 0.005, "hand: display's shift along each axis, metres"),
    "screen_tilt": Range(-3.0, 3.0, "hand: display's tilt about each axis, degrees"),
    "sample": Range(0.05, 0.08, "sample: its side, metres"),
    "table": Range(0.05, 0.6, "table: albedo", True),
    "ink": Range(0.035, 0.07, "sheet: reflectance of its ink", True),
    "reflectance": Range(0.45, 0.9, "ball: reflectance"),
    "reflectance_rgb": Range(0.95, 1.05, "the same: factor of each channel"),
    "ball_alpha": Range(0.0, 0.02, "ball: roughness alpha"),
    "ball_radius": Range(0.0075, 0.0125, "ball: radius, metres"),
    "ball_shift": Range(-0.004, 0.004, "hand: ball's displacement along x and y, metres"),
    "focal": Range(26.0, 77.0, "camera: equivalent focal length, mm; short ones are more frequent"),
    "offset": Range(0.012, 0.022, "camera: offset δ, metres; more where the display hides a view"),
    "camera_shift": Range(-0.004, 0.004, "hand: camera's shift along each axis, metres"),
    "camera_tilt": Range(-2.0, 2.0, "hand: camera's tilt about each axis, degrees"),
    "shake": Range(-0.001, 0.001, "hand: the same between two exposures, metres"),
    "shake_tilt": Range(-0.3, 0.3, "hand: and degrees"),
    "lamp_distance": Range(0.4, 1.5, "lamp: from the sample, metres", True),
    "lamp_angle": Range(20.0, 65.0, "lamp: from straight above, degrees"),
    "lamp_radius": Range(0.02, 0.15, "lamp: from a bulb to a flash on a card, metres", True),
    "lamp_light": Range(1.0, 6.0, "lamp: irradiance (the room's is 0.5)", True),
    "measured": Range(-0.002, 0.002, "person: error of measured height and offset, metres"),
    "measured_fov": Range(0.99, 1.01, "person: factor on the field of view"),
    "distortion": Range(-0.03, 0.02, "lens: displacement of a corner, relative"),
    "vignetting": Range(0.0, 0.15, "lens: light that a JPEG's corner lacks"),
    "raw_vignetting": Range(0.0, 0.45, "lens: light that a raw file's corner lacks"),
    "blur": Range(0.2, 0.8, "lens: blur, pixels of a photo 1,280 wide"),
    "electrons": Range(5e3, 5e4, "sensor: electrons of a white pixel", True),
    "shoulder": Range(0.0, 1.5, "JPEG: shoulder k of the tone curve (1 + k)x/(1 + kx)"),
    "contrast": Range(0.0, 0.3, "JPEG: share of the smooth step in the tone curve"),
    "quality": Range(88, 97, "JPEG: quality"),
}
# Displays of usual proportions: 4 : 3, 10 : 7, 16 : 10 and 3 : 2.
DRAWN_TABLETS = (
    "iPad Air 11", "iPad Pro 11 2018–2022", "Galaxy Tab S8 11", "iPad Pro 12.9", "Surface Pro",
)  # fmt: skip
PHOTO_MARGIN = 0.9  # of the photo's half width, that sample and ball reach
CLEARANCE = 0.006  # metres by which a display stays out of the camera's view before a hand moves it
FOCUS = 0.15  # metres; main cameras of phones focus no nearer
ON_ITS_MARK = 0.25  # of the ball's displacement, where the sheet shows its place
LARGEST_LAMP = 0.5  # radius of a lamp, of its height
STEP = 0.002  # metres by which the camera moves away until the display leaves its view


@dataclass(frozen=True)
class Setup:
    """A whole set-up: all that a photograph depends on but material, room and pattern.

    rig: the true one; nominal: what a person would write into rig.toml. gain: RGB radiance of the
    display's white. ball: its centre in the world, metres; ball_alpha: its roughness. table: RGB
    albedo. sheet: whether the printed capture sheet lies on it; ink: reflectance of its black.
    photos: "raw", "bracket" or "jpeg"; exposures: of each photo, by what it is exposed for:
    "sample", "middle" or "screen". shakes: by how much the camera moves from the first photo to
    each, (metres, degrees). lamps: of a set-up without a screen one for each photo.
    """

    rig: Rig
    nominal: Rig
    device: Device = IDEAL
    gain: Vec3 = (1.0, 1.0, 1.0)
    ball: Vec3 | None = None
    ball_alpha: float = 0.0
    table: Vec3 = (0.3, 0.3, 0.3)
    sheet: bool = False
    camera: Camera = field(default_factory=Camera)
    photos: str = "raw"
    exposures: tuple[str, ...] = ("screen",)
    shakes: tuple[tuple[Vec3, Vec3], ...] = (((0.0,) * 3, (0.0,) * 3),)
    lamps: tuple[Lamp, ...] = ()
    ink: float = INK_REFLECTANCE

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    def rig_of(self, k: int) -> Rig:
        """The rig at photo k: the camera as the hand holds it then."""
        shift, tilt = self.shakes[k]
        return replace(
            self.rig,
            camera_shift=_vec3(np.add(self.rig.camera_shift, shift)),
            camera_tilt=_vec3(np.add(self.rig.camera_tilt, tilt)),
        )


def draw_setup(
    seed: int,
    photos: str = "raw",
    *,
    exposures: int = 2,
    sheet: bool = False,
    sphere: bool | None = None,
    camera_height: float | None = None,
    lamps: int = 0,
) -> Setup:
    """A set-up as people build it; the same seed gives the same one.

    photos: "raw" (linear EXR that no lens correction has seen), "bracket" (JPEGs of so many
    ``exposures``) or "jpeg" (one, exposed for the sample or in the middle between it and the
    display in the ball). sphere: whether the ball is one, drawn if None; camera_height: metres,
    where the camera's lens is to follow from it. lamps: so many photos without a screen instead,
    each exposed for the sample under a lamp of its own, the camera held anew. Raises `InputError`
    where no lens does.
    """
    draw = _Draw(seed)
    rig = _geometry(draw, sphere, camera_height)
    nominal = replace(
        rig,
        screen_height=rig.screen_height + draw("measured", 0),
        camera_offset=rig.camera_offset + draw("measured", 1),
        camera_height=float(rig.camera[2]) + draw("measured", 2),
        fov=rig.fov * draw("measured_fov"),
        screen_bezel=0.0,
    )
    rig = _held(draw, rig)
    raw = photos == "raw"
    camera = Camera(
        distortion=draw("distortion"),
        vignetting=draw("raw_vignetting") if raw else draw("vignetting"),
        blur=draw("blur"),
        electrons=draw("electrons"),
        shoulder=0.0 if raw else draw("shoulder"),
        contrast=0.0 if raw else draw("contrast"),
        display_p3=not raw and draw.share("display_p3") < 0.5,
        quality=round(draw("quality")),
    )
    moved = np.array([draw("ball_shift", 0), draw("ball_shift", 1), 0.0])
    ball = rig.ball_centre + moved * (ON_ITS_MARK if sheet else 1.0)
    named = {"raw": ("screen",), "jpeg": (("sample", "middle")[draw.share("exposure") < 0.5],)}
    bracket = ("sample", "screen") if exposures == 2 else ("sample", "middle", "screen")
    for_what = ("sample",) * lamps if lamps else named.get(photos, bracket)
    still = (0.0, 0.0, 0.0)
    shift, turn = ("camera_shift", "camera_tilt") if lamps else ("shake", "shake_tilt")
    shakes = [
        (draw.rgb(shift, 3 * k), draw.rgb(turn, 3 * k)) if k else (still, still)
        for k in range(len(for_what))
    ]
    gain, tint = draw("gain"), draw.rgb("gain_rgb")
    table, paint = draw("table"), draw.rgb("gain_rgb", 3)
    if lamps:
        rig, nominal = without_screen(rig), without_screen(nominal)
    return Setup(
        rig, nominal, _device(draw), _vec3(gain * np.array(tint)), _vec3(ball),
        draw("ball_alpha"), _vec3(np.minimum(table * np.array(paint), 0.9)), sheet, camera,
        photos, for_what, tuple(shakes), draw_lamps(seed, lamps), draw("ink"),
    )  # fmt: skip


def without_screen(rig: Rig) -> Rig:
    """The rig without its screen."""
    height = rig.screen_height if rig.camera_height is None else rig.camera_height
    return replace(
        rig, screen_size=None, sample_side=rig.sample_size, screen_height=height,
        camera_height=height, screen_bezel=0.0,
    )  # fmt: skip


def draw_lamps(seed: int, count: int) -> tuple[Lamp, ...]:
    """A lamp that is moved about the sample: centre, radius and radiance of each photo's."""
    draw = _Draw(seed)
    lamps: list[Lamp] = []
    for k in range(count):
        distance, angle = draw("lamp_distance", k), math.radians(draw("lamp_angle", k))
        around = 2 * math.pi * (k + draw.share("lamp_around", k)) / count
        out = distance * math.sin(angle)
        centre = out * math.cos(around), out * math.sin(around), distance * math.cos(angle)
        radius = min(draw("lamp_radius", k), LARGEST_LAMP * centre[2])
        # Of a sphere E = π L (r / d)² cos θ, wholly above the horizon.
        level = draw("lamp_light", k) / (math.pi * (radius / distance) ** 2 * math.cos(angle))
        lamps.append((centre, radius, (level, level, level)))
    return tuple(lamps)


class _Draw:
    """Numbers of a seed, by name."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def share(self, name: str, k: int = 0) -> float:
        """Uniform between 0 and 1."""
        key = [self.seed, zlib.crc32(name.encode()), k]
        return float(np.random.default_rng(key).uniform())

    def __call__(self, name: str, k: int = 0) -> float:
        r = RANGES[name]
        share = self.share(name, k)
        return r.low * (r.high / r.low) ** share if r.log else r.low + (r.high - r.low) * share

    def rgb(self, name: str, k: int = 0) -> Vec3:
        return self(name, k), self(name, k + 1), self(name, k + 2)


def _device(draw: _Draw) -> Device:
    gamma = draw("gamma")
    mixing = []
    for i in range(3):
        total, part = draw("mixing", i), draw.share("mixing to", i)
        row = [0.0, 0.0, 0.0]
        row[i], row[i - 1], row[i - 2] = 1 - total, total * part, total * (1 - part)
        mixing.append(_vec3(row))
    return Device(
        draw("falloff"),
        _vec3(np.add(gamma, draw.rgb("gamma_rgb"))),
        draw("black"),
        (mixing[0], mixing[1], mixing[2]),
    )


def _geometry(draw: _Draw, sphere: bool | None, camera_height: float | None) -> Rig:
    """The rig before a hand moves it: the camera so high and so far beside that its lens sees
    sample and ball, and the display hides neither."""
    tablet, _ = find_tablet(DRAWN_TABLETS[int(draw.share("tablet") * len(DRAWN_TABLETS))])
    long, short = (round(side, 4) for side in tablet.sides)
    size = (long, short) if draw.share("landscape") < 0.5 else (short, long)
    sphere = draw.share("sphere") < 0.5 if sphere is None else sphere
    reflectance = draw("reflectance") * np.array(draw.rgb("reflectance_rgb"))
    rig = Rig(
        size, draw("screen_height"), draw("offset"), draw("ball_radius"),
        ball_reflectance=_vec3(np.clip(reflectance, 0.05, 0.95)),
        ball_shape="sphere" if sphere else "hemisphere",
        screen_bezel=draw("bezel"), sample_side=min(draw("sample"), short / 2),
    )  # fmt: skip
    low, high = RANGES["focal"].low, RANGES["focal"].high
    # The square of a uniform number: half of all lenses are wider than 34 mm.
    focal = low * (high / low) ** (draw.share("focal") ** 2)
    for _ in range(200):
        # half of what the photo shows
        reach = (rig.optical_axis_x + rig.sample_size / 2) / PHOTO_MARGIN
        if camera_height is None:
            height = max(reach * focal / HALF_WIDTH, FOCUS)
        else:
            height, focal = camera_height, HALF_WIDTH * camera_height / reach
            if not low * 0.9 <= focal <= high * 1.1:
                raise InputError(
                    f"no lens of {low:g} to {high:g} mm fits a camera {camera_height:g} m high"
                )
        fov = fov_of(HALF_WIDTH / focal)
        rig = replace(rig, camera_height=float(height), fov=fov)
        if not hides(rig, CLEARANCE):
            return rig
        rig = replace(rig, camera_offset=rig.camera_offset + STEP)
    raise InputError(f"a display hides the sample from a camera {height:g} m high; hold it lower")


def hides(rig: Rig, clearance: float = 0.0) -> bool:
    """Whether the display, ``clearance`` larger on each side, hides a corner of the sample or an
    edge of the ball from the camera."""
    ball = rig.ball_centre + rig.ball_radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0]])
    points = np.concatenate([rig.sample_corners, ball])
    if not rig.has_screen:
        return False
    corner, (e_x, e_y) = rig.screen_body
    normal = np.cross(e_x, e_y)
    d = points - rig.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((corner - rig.camera) @ normal) / (d @ normal)
        on = rig.camera + t[:, None] * d - corner
    x, y = np.linalg.norm(e_x), np.linalg.norm(e_y)
    s, u = on @ e_x / x, on @ e_y / y
    inside = (s > -clearance) & (s < x + clearance) & (u > -clearance) & (u < y + clearance)
    return bool(((t > 0) & (t < 1) & inside).any())


def _held(draw: _Draw, rig: Rig) -> Rig:
    """The rig as hands hold it, less far off where the camera would miss something."""
    for k in range(8):
        part = 0.5**k
        moved = replace(
            rig,
            screen_shift=_vec3(part * np.array(draw.rgb("screen_shift"))),
            screen_tilt=_vec3(part * np.array(draw.rgb("screen_tilt"))),
            camera_shift=_vec3(part * np.array(draw.rgb("camera_shift"))),
            camera_tilt=_vec3(part * np.array(draw.rgb("camera_tilt"))),
        )
        if not hides(moved) and _in_view(moved):
            return moved
    return rig


def _in_view(rig: Rig) -> bool:
    """Whether sample and ball are in a photo of 4 : 3."""
    reach = rig.ball_radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    points = np.concatenate([rig.sample_corners, rig.ball_centre + 1.5 * reach])
    p = rig.project(points, 3, 4)
    return bool(np.all((p > 0.05) & (p < [3.95, 2.95])))


def ranges_table() -> tuple[list[str], list[list[Any]]]:
    """The table of docs/reference-simulate.md: header and rows."""
    return ["what", "from", "to"], [[r.what, float(r.low), float(r.high)] for r in RANGES.values()]


def _vec3(v: Array | list[float] | tuple[float, ...]) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])
