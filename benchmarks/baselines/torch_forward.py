"""The mis estimator's BSDF-and-light sampling in plain PyTorch: a baseline, not a tool.

One sample each of the screen's area, of the environment's texels and of the visible normals a
round, by the balance heuristic, as `invrender.render.mis` does it; whole-image tensors, no fused
kernel.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from invrender.rig import Rig

Array = Any


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1, keepdim=True)


def _unit(a: Tensor) -> Tensor:
    return F.normalize(a, dim=-1)


class TorchScene:
    """A rig with pattern (P, P, 3) and environment (H, 2H, 3) as tensors."""

    def __init__(self, rig: Rig, maps: Any, pattern: Array, environment: Array, gain: float):
        t = lambda x: torch.as_tensor(x.copy() if hasattr(x, "copy") else x, dtype=torch.float32)  # noqa: E731
        h, w = maps.shape
        self.x = t(rig.sample_points(h, w)).reshape(-1, 3)
        self.v = _unit(t(rig.camera) - self.x)
        self.corner, (self.e_x, self.e_y) = t(rig.screen_corner), (t(e) for e in rig.screen_edges)
        m = torch.linalg.cross(self.e_x, self.e_y)
        self.area, self.m = m.norm(), _unit(m)
        self.pattern = t(pattern * gain).permute(2, 0, 1)[None]
        env = t(environment)
        self.h = env.shape[0]
        wrapped = torch.cat([env[:, -1:], env, env[:, :1]], 1)
        self.env = wrapped.permute(2, 0, 1)[None]
        theta = (torch.arange(self.h) + 0.5) * math.pi / self.h
        top = F.max_pool2d(F.pad(env.mean(-1)[None, None], (1, 1, 1, 1), "replicate"), 3, 1)[0, 0]
        weight = top * theta.sin()[:, None] * (theta < math.pi / 2)[:, None]
        self.p = (weight / weight.sum()).ravel()
        self.cdf = torch.cumsum(self.p.double(), 0)
        self.set_material(
            t(maps.diffuse).reshape(-1, 3), t(maps.specular).reshape(-1, 3),
            t(maps.roughness).reshape(-1, 1), t(maps.normal).reshape(-1, 3),
        )  # fmt: skip

    def set_material(
        self, diffuse: Tensor, specular: Tensor, roughness: Tensor, normal: Tensor
    ) -> None:
        """Other maps, (H·W, channels), normals of any length; differentiable."""
        self.k_d, self.k_s, self.alpha = diffuse, specular, roughness**2
        self.n = _unit(normal)
        a = -1 / (1 + self.n[:, 2:])
        nx, ny = self.n[:, :1], self.n[:, 1:2]
        b = nx * ny * a
        self.s = torch.cat([1 + nx * nx * a, b, -nx], -1)
        self.t = torch.cat([b, 1 + ny * ny * a, -ny], -1)
        self.local_v = self.local(self.v)

    def local(self, d: Tensor) -> Tensor:
        return torch.cat([_dot(d, self.s), _dot(d, self.t), _dot(d, self.n)], -1)

    def env_at(self, d: Tensor) -> tuple[Tensor, Tensor]:
        """(radiance, density) of directions."""
        u = torch.atan2(d[:, 1], d[:, 0]) / (2 * math.pi) % 1
        v = torch.acos(d[:, 2].clamp(-1, 1)) / math.pi
        w = 2 * self.h
        grid = torch.stack([(u * w + 1) / (w + 2) * 2 - 1, v * 2 - 1], -1)[None, None]
        light = F.grid_sample(self.env, grid, padding_mode="border", align_corners=False)[0, :, 0].T
        row = (v * self.h).long().clamp(max=self.h - 1)
        texel = row * w + (u * w).long().clamp(max=w - 1)
        sin = torch.sin((row + 0.5) * math.pi / self.h)
        pdf = self.p[texel] / (sin * 2 * math.sin(0.5 * math.pi / self.h) * math.pi / self.h)
        return light, pdf[:, None]

    def radiance(self, samples: int, generator: torch.Generator) -> Tensor:
        """(H·W, 3) by ``samples`` rounds of three samples."""
        total = torch.zeros_like(self.k_d)
        count = len(self.x)
        for _ in range(samples):
            u = torch.rand(count, 6, generator=generator)
            to = self.corner + u[:, :1] * self.e_x + u[:, 1:2] * self.e_y - self.x
            texel = torch.searchsorted(self.cdf, u[:, 2].double()).clamp(max=len(self.p) - 1)
            row, column = texel // (2 * self.h), texel % (2 * self.h)
            jitter = torch.rand(count, 2, generator=generator)
            low = torch.cos(row * math.pi / self.h)
            cos = low + jitter[:, 0] * (torch.cos((row + 1) * math.pi / self.h) - low)
            phi = (column + jitter[:, 1]) * math.pi / self.h
            sin = (1 - cos * cos).clamp(min=0).sqrt()
            sky = torch.stack([sin * phi.cos(), sin * phi.sin(), cos], -1)
            v = self.local_v
            w = _unit(torch.cat([self.alpha * v[:, :2], v[:, 2:]], -1))
            z = (1 - u[:, 4:5]) * (1 + w[:, 2:]) - w[:, 2:]
            r = (1 - z * z).clamp(min=0).sqrt()
            turn = 2 * math.pi * u[:, 5:6]
            h = torch.cat([r * turn.cos(), r * turn.sin(), z], -1) + w
            h = _unit(torch.cat([self.alpha * h[:, :2], h[:, 2:]], -1))
            l = 2 * _dot(v, h) * h - v
            lobe = l[:, :1] * self.s + l[:, 1:2] * self.t + l[:, 2:] * self.n
            total += self._contribution(_unit(to)) + self._contribution(lobe)
            total += self._contribution(sky, only_sky=True)
        return total / samples

    def _contribution(self, d: Tensor, only_sky: bool = False) -> Tensor:
        cos = _dot(d, self.m)
        offset = self.x - self.corner
        r = -_dot(offset, self.m) / cos.clamp(min=1e-6)
        p = offset + r * d
        s = _dot(p, self.e_x) / self.e_x.square().sum()
        t = _dot(p, self.e_y) / self.e_y.square().sum()
        hit = (cos > 1e-6) & (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
        grid = torch.cat([s * 2 - 1, 1 - t * 2], -1)[None, None]
        screen = F.grid_sample(self.pattern, grid, padding_mode="border", align_corners=False)
        sky, p_env = self.env_at(d)
        light = torch.where(hit, screen[0, :, 0].T, sky)
        p_light = torch.where(hit, r * r / (cos.clamp(min=1e-6) * self.area), p_env)
        l, v = self.local(d), self.local_v
        h = _unit(l + v)
        up = (l[:, 2:] > 0) & (v[:, 2:] > 0) & (d[:, 2:] > 0)
        lz, vz = l[:, 2:].clamp(min=1e-6), v[:, 2:].clamp(min=1e-4)
        a2 = self.alpha**2
        e = h[:, 2:] ** 2 * a2 + h[:, :1] ** 2 + h[:, 1:2] ** 2
        D = a2 / (math.pi * e * e)
        root_l, root_v = ((a2 + (1 - a2) * z * z).sqrt() for z in (lz, vz))
        fresnel = self.k_s + (1 - self.k_s) * (1 - _dot(v, h)).clamp(min=0) ** 5
        f = self.k_d / math.pi * lz + D * lz / (2 * (vz * root_l + lz * root_v)) * fresnel
        weight = 1 / (p_light + D / (2 * (vz + root_v)))
        up = up & ~hit if only_sky else up
        return torch.where(up, light * f * weight, 0)
