"""The forward model as a differentiable PyTorch function, to couple it with a network."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from invrender.render import renderer as render
from invrender.render.backend import ad, dr, vector
from invrender.render.fast.tables import Tables
from invrender.render.scene import View


def radiance(
    prepared: Tables | render.Unbiased,
    view: View,
    diffuse: Tensor,
    specular: Tensor,
    roughness: Tensor,
    normal: Tensor,
    samples: int = 64,
) -> Tensor:
    """Radiance of the view's pixels, shaped like ``diffuse``: (N, 3) or (H, W, 3).

    diffuse, specular, normal: (..., 3); roughness: (...) or (..., 1); of the precision that the
    scene was made in. Gradients flow to all four by the pixels' Jacobians; where none is needed
    no Jacobian is computed. Contiguous tensors pass to Dr.Jit as they are; splitting their
    channels is one copy each way, since Dr.Jit stores each channel by itself.
    """
    scalar = prepared.scene.scalar
    dtype = torch.float64 if scalar is ad.Float64 else torch.float32
    tensors = (diffuse, specular, roughness, normal)
    if any(t.dtype is not dtype for t in tensors):
        raise TypeError(f"the scene needs tensors of {dtype}, got {[t.dtype for t in tensors]}")
    tensor_type = ad.TensorXf64 if scalar is ad.Float64 else ad.TensorXf

    def image(k_d: Any, k_s: Any, rho: Any, n: Any) -> Any:
        vec3, uint = vector(scalar, 3), dr.uint32_array_t(scalar)
        i = dr.arange(uint, k_d.shape[0])
        split = lambda t: dr.gather(vec3, t.array, i)  # noqa: E731
        material = render.Material(split(k_d), split(k_s), rho.array, split(n))
        color = render.radiance(prepared, view, material, samples)
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
