"""Radiance of the sample as the camera sees it, with its derivatives.

    I(x) = ∫ f(l, v) L(x, l) (n·l)+ dl over z > 0,
    L = gain × pattern where x + r·l meets the screen, else the environment.

``fast`` (`invrender.render.fast.estimator`) is nearly free of noise and has a small bias; ``mis``
(`invrender.render.mis`) is unbiased. The table is a plane and the ball is small: one bounce is
exact. Gradients with respect to the maps come from each pixel's Jacobian, which the forward pass
carries along; lights and pose are differentiated by Dr.Jit through the same code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from invrender.maps import Maps
from invrender.render import brdf
from invrender.render.backend import Float, dr, vector
from invrender.render.fast.estimator import shade_fast
from invrender.render.fast.tables import Tables, fast_tables
from invrender.render.mis import EnvironmentSampler, shade_mis
from invrender.render.scene import Scene, View, aligned, make_scene, make_view
from invrender.render.shading import Shading
from invrender.rig import Rig

TILE = 1 << 20  # pixels rendered at once
MIN_ROUGHNESS = 1e-3  # a tenth of the model's range; α⁴ must not underflow


@dataclass
class Material:
    """Per-pixel parameters: Dr.Jit arrays of H·W entries in row order, or of one.

    diffuse, specular: Array3; roughness: Float; normal: Array3 of any length, normalised here.
    """

    diffuse: Any
    specular: Any
    roughness: Any
    normal: Any


@dataclass
class Unbiased:
    """A scene prepared for the ``mis`` estimator, as `Tables` is one prepared for ``fast``."""

    scene: Scene
    sampler: EnvironmentSampler | None


def prepare(scene: Scene, estimator: str = "fast", detail: int = 1) -> Tables | Unbiased:
    """Precompute what an estimator, ``fast`` or ``mis``, needs to know of a scene's lights.

    detail: a power of two that multiplies the sizes of the fast one's tables.
    """
    if estimator == "fast":
        return fast_tables(scene, detail)
    if estimator == "mis":
        return Unbiased(scene, EnvironmentSampler.build(scene))
    raise ValueError(f"estimator must be 'fast' or 'mis', got {estimator!r}")


def shade(
    prepared: Tables | Unbiased,
    view: View,
    roughness: Any,
    normal: Any,
    samples: int,
    jacobian: bool = False,
) -> Shading:
    """E, B and A of I = k_d·E/π + k_s·B + A at the pixels of a view; normal: unit vectors.

    Roughness below `MIN_ROUGHNESS` is taken as that.
    """
    roughness = dr.maximum(roughness, MIN_ROUGHNESS)
    if isinstance(prepared, Tables):
        return shade_fast(prepared, view, roughness, normal, samples, jacobian)
    return shade_mis(prepared.scene, prepared.sampler, view, roughness, normal, samples, jacobian)


def radiance(prepared: Tables | Unbiased, view: View, material: Material, samples: int) -> Any:
    """Radiance towards the camera at the pixels of a view, an Array3, differentiable.

    Gradients with respect to the maps come from the Jacobian that the forward pass carries along;
    with respect to lights and pose from Dr.Jit's own differentiation of the same code.
    """
    scene = prepared.scene
    lights = (
        scene.camera, scene.corner, scene.edge_x, scene.edge_y,
        scene.pattern, scene.gain, scene.environment, scene.scale,
    )  # fmt: skip
    maps = (material.diffuse, material.specular, material.roughness, material.normal)
    if dr.grad_enabled(maps) and not dr.grad_enabled(lights):
        return dr.custom(_Radiance, _Job(prepared, view, samples), *maps)
    shading = shade(prepared, view, material.roughness, dr.normalize(material.normal), samples)
    return _compose(material.diffuse, material.specular, shading)


def _compose(diffuse: Any, specular: Any, shading: Shading) -> Any:
    color = dr.fma(specular, shading.b, shading.a)
    return dr.fma(diffuse * (1 / dr.pi), shading.irradiance, color)


class _Job:
    """Arguments of `_Radiance` that carry no gradients."""

    def __init__(self, prepared: Tables | Unbiased, view: View, samples: int) -> None:
        self.prepared, self.view, self.samples = prepared, view, samples


class _Radiance(dr.CustomOp):
    """Radiance whose derivatives are the pixels' Jacobians, found in the forward pass."""

    def eval(self, job: _Job, diffuse: Any, specular: Any, roughness: Any, normal: Any) -> Any:
        self.j = pixel_jacobian(
            job.prepared, job.view, Material(diffuse, specular, roughness, normal), job.samples
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


def pixel_jacobian(
    prepared: Tables | Unbiased, view: View, material: Material, samples: int
) -> PixelJacobian:
    """All of a pixel's derivatives in one pass: 3 residuals × 9 parameters, mostly diagonal."""
    with dr.suspend_grad():
        length = dr.norm(material.normal)
        n = material.normal / length
        shading = shade(prepared, view, material.roughness, n, samples, jacobian=True)
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


def render(
    rig: Rig,
    maps: Maps,
    pattern: NDArray[Any] | None,
    environment: NDArray[Any] | None,
    gain: Any = 1.0,
    scale: float = 1.0,
    *,
    estimator: str = "fast",
    samples: int = 64,
    seed: int = 0,
) -> NDArray[np.float32]:
    """Linear RGB image (H, W, 3) of the sample from numpy arrays.

    pattern: (P, P, 3) relative radiance; environment: (H, 2H, 3) equirectangular; either None.
    """
    prepared = prepare(make_scene(rig, pattern, environment, gain, scale), estimator)
    return picture(prepared, maps, samples, seed)


def picture(
    prepared: Tables | Unbiased, maps: Maps, samples: int, seed: int = 0
) -> NDArray[np.float32]:
    """Linear RGB image (H, W, 3) of maps under prepared lights, in tiles of bounded memory."""
    height, width = maps.shape
    image = np.empty((height * width, 3), np.float32)
    for start in range(0, height * width, TILE):
        stop = min(start + TILE, height * width)
        view = make_view(prepared.scene, height, width, seed, start, stop - start)
        color = radiance(prepared, view, material_from_maps(maps, start, stop), samples)
        image[start:stop] = np.asarray(color).T
    return image.reshape(height, width, 3)


def material_from_maps(
    maps: Maps,
    start: int = 0,
    stop: int | None = None,
    scalar: type = Float,
    whole: bool = False,
) -> Material:
    """Dr.Jit arrays of the pixels start to stop.

    A map that is constant becomes one entry, which makes a kernel of its own, unless ``whole``.
    """
    vec3 = vector(scalar, 3)

    def rows(image: NDArray[Any]) -> NDArray[Any]:
        flat = image.reshape(-1, image.shape[2] if image.ndim == 3 else 1)[start:stop]
        if not whole and len(flat) > 1 and np.all(flat == flat[0]):
            flat = flat[:1]
        return aligned(flat.T, scalar)

    return Material(
        vec3(rows(maps.diffuse)),
        vec3(rows(maps.specular)),
        scalar(rows(maps.roughness)[0]),
        vec3(rows(maps.normal)),
    )
