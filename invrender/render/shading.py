"""Sums over light samples of the three terms of radiance, with their derivatives if asked for.

Radiance is affine in the albedos, I = k_d·E/π + k_s·B + A. A pass that also carries the derivatives
of E, B and A along roughness and the normal's two tangents knows each pixel's whole Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from invrender.render import brdf
from invrender.render.backend import dr, while_loop


@dataclass
class Shading:
    """E, B and A of I = k_d·E/π + k_s·B + A, and their three tangents where asked for."""

    irradiance: Any
    b: Any
    a: Any
    tangents: list[tuple[Any, Any, Any]]


def with_tangents(
    f: Callable[[Any, Any], tuple[Any, ...]], rho: Any, n: Any
) -> tuple[list[Any], list[list[Any]]]:
    """Values of f(ρ, n) and their derivatives along ρ and the normal's tangents s and t."""
    scalar = type(rho)
    s, t = brdf.frame(n)
    with dr.resume_grad():
        tau = [scalar(0), scalar(0), scalar(0)]
        dr.enable_grad(tau)
        values = list(f(rho + tau[0], dr.normalize(n + s * tau[1] + t * tau[2])))
        tangents = []
        for k in range(3):
            dr.set_grad(tau[k], 1)
            dr.enqueue(dr.ADMode.Forward, tau[k])
            last = k == 2
            dr.traverse(
                dr.ADMode.Forward,
                flags=dr.ADFlag.ClearVertices if last else dr.ADFlag.ClearInterior,
            )
            tangents.append([dr.detach(dr.grad(v)) for v in values])
            if not last:
                for v in (*values, tau[k]):
                    dr.set_grad(v, 0)
        values = [dr.detach(v) for v in values]
    return values, tangents


class Sums:
    """Running sums of E, B and A and, where ``jacobian``, of their tangents: rows of three."""

    def __init__(self, vec3: type, width: int, jacobian: bool) -> None:
        self.rows = [[dr.zeros(vec3, width) for _ in range(3)] for _ in range(4 if jacobian else 1)]
        self.jacobian = jacobian
        self.width = width

    def derive(self, f: Any, rho: Any, n: Any) -> list[list[Any]]:
        """Rows of f(ρ, n): its values and, if this holds any, their tangents."""
        if not self.jacobian:
            return [list(f(rho, n))]
        values, tangents = with_tangents(f, rho, n)
        return [values, *tangents]

    def add(self, rows: list[list[Any]], targets: tuple[int, ...]) -> None:
        """Add rows to the targets: 0, 1, 2 are E, B, A."""
        for row, terms in zip(self.rows, rows, strict=True):
            for k, term in zip(targets, terms, strict=True):
                row[k] = row[k] + term

    def run(
        self,
        count: Any,
        rows: Callable[[Any], list[list[Any]]],
        targets: tuple[int, ...],
        label: str,
        factor: Any = 1,
        following: Callable[[Any], Any] = lambda i: i + 1,
        first: Any = 0,
    ) -> None:
        """Add factor · rows(i) for i = first, following(first), ... below count.

        first and count may differ by pixel.
        """
        uint = type(count)

        def body(i: Any, *sums: Any) -> tuple[Any, ...]:
            terms = [x for row in rows(i) for x in row]
            return (following(i), *(x + y for x, y in zip(sums, terms, strict=True)))

        step = len(targets)
        zero = dr.zeros(type(self.rows[0][0]), self.width)
        out = while_loop(
            (first + dr.zeros(uint, self.width), *(zero for _ in range(step * len(self.rows)))),
            lambda i, *_: i < count,
            body,
            max_iterations=-1,
            label=label,
        )[1:]
        for j, row in enumerate(self.rows):
            for k, target in enumerate(targets):
                row[target] = dr.fma(out[j * step + k], factor, row[target])

    def shading(self) -> Shading:
        e, b, a = self.rows[0]
        return Shading(e, b, a, [(r[0], r[1], r[2]) for r in self.rows[1:]])
