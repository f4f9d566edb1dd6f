"""Scenes that the tests of the forward model share: small, varied, made from a seed."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from invrender.maps import Maps
from invrender.render.backend import ad, dr, vector
from invrender.render.fast.estimator import Fast
from invrender.render.mis import Mis
from invrender.render.renderer import Material
from invrender.render.scene import View, hash_bits, make_scene

Float64 = ad.Float64
ESTIMATORS = {"fast": Fast, "mis": Mis}

#            roughness   metal  tilt of normals
MATERIALS = {
    "rough": (0.6, 1.0, 0.0, 0.1),
    "glossy": (0.2, 0.5, 0.0, 0.15),
    "metal": (0.15, 0.45, 1.0, 0.15),
    "tilted": (0.3, 0.8, 0.3, 0.6),
    "mirror": (0.06, 0.12, 0.5, 0.03),
}


def some_maps(n: int, kind: str, seed: int = 0) -> Maps:
    """n × n maps that vary smoothly over the sample."""
    rng = np.random.default_rng(seed)
    low, high, metal, tilt = MATERIALS[kind]

    def noise(channels: int) -> Any:
        x = gaussian_filter(rng.standard_normal((n, n, channels)), (n / 12, n / 12, 0), mode="wrap")
        return x / x.std()

    roughness = low + (high - low) * np.clip(0.5 + 0.3 * noise(1)[..., 0], 0, 1)
    base = np.clip(0.45 + 0.2 * noise(3), 0.02, 0.95)
    normal = np.concatenate([tilt * noise(2), np.ones((n, n, 1))], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    as32 = lambda x: x.astype(np.float32)  # noqa: E731
    return Maps(
        as32(base * (1 - metal)),
        as32(0.04 * (1 - metal) + base * metal),
        as32(roughness),
        as32(normal),
    )


def some_environment(h: int = 32, seed: int = 0, sun: float = 30.0, lamps: int = 3) -> Any:
    """Smooth light, a few small lamps and a sun of one texel (h, 2h, 3)."""
    rng = np.random.default_rng(seed)
    smooth = gaussian_filter(rng.standard_normal((h, 2 * h, 3)), (h / 8, h / 4, 0), mode="wrap")
    env = 0.3 * np.exp(smooth / smooth.std())
    for _ in range(lamps):
        i, j = int(rng.uniform(0.05, 0.4) * h), rng.integers(2 * h)
        env[i : i + 2, j : j + 2] += 10
    if sun:
        env[int(0.3 * h), int(0.2 * h)] += sun * 2 / (np.pi / h) ** 2 / 20
    return env


def some_pattern(n: int = 16, seed: int = 0) -> Any:
    """4 × 4 coloured blocks (n, n, 3)."""
    blocks = np.random.default_rng(seed).uniform(0, 1, (4, 4, 3))
    return np.kron(blocks, np.ones((n // 4, n // 4, 1)))


def extreme_configurations(n: int, seed: int = 0) -> dict[str, Any]:
    """n random (position, material) configurations in float64, extremes over-sampled.

    Roughness 0.01 to 1 (log-uniform or at an end), normals uniform in angle with a third beyond
    70° (some of them facing away from the camera), albedos with a third exactly 0 or 1. Positions
    are in units of the sample's half-width.
    """
    rng = np.random.default_rng(seed)
    rho = np.exp(rng.uniform(np.log(0.01), 0, n))
    end = rng.uniform(size=n)
    rho[end < 0.1], rho[end > 0.9] = 0.01, 1.0
    angle = np.radians(rng.uniform(0, 70, n))
    steep = rng.uniform(size=n) < 0.33
    angle[steep] = np.radians(rng.uniform(70, 89, steep.sum()))
    phi = rng.uniform(0, 2 * np.pi, n)
    normal = np.stack([np.sin(angle) * np.cos(phi), np.sin(angle) * np.sin(phi), np.cos(angle)])

    def albedo() -> Any:
        x = rng.uniform(0, 1, (3, n))
        pick = rng.uniform(size=(3, n))
        x[pick < 0.17], x[pick > 0.83] = 0, 1
        return x

    return {
        "position": rng.uniform(-1, 1, (2, n)),
        "diffuse": albedo(),
        "specular": albedo(),
        "roughness": rho,
        "normal": normal,
    }


def configuration_view(scene: Any, c: dict[str, Any], seed: int = 1) -> tuple[View, Material]:
    """The configurations as pixels of a view, in the scene's precision."""
    scalar = scene.scalar
    vec3, uint = vector(scalar, 3), dr.uint32_array_t(scalar)
    n = len(c["roughness"])
    x = vec3(*c["position"], np.zeros(n)) * scene.half
    bits = hash_bits(dr.arange(uint, n), dr.opaque(uint, seed))
    view = View(x, dr.normalize(scene.camera - x), bits)
    material = Material(
        vec3(c["diffuse"]), vec3(c["specular"]), scalar(c["roughness"]), vec3(c["normal"])
    )
    return view, material


def rendered(
    rig: Any, maps: Maps, pattern: Any, environment: Any, gain: Any = 1.0, *,
    estimator: str = "fast", samples: int = 64, seed: int = 0,
) -> Any:  # fmt: skip
    """Image (H, W, 3) of maps in a rig under these lights."""
    renderer = ESTIMATORS[estimator](make_scene(rig, pattern, environment, gain))
    return renderer.render(maps, samples, seed)
