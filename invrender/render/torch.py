"""The forward model as a differentiable PyTorch function, to couple it with a network."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from invrender.render import renderer as drjit
from invrender.render.backend import ad, dr, vector
from invrender.render.scene import View, make_view


class Renderer:
    """`invrender.render.Renderer` for PyTorch: radiance of the sample from tensors of its maps.

        renderer = Renderer(Fast(make_scene(rig, pattern, environment, gain)))
        image = renderer(diffuse, specular, roughness, normal)

    Gradients flow to all four maps by the pixels' Jacobians; where none is needed no Jacobian is
    computed. The lights carry none: differentiate those in Dr.Jit.
    """

    def __init__(self, renderer: drjit.Renderer) -> None:
        self.renderer = renderer

    def __call__(
        self,
        diffuse: Tensor,
        specular: Tensor,
        roughness: Tensor,
        normal: Tensor,
        *,
        samples: int = 64,
        seed: int = 0,
        view: View | None = None,
    ) -> Tensor:
        """Linear radiance, shaped like ``diffuse``.

        diffuse, specular, normal: (H, W, 3); roughness: (H, W) or (H, W, 1); of the precision that
        the scene was made in, else `TypeError`. view: the pixels that are meant, where they are not
        those of an image of the whole sample; the maps may be (N, 3) then. samples: of the specular
        lobe. Contiguous tensors pass to Dr.Jit as they are; splitting their channels is one copy
        each way, since Dr.Jit stores each channel by itself.
        """
        scene = self.renderer.scene
        scalar = scene.scalar
        dtype = torch.float64 if scalar is ad.Float64 else torch.float32
        tensors = (diffuse, specular, roughness, normal)
        if any(t.dtype is not dtype for t in tensors):
            raise TypeError(f"the scene needs tensors of {dtype}, got {[t.dtype for t in tensors]}")
        height, width = diffuse.shape[:2]
        pixels = make_view(scene, height, width, seed) if view is None else view
        tensor_type = ad.TensorXf64 if scalar is ad.Float64 else ad.TensorXf

        def image(k_d: Any, k_s: Any, rho: Any, n: Any) -> Any:
            vec3, uint = vector(scalar, 3), dr.uint32_array_t(scalar)
            i = dr.arange(uint, k_d.shape[0])
            split = lambda t: dr.gather(vec3, t.array, i)  # noqa: E731
            material = drjit.Material(split(k_d), split(k_s), rho.array, split(n))
            color = self.renderer.radiance(pixels, material, samples)
            return tensor_type(dr.ravel(color), (k_d.shape[0], 3))

        flat = [t.reshape(-1, 3).contiguous() for t in (diffuse, specular, normal)]
        rho = roughness.reshape(-1).contiguous()
        if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
            color = dr.wrap(source="torch", target="drjit")(image)(flat[0], flat[1], rho, flat[2])
        else:
            with dr.suspend_grad():
                k_d, k_s, r, n = (tensor_type(t.detach()) for t in (flat[0], flat[1], rho, flat[2]))
                color = image(k_d, k_s, r, n).torch()
        return color.reshape(diffuse.shape)
