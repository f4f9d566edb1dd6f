"""A lamp that is near: each point of the sample sees it elsewhere, and as bright as it is near.

The environment shows it as it is seen from the ball. A point x of the sample sees it in another
direction and under another solid angle. So the lamp is shaded by itself, with the sample turned
until the lamp lies where the environment shows it, and its light times the squared ratio of the two
distances: exact for a lamp that is small, and the rest of the room stays where it is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np

from invrender.lights import Lights, NearLamp
from invrender.render import brdf
from invrender.render.backend import dr, vector
from invrender.render.fast.estimator import Fast
from invrender.render.renderer import Renderer
from invrender.render.scene import View
from invrender.render.shading import Shading


def renderer_under(lights: Lights) -> Renderer:
    """The fast estimator prepared for lights, with the lamp among them that is near, if any."""
    near = lights.near
    if near is None:
        return Fast.under(lights)
    share = near.share[..., None]
    room, lamp = (replace(lights, environment=lights.environment * s) for s in (1 - share, share))
    return WithNearLamp(Fast.under(room), Fast.under(lamp), near)


class WithNearLamp(Renderer):
    """The fast estimator for the room, and for a lamp in it that is near."""

    def __init__(self, room: Fast, lamp: Fast, near: NearLamp) -> None:
        super().__init__(room.scene)
        self.room, self.lamp, self.near = room, lamp, near

    @property
    def traced(self) -> tuple[Any, ...]:
        return *self.room.traced, *self.lamp.traced

    def scaled(self, screen: Any, room: Any, added: Any = None) -> Self:
        own = self.near.share[..., None]
        rest, more = (None, None) if added is None else (added * (1 - own), added * own)
        lamp = self.lamp.scaled(screen, room, more)
        return type(self)(self.room.scaled(screen, room, rest), lamp, self.near)

    def _shade(
        self, view: View, roughness: Any, normal: Any, samples: int, jacobian: bool
    ) -> Shading:
        room = self.room.shade(view, roughness, normal, samples, jacobian)
        scalar = self.scene.scalar
        vec3 = vector(scalar, 3)
        place, seen = (
            vec3(*(dr.opaque(scalar, float(c)) for c in v))
            for v in (self.near.place, np.subtract(self.near.place, self.near.seen_from))
        )
        to = place - view.x
        here, there = dr.normalize(to), dr.normalize(seen)
        both = here + there
        by = dr.rcp(1 + dr.dot(here, there))

        def turned(v: Any) -> Any:
            """By the rotation that takes the lamp from where it is to where it is shown."""
            return v - both * (dr.dot(both, v) * by) + there * (2 * dr.dot(here, v))

        n = turned(normal)
        turned_view = replace(view, to_camera=turned(view.to_camera))
        lamp = self.lamp.shade(turned_view, roughness, n, samples, jacobian)
        scale = dr.squared_norm(seen) / dr.squared_norm(to)

        def sum_of(a: tuple[Any, ...], b: tuple[Any, ...]) -> tuple[Any, Any, Any]:
            e, first, rest = (dr.fma(y, scale, x) for x, y in zip(a, b, strict=True))
            return e, first, rest

        tangents = []
        if jacobian:
            # The lamp's are along the tangents of the turned normal's own frame.
            along_rho, *along = lamp.tangents
            frame = brdf.frame(n)
            lit = [along_rho]
            for axis in map(turned, brdf.frame(normal)):
                u, v = (dr.dot(axis, f) for f in frame)
                lit.append(tuple(u * x + v * y for x, y in zip(*along, strict=True)))
            tangents = [sum_of(a, b) for a, b in zip(room.tangents, lit, strict=True)]
        terms = sum_of((room.irradiance, room.b, room.a), (lamp.irradiance, lamp.b, lamp.a))
        return Shading(*terms, tangents)
