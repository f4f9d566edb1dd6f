"""What the fast estimator reads: filtered lights, irradiance tables, lamps one by one.

Built from a `Scene` by Dr.Jit code, so that gradients pass through to the lights and the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from invrender.render.backend import dr, vector
from invrender.render.fast.irradiance import SkyIrradiance, VectorIrradiance
from invrender.render.fast.lamps import Lamps, corner_hits, split_lamps
from invrender.render.fast.pyramid import Pyramid, disc_direction
from invrender.render.scene import Scene, environment_at, pattern_at

SCREEN_TEXELS = 256  # at least so many a side on the screen, so that its edge is sharp
SKY_TEXELS = 4  # of the disc a side for each row of the environment
SKY_RANGE = 256, 1024  # texels of the disc a side


@dataclass
class Tables:
    """What the fast estimator reads; rebuilt when the lights or the screen's pose change.

    screen: RGBA pyramid of gain × pattern. sky: RGBA pyramid of the environment above the table on
    Lambert's disc, without its lamps and what the screen hides from the whole sample (A = 0 there).
    ``detail`` multiplies the sizes of all tables: the estimator's bias goes to zero as both it and
    the samples grow.
    """

    scene: Scene
    screen: Pyramid | None
    sky: Pyramid | None
    sky_irradiance: SkyIrradiance | None
    vector_irradiance: VectorIrradiance | None
    lamps: Lamps | None
    detail: int


def fast_tables(scene: Scene, detail: int = 1) -> Tables:
    """Build the `Tables` of a scene, differentiably with respect to all of its fields.

    detail: a power of two.
    """
    screen = sky = irradiance = added = lamps = None
    if scene.pattern is not None:
        screen = _screen_pyramid(scene, detail)
    if scene.environment is not None:
        lamps, rest = split_lamps(scene)
        sky = _sky_pyramid(replace(scene, environment=rest), detail)
        irradiance = SkyIrradiance.build(sky, scene.scalar, detail)
    if screen is not None:
        added = VectorIrradiance.build(scene, screen, sky, detail)
    return Tables(scene, screen, sky, irradiance, added, lamps, detail)


def _power_of_two(n: int) -> int:
    return 1 << max(n - 1, 0).bit_length()


def _grid(uint: type, scalar: type, n: int) -> tuple[Any, Any]:
    """Centres of n × n cells in [0, 1]², row order."""
    i = dr.arange(uint, n * n)
    row = i // n
    return (scalar(i - row * n) + 0.5) / n, (scalar(row) + 0.5) / n


def _screen_pyramid(scene: Scene, detail: int) -> Pyramid:
    scalar = scene.scalar
    n = max(_power_of_two(max(scene.pattern_shape)), SCREEN_TEXELS) * detail
    x, y = _grid(dr.uint32_array_t(scalar), scalar, n)
    rgb = pattern_at(scene, x, 1 - y, 1 / n)
    return Pyramid.build(vector(scalar, 4)(rgb.x, rgb.y, rgb.z, 1), n)


def _sky_pyramid(scene: Scene, detail: int) -> Pyramid:
    scalar = scene.scalar
    uint, vec3, vec4 = dr.uint32_array_t(scalar), vector(scalar, 3), vector(scalar, 4)
    least, most = SKY_RANGE
    n = min(max(SKY_TEXELS * _power_of_two(scene.env_height), least), most) * detail
    x, y = _grid(uint, scalar, n)
    px, py = x * 2 - 1, 1 - y * 2
    inside = px * px + py * py < 1
    d = disc_direction(dr.select(inside, px, 0), dr.select(inside, py, 0), vec3)
    hidden, _ = corner_hits(dr.detach(scene), d, 0)
    seen = dr.select(inside & ~hidden, environment_at(scene, d), 0)
    image = vec4(seen.x, seen.y, seen.z, dr.select(inside & hidden, scalar(0), 1))
    dr.eval(image)
    return Pyramid.build(image, n)
