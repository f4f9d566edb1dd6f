"""Scenes of the forward model's benchmarks, and errors over time of what renders them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from benchmarks.common.timing import timed
from invrender.data.environments import procedural_environment
from invrender.maps import Maps
from invrender.render import Fast, Material, Mis, Renderer
from invrender.render import path_traced as photograph
from invrender.render.backend import dr
from invrender.render.scene import make_scene, make_view
from invrender.rig import Rig

Array = NDArray[Any]
# The sample's pixels are whole pixels of a film 2.5 samples wide: δ = 3/32 l.
RIG = Rig(camera_offset=0.18 * 3 / 32)
GAIN = 5.0
MAPS = ("diffuse", "specular", "roughness", "normal")

#                          roughness   metal  tilt  environment
SCENES: dict[str, tuple[float, float, float, float, str]] = {
    "rough, diffuse": (0.6, 1.0, 0.0, 0.10, "sun"),
    "glossy": (0.2, 0.5, 0.0, 0.15, "sun"),
    "tilted, half metal": (0.3, 0.8, 0.5, 0.5, "sun"),
    "metal": (0.15, 0.45, 1.0, 0.15, "sun"),
    "near-mirror": (0.05, 0.12, 0.5, 0.05, "sun"),
    "in a room": (0.15, 0.8, 0.4, 0.15, "room"),
}


def make_maps(n: int, low: float, high: float, metal: float, tilt: float) -> Maps:
    """Smoothly varying maps of one kind."""
    rng = np.random.default_rng(0)

    def noise(channels: int) -> Array:
        x = gaussian_filter(rng.standard_normal((n, n, channels)), (n / 12, n / 12, 0), mode="wrap")
        return x / x.std()

    roughness = low + (high - low) * np.clip(0.5 + 0.3 * noise(1)[..., 0], 0, 1)
    base = np.clip(0.45 + 0.2 * noise(3), 0.02, 0.95)
    normal = np.concatenate([tilt * noise(2), np.ones((n, n, 1))], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    images = (base * (1 - metal), 0.04 * (1 - metal) + base * metal, roughness, normal)
    return Maps(*(x.astype(np.float32) for x in images))


def make_environment(kind: str, h: int = 128) -> Array:
    """A smooth sky with three small lamps and a sun of one texel, or a made-up room."""
    if kind == "room":
        room = procedural_environment(3, h, "room")
        return room * (0.5 / room[: h // 2].mean())
    rng = np.random.default_rng(0)
    smooth = gaussian_filter(rng.standard_normal((h, 2 * h, 3)), (h / 16, h / 8, 0), mode="wrap")
    env = 0.3 * np.exp(smooth / smooth.std() / 2)
    for _ in range(3):
        i, j = int(rng.uniform(0.05, 0.4) * h), rng.integers(2 * h)
        env[i : i + h // 32, j : j + h // 32] += 30
    env[int(0.22 * h), int(0.8 * h)] += 2 / (np.pi / h) ** 2
    return env.astype(np.float32)


class Case:
    """A scene, its reference and all that is measured on it."""

    def __init__(self, name: str, n: int) -> None:
        *material, kind = SCENES[name]
        self.name, self.n = name, n
        self.maps = make_maps(n, *material)
        self.environment = make_environment(kind)
        blocks = np.random.default_rng(1).uniform(0, 1, (4, 4, 3))
        self.pattern = np.kron(blocks, np.ones((16, 16, 1))).astype(np.float32)
        self.scene = make_scene(RIG, self.pattern, self.environment, GAIN)
        self.material = Material.from_maps(self.maps)
        self.renderers = {e: self.prepare(e) for e in ("fast", "mis")}
        self.mitsuba = {
            kind: photograph.sample_scene(
                RIG, self.maps, self.pattern, self.environment, GAIN, integrator=kind
            )
            for kind in ("path", "direct")
        }

    def prepare(self, estimator: str) -> Renderer:
        if estimator == "mis":
            return Mis(self.scene)
        renderer = Fast(self.scene)
        t = renderer.tables
        tables, grids = (t.sky, t.screen), (t.sky_irradiance, t.vector_irradiance)
        dr.eval([p.texels for p in tables if p], [g.values for g in grids if g])
        dr.sync_thread()
        return renderer

    def ours(self, estimator: str, samples: int, seed: int) -> Array:
        view = make_view(self.scene, self.n, self.n, seed)
        color = self.renderers[estimator].radiance(view, self.material, samples)
        return np.asarray(color).T.reshape(self.n, self.n, 3)

    def mitsubas(self, kind: str, spp: int, seed: int) -> Array:
        return photograph.path_traced(self.mitsuba[kind], RIG, self.n, self.n, spp, seed)

    def jacobian(self, estimator: str, samples: int, seed: int, adjoint: Any) -> list[Array]:
        """Gradients of Σ adjoint·I with respect to the four maps."""
        view = make_view(self.scene, self.n, self.n, seed)
        j = self.renderers[estimator].pixel_jacobian(view, self.material, samples)
        normal = j.s * dr.dot(adjoint, j.tangent_s) + j.t * dr.dot(adjoint, j.tangent_t)
        roughness = dr.dot(adjoint, j.roughness)
        out = (adjoint * j.diffuse, adjoint * j.specular, roughness, normal)
        dr.eval(out)
        return [np.asarray(g) for g in out]


def averaged(f: Callable[[int], Any], runs: int) -> tuple[Any, Any, Any]:
    """(mean, first half's mean, second half's) of f(seed)."""
    halves = []
    for k in range(2):
        total: Any = None
        for seed in range(runs // 2):
            x = f(1000 * (k + 1) + seed)
            x = x if isinstance(x, list) else [x]
            total = x if total is None else [a + b for a, b in zip(total, x, strict=True)]
        halves.append([np.asarray(t, np.float64) / (runs // 2) for t in total])
    mean = [(a + b) / 2 for a, b in zip(*halves, strict=True)]
    return mean, halves[0], halves[1]


def time_to(error: float, times: list[float], errors: list[float], statistical: bool) -> float:
    """Seconds to reach an error: log-log interpolation, or 1/√N beyond the last measurement.

    inf where a method with a bias stops above it.
    """
    t, e = np.log(times), np.log(np.maximum(errors, 1e-9))
    if e[0] <= np.log(error):
        return float(times[0])
    for i in range(1, len(t)):
        if e[i] <= np.log(error) < e[i - 1]:
            f = (e[i - 1] - np.log(error)) / (e[i - 1] - e[i])
            return float(np.exp(t[i - 1] + f * (t[i] - t[i - 1])))
    if not statistical:
        return float("inf")
    constant = np.mean([np.log(errors[i]) + 0.5 * np.log(times[i]) for i in (-1, -2)])
    return float(np.exp(2 * (constant - np.log(error))))


def curve(
    f: Callable[[int, int], Any], counts: list[int], error: Callable[[Any], float], repeats: int
) -> dict[str, Any]:
    """Samples, seconds, errors (mean over the runs' squares) and the first call's seconds."""
    out: dict[str, Any] = {"samples": counts, "seconds": [], "errors": []}
    for count in counts:
        results: list[Any] = []
        cold, warm = timed(lambda c=count, r=results: r.append(f(c, len(r))), repeats)  # type: ignore[misc]
        out.setdefault("cold", cold)
        out["seconds"].append(warm)
        out["errors"].append(float(np.sqrt(np.mean([error(r) ** 2 for r in results]))))
    return out
