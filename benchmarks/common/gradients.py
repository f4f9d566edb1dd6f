"""Gradients of a photo loss with respect to the maps, against Mitsuba's path replay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.common.scenes import MAPS, RIG, Array, Case, averaged, curve
from benchmarks.common.timing import paired
from invrender.render import Material
from invrender.render import path_traced as photograph
from invrender.render.backend import Float, dr, vector
from invrender.render.path_traced import mi
from invrender.render.scene import make_view
from invrender.rig import Rig


def sample_sensor(n: int, rig: Rig = RIG) -> mi.Sensor:
    """The rig's camera, cropped to the sample, with one pixel a texel of it, n × n."""
    size, _ = rig.screen_sides
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(rig.sample_size / 2 / rig.screen_height))),
            "fov_axis": "x",
            "principal_point_offset_x": -rig.optical_axis_x / rig.sample_size,
            "near_clip": 1e-3 * size,
            "far_clip": 1e3 * size,
            "to_world": photograph._transform(
                [-rig.camera_axes[0], rig.camera_axes[1], -rig.camera_axes[2], rig.camera]
            ),
            "film": {
                "type": "hdrfilm",
                "width": n,
                "height": n,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
        }
    )


def prb_gradients(case: Case, adjoint: Array) -> Callable[[int, int], list[Array]]:
    """Mitsuba's path replay backpropagation of the same adjoint image, one sensor pixel a texel."""
    n = case.n
    scene = case.mitsuba["path"]
    params = mi.traverse(scene)
    keys = {name: next(k for k, _ in params if k.endswith(f".{name}")) for name in MAPS}
    sensor = sample_sensor(n)
    integrator = mi.load_dict({"type": "prb", "max_depth": 2})
    grad_in = mi.TensorXf(np.ascontiguousarray(adjoint, np.float32))

    def run(spp: int, seed: int) -> list[Array]:
        for key in keys.values():
            dr.enable_grad(params[key])
            dr.set_grad(params[key], 0)
        integrator.render_backward(scene, params, grad_in, sensor=sensor, seed=seed, spp=spp)
        grads = []
        for name, key in keys.items():
            g = np.array(dr.grad(params[key])).reshape(n * n, -1).T
            grads.append(g[0] if name == "roughness" else g)
            dr.disable_grad(params[key])
        return grads

    return run


def measure_gradients(case: Case, quick: bool) -> dict[str, Any]:
    """Error of the four maps' gradients of Σ (I - I*)², over time.

    The adjoint 2(I - I*) is that of the converged image against a photo of other maps, so that all
    methods estimate the same gradient, without the variance of I in it.
    """
    (image,), _, _ = averaged(lambda s: case.ours("mis", 32 if quick else 128, s), 4)
    photo = image * (1 + 0.3 * np.sin(np.arange(case.n) / 5))[None, :, None]
    adjoint = 2 * (image - photo)
    ours = vector(Float, 3)(adjoint.reshape(-1, 3).T.astype(np.float32))
    reference, a, b = averaged(
        lambda seed: case.jacobian("mis", 32 if quick else 256, seed, ours), 4 if quick else 8
    )
    norm2 = [float(np.sum(g**2)) for g in reference]
    noise2 = [float(np.sum((x - y) ** 2) / 4) / z for x, y, z in zip(a, b, norm2, strict=True)]

    def relative(found: list[Array]) -> list[float]:
        return [
            float(np.sqrt(max(np.sum((g - r) ** 2) / z - e, 1e-12)))
            for g, r, z, e in zip(found, reference, norm2, noise2, strict=True)
        ]

    def cosines(found: list[Array]) -> list[float]:
        return [
            float(np.sum(g * r) / np.sqrt(np.sum(g * g) * z))
            for g, r, z in zip(found, reference, norm2, strict=True)
        ]

    counts = [4, 16] if quick else [2, 4, 8, 16, 32, 64]
    few = [2, 8] if quick else [8, 64]
    prb = prb_gradients(case, adjoint)
    methods = {
        "fast": (lambda s, k: case.jacobian("fast", s, k, ours), counts, False),
        "mis": (lambda s, k: case.jacobian("mis", s, k, ours), counts, True),
        "prb": (prb, few, True),
    }
    out: dict[str, Any] = {}
    for name, (f, c, _) in methods.items():
        last: list[list[Array]] = []

        def keep(s: int, k: int, f: Any = f, last: Any = last) -> list[Array]:
            last[:] = [f(s, k)]
            return list(last[0])

        out[name] = curve(keep, c, lambda g: float(np.mean(relative(g))), 1 if quick else 2)
        out[name] |= {"maps": relative(last[0]), "cosines": cosines(last[0])}
    return {"methods": out, "reference_noise": float(np.sqrt(np.mean(noise2)))}


def forward_backward(case: Case, samples: int, repeats: int) -> dict[str, float]:
    """Seconds of the image alone, and of the image with the gradients of a loss."""
    view = make_view(case.scene, case.n, case.n)
    out: dict[str, float] = {}
    for estimator in ("fast", "mis"):

        def forward(e: str = estimator) -> None:
            dr.eval(case.renderers[e].radiance(view, case.material, samples))
            dr.sync_thread()

        def both(e: str = estimator) -> None:
            m = Material(*(
                type(v)(v) for v in (case.material.diffuse, case.material.specular,
                                     case.material.roughness, case.material.normal)))  # fmt: skip
            leaves = [m.diffuse, m.specular, m.roughness, m.normal]
            dr.enable_grad(leaves)
            color = case.renderers[e].radiance(view, m, samples)
            dr.backward(dr.sum(dr.squared_norm(color - 0.5)))
            dr.eval([dr.grad(v) for v in leaves])
            dr.sync_thread()

        _, seconds, ratio = paired(both, forward, repeats)
        out |= {estimator: ratio, f"{estimator} forward": seconds}
    return out
