"""Radiance of the sample as the camera sees it, with its derivatives.

    I(x) = ∫ f(l, v) L(x, l) (n·l)+ dl over z > 0,
    L = gain × pattern × cos(θ)^falloff where x + r·l meets the screen, else the environment.

`invrender.render.Fast` is nearly free of noise and has a small bias; `invrender.render.Mis` is
unbiased. The table is a plane and the ball is small: one bounce is
exact. Gradients with respect to the maps come from each pixel's Jacobian, which the forward pass
carries along; lights and pose are differentiated by Dr.Jit through the same code.
"""

from __future__ import annotations

import weakref
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from invrender.lights import Lights
from invrender.maps import Maps
from invrender.render import brdf
from invrender.render.backend import Float, dr, vector
from invrender.render.scene import Scene, View, aligned, make_view, scene_under
from invrender.render.shading import Shading

TILE = 1 << 20  # pixels rendered at once
MIN_ROUGHNESS = 1e-3  # a tenth of the model's range; α⁴ must not underflow


@dataclass
class Material:
    """Per-pixel parameters: Dr.Jit arrays of H·W entries in row order, or of one for all pixels.

    diffuse, specular: Array3; roughness: Float; normal: Array3 of any length, normalised here.
    """

    diffuse: Any
    specular: Any
    roughness: Any
    normal: Any

    @classmethod
    def from_maps(cls, maps: Maps, scalar: type = Float) -> Material:
        """One entry a pixel, of a constant map too: each can be optimised by itself."""
        return cls(*_arrays(scalar, *(x.reshape(-1, x[0, 0].size) for x in _images(maps))))


class Renderer(ABC):
    """The forward model, prepared for one scene: made once for a photo's lights, then passed on.

    It has two kinds, `invrender.render.Fast` and `invrender.render.Mis`.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._recorded: dict[tuple[int, int], Any] = {}

    @classmethod
    def under(cls, lights: Lights) -> Self:
        """Prepared for these lights."""
        return cls(scene_under(lights))

    def scaled(self, screen: Any, room: Any, added: Any = None) -> Self:
        """Under the same lights with the screen's and the room's radiance times a number or RGB.

        added: radiance (H, 2H, 3) that the room has more then, or less, of as many texels as it
        has.
        """
        scene = self.scene
        scalar = scene.scalar
        vec3 = vector(scalar, 3)
        by = [dr.opaque(scalar, float(x)) for x in np.broadcast_to(screen, 3)]
        environment = scene.environment
        if environment is not None and np.any(np.asarray(room) != 1):
            rgb = aligned(np.tile(np.broadcast_to(room, 3), dr.width(environment) // 3), scalar)
            environment = environment * scalar(rgb)
        if environment is not None and added is not None:
            environment = dr.maximum(environment + scalar(aligned(added.ravel(), scalar)), 0)
        return type(self)(replace(scene, gain=scene.gain * vec3(*by), environment=environment))

    @property
    @abstractmethod
    def traced(self) -> tuple[Any, ...]:
        """Dataclasses that hold all Dr.Jit arrays of which pixels are shaded."""

    @abstractmethod
    def _shade(
        self, view: View, roughness: Any, normal: Any, samples: int, jacobian: bool
    ) -> Shading: ...

    def shade(
        self, view: View, roughness: Any, normal: Any, samples: int, jacobian: bool = False
    ) -> Shading:
        """E, B and A of I = k_d·E/π + k_s·B + A at the pixels of a view; normal: unit vectors.

        Roughness below `MIN_ROUGHNESS` is taken as that.
        """
        return self._shade(view, dr.maximum(roughness, MIN_ROUGHNESS), normal, samples, jacobian)

    def radiance(self, view: View, material: Material, samples: int) -> Any:
        """Radiance towards the camera at the pixels of a view, an Array3, differentiable.

        Gradients with respect to the maps come from the Jacobian that the forward pass carries
        along; with respect to lights and pose from Dr.Jit's own differentiation of the same code.
        """
        scene = self.scene
        lights = (
            scene.camera, scene.corner, scene.edge_x, scene.edge_y,
            scene.pattern, scene.gain, scene.environment, scene.scale,
        )  # fmt: skip
        maps = (material.diffuse, material.specular, material.roughness, material.normal)
        if dr.grad_enabled(maps) and not dr.grad_enabled(lights):
            return dr.custom(_Radiance, _Job(self, view, samples), *maps)
        shading = self.shade(view, material.roughness, dr.normalize(material.normal), samples)
        return _compose(material.diffuse, material.specular, shading)

    def pixel_jacobian(self, view: View, material: Material, samples: int) -> PixelJacobian:
        """All of a pixel's derivatives in one pass: 3 residuals × 9 parameters, mostly diagonal."""
        with dr.suspend_grad():
            length = dr.norm(material.normal)
            n = material.normal / length
            shading = self.shade(view, material.roughness, n, samples, jacobian=True)
            k_d, k_s = material.diffuse * (1 / dr.pi), material.specular
            rows = [k_d * e + k_s * b + a for e, b, a in shading.tangents]
            s, t = brdf.frame(n)
            j = PixelJacobian(
                radiance=_compose(material.diffuse, k_s, shading),
                diffuse=shading.irradiance / dr.pi,
                specular=shading.b,
                roughness=rows[0],
                tangent_s=rows[1] / length,
                tangent_t=rows[2] / length,
                s=s,
                t=t,
            )
            # One kernel, the same whatever is done with its results.
            dr.eval(list(j.__dict__.values()))
            return j

    def jacobian_again(self, view: View, material: Material, samples: int) -> PixelJacobian:
        """`pixel_jacobian` for many calls: from the second one for as many pixels it is not traced
        any more, which takes longer than the kernels of some thousands of pixels."""
        key = dr.width(view.x), samples
        if key not in self._recorded:
            me: Renderer = weakref.proxy(self)  # else it would live until garbage is collected
            self._recorded[key] = dr.freeze(
                lambda view, material: me.pixel_jacobian(view, material, samples),
                state_fn=lambda *_: me.traced,
            )
            return self.pixel_jacobian(view, material, samples)
        jacobian: PixelJacobian = self._recorded[key](view, material)
        return jacobian

    def render(self, maps: Maps, samples: int = 64, seed: int = 0) -> NDArray[np.float32]:
        """Linear RGB image (H, W, 3) of maps, in tiles of bounded memory."""
        height, width = maps.shape
        image = np.empty((height * width, 3), np.float32)
        for start in range(0, height * width, TILE):
            stop = min(start + TILE, height * width)
            view = make_view(self.scene, height, width, seed, start, stop - start)
            color = self.radiance(view, tile_of(maps, start, stop), samples)
            image[start:stop] = np.asarray(color).T
        return image.reshape(height, width, 3)


def _compose(diffuse: Any, specular: Any, shading: Shading) -> Any:
    color = dr.fma(specular, shading.b, shading.a)
    return dr.fma(diffuse * (1 / dr.pi), shading.irradiance, color)


class _Job:
    """Arguments of `_Radiance` that carry no gradients."""

    def __init__(self, renderer: Renderer, view: View, samples: int) -> None:
        self.renderer, self.view, self.samples = renderer, view, samples


class _Radiance(dr.CustomOp):
    """Radiance whose derivatives are the pixels' Jacobians, found in the forward pass."""

    def eval(self, job: _Job, diffuse: Any, specular: Any, roughness: Any, normal: Any) -> Any:
        self.j = job.renderer.pixel_jacobian(
            job.view, Material(diffuse, specular, roughness, normal), job.samples
        )
        self.width = {k: dr.width(v) for k, v in zip(
            ("diffuse", "specular", "roughness", "normal"), (diffuse, specular, roughness, normal),
            strict=True)}  # fmt: skip
        return self.j.radiance

    def forward(self) -> None:
        j = self.j
        normal = self.grad_in("normal")
        self.set_grad_out(
            self.grad_in("diffuse") * j.diffuse
            + self.grad_in("specular") * j.specular
            + j.roughness * self.grad_in("roughness")
            + j.tangent_s * dr.dot(normal, j.s)
            + j.tangent_t * dr.dot(normal, j.t)
        )

    def backward(self) -> None:
        j = self.j
        g = self.grad_out()
        grads = {
            "diffuse": g * j.diffuse,
            "specular": g * j.specular,
            "roughness": dr.dot(g, j.roughness),
            "normal": j.s * dr.dot(g, j.tangent_s) + j.t * dr.dot(g, j.tangent_t),
        }
        for name, grad in grads.items():
            one = self.width[name] == 1 and dr.width(grad) > 1
            self.set_grad_in(name, _total(grad) if one else grad)

    def name(self) -> str:
        return "radiance"


def _total(grad: Any) -> Any:
    """Sum over pixels, for a parameter that all share."""
    if dr.depth_v(grad) == 1:
        return dr.sum(grad)
    return type(grad)(*(dr.sum(c) for c in grad))


@dataclass
class PixelJacobian:
    """Radiance and its derivatives, all Array3 over the pixels.

    diffuse, specular: the diagonal dI_c/dk_c. roughness: dI/dρ. tangent_s, tangent_t: dI along the
    unit tangents s and t of the normal, divided by the normal's length.
    """

    radiance: Any
    diffuse: Any
    specular: Any
    roughness: Any
    tangent_s: Any
    tangent_t: Any
    s: Any
    t: Any


def _images(maps: Maps) -> tuple[NDArray[Any], ...]:
    return maps.diffuse, maps.specular, maps.roughness, maps.normal


def _arrays(
    scalar: type,
    diffuse: NDArray[Any],
    specular: NDArray[Any],
    roughness: NDArray[Any],
    normal: NDArray[Any],
) -> tuple[Any, Any, Any, Any]:
    """Dr.Jit arrays of rows of pixels."""
    vec3 = vector(scalar, 3)
    k_d, k_s, rho, n = (aligned(x.T, scalar) for x in (diffuse, specular, roughness, normal))
    return vec3(k_d), vec3(k_s), scalar(rho[0]), vec3(n)


def tile_of(maps: Maps, start: int, stop: int) -> Material:
    """The pixels start to stop to be rendered only: a constant map is one entry, and cheaper."""

    def rows(image: NDArray[Any]) -> NDArray[Any]:
        flat = image.reshape(-1, image[0, 0].size)[start:stop]
        return flat[:1] if np.all(flat == flat[0]) else flat

    return Material(*_arrays(Float, *(rows(x) for x in _images(maps))))
