"""Lighting clues: what basis materials would show under a capture's lights.

Six materials: ρ in {0.2, 0.6}, k_d in {0, 0.2, 0.6}, k_s = 0.6 - k_d. Radiance is affine in the
albedos, so that of k_d = 0.2 is 2/3 of that of 0 and 1/3 of that of 0.6: the four of `BASIS` hold
all there is, and `six` makes the others. Plane clues have the plane's normal and exact occlusion by
the screen; they are smooth and noiseless, so a coarse grid over the sample serves.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from invrender.lights import IDEAL, Device
from invrender.render.backend import Float, dr, vector
from invrender.render.fast.estimator import Fast
from invrender.render.scene import Scene, make_scene, make_view
from invrender.rig import Rig
from invrender.sphere import resample_environment
from invrender.types import Array
from nets.splitsum import area_resize, mask_environment, pack_rig, prefilter_screen, prefilter_sky

ALBEDO = 0.6
CLUE_RHO = (0.2, 0.6)
BASIS = ((0.2, 0.0), (0.2, 0.6), (0.6, 0.0), (0.6, 0.6))  # (ρ, k_d)
WHITE = 3  # of BASIS: nearly Lambertian, 0.6 of a white plane
SLOPED = (3, 2, 0)  # of BASIS, in the order of the slope clues
CLUE_SIZE = 48
BALL_SIZE = 32
PATTERN_SIZE = 32
CLUE_SAMPLES = 64


def plane_clues(
    scene: Scene, size: int = CLUE_SIZE, samples: int = CLUE_SAMPLES
) -> tuple[Array, Array]:
    """Radiance (size, size, 12) of the four materials of `BASIS`, flat, over the sample; and that
    of the `SLOPED` ones' derivatives along the slopes p and q of n ∝ (p, q, 1), (size, size, 18).
    """
    renderer = Fast(scene)
    vec3 = vector(scene.scalar, 3)
    view = make_view(scene, size, size)
    up = vec3(*(dr.opaque(scene.scalar, c) for c in (0.0, 0.0, 1.0)))
    shadings = [renderer.shade(view, dr.opaque(Float, r), up, samples, True) for r in CLUE_RHO]
    # Radiance, then along p and q: the tangents of the plane's own frame are x and y.
    parts = [[(s.irradiance, s.b, s.a), s.tangents[1], s.tangents[2]] for s in shadings]
    dr.eval(parts)  # one launch for all

    def image(material: int, row: int) -> Array:
        rho, k_d = BASIS[material]
        e, b, a = parts[CLUE_RHO.index(rho)][row]
        color = e * (k_d / np.pi) + b * (ALBEDO - k_d) + a
        return np.broadcast_to(np.asarray(color).T, (size * size, 3))

    def stack(images: list[Array]) -> Array:
        return np.concatenate(images, -1).reshape(size, size, -1).astype(np.float32)

    return (
        stack([image(m, 0) for m in range(len(BASIS))]),
        stack([image(m, row) for row in (1, 2) for m in SLOPED]),
    )


def six(clues: Array) -> Array:
    """The paper's six images (..., 18) from those of `BASIS` (..., 12)."""
    a, b, c, d = np.split(clues, 4, -1)
    return np.concatenate([a, (2 * a + b) / 3, b, c, (2 * c + d) / 3, d], -1)


def ball_image(environment: Array, size: int = BALL_SIZE) -> Array:
    """A mirror ball under the environment, seen from far above, (size, size, 3); black around."""
    x = (np.arange(size) + 0.5) / size * 2 - 1
    nx, ny = np.meshgrid(x, -x)
    r2 = nx**2 + ny**2
    z = 1 - 2 * r2  # of the mirror direction 2·n_z·n - z
    nz = np.sqrt(np.maximum(1 - r2, 0))
    height = environment.shape[0]
    row = np.clip(np.arccos(np.clip(z, -1, 1)) / np.pi * height, 0, height - 1)
    phi = np.arctan2(2 * nz * ny, 2 * nz * nx) % (2 * np.pi)
    column = np.minimum((phi / (2 * np.pi) * 2 * height).astype(int), 2 * height - 1)
    return np.where((r2 < 0.5)[..., None], environment[row.astype(int), column], 0).astype(
        np.float32
    )


def light_inputs(
    rig: Rig,
    pattern: Array,
    gain: Any,
    environment: Array | None,
    captured: Array | None = None,
    size: int = CLUE_SIZE,
    samples: int = CLUE_SAMPLES,
    device: Device = IDEAL,
) -> dict[str, Array]:
    """The network's inputs that describe the light, as float32 arrays without a batch axis.

    pattern (h, w, 3) as in `Lights`, shown by ``device`` with gain RGB;
    environment (H, 2H, 3) radiance or None; ``captured``: the screen's radiance as the ball shows
    it, if that is known. Of the display's dimming to the sides the prefiltered screen knows
    nothing, the clues do. Returns, channels
    first: env_clues (12, h, h) with the screen a black occluder, active_clues (12, h, h),
    slope_clues (18, h, h) of both lights together,
    sky (9, ·, ·), screen (6, ·, ·), ball (3, ·, ·), pattern (3, ·, ·), rig (12,).
    """
    gain = np.broadcast_to(np.asarray(gain, np.float32), 3)
    nominal = rig if rig.has_screen else _with_screen(rig)
    if not (np.any(pattern > 0) and np.any(gain > 0)):
        pattern, gain = np.ones((16, 16, 3), np.float32), np.zeros(3, np.float32)
    lit = device.shown(pattern) * gain
    scene = make_scene(nominal, pattern, None, gain, device=device)
    active, slopes = plane_clues(scene, size, samples)
    out = {
        "active_clues": active,
        "screen": _levels(prefilter_screen(lit, CLUE_RHO, _relative_height(nominal))),
        "pattern": area_resize(lit if captured is None else captured, PATTERN_SIZE),
        "rig": pack_rig(nominal),
    }
    if environment is not None and environment[: len(environment) // 2].any():
        # A screen without gain still hides what is behind it.
        dark = make_scene(rig, np.ones_like(pattern), environment, gain=0.0)
        masked = mask_environment(environment, rig)
        out["env_clues"], more = plane_clues(dark, size, samples)
        slopes = slopes + more
        out["sky"] = _levels(prefilter_sky(masked, (*CLUE_RHO, None)))
        out["ball"] = ball_image(resample_environment(masked, 64))
    else:
        sky = prefilter_sky(np.zeros((4, 8, 3)), (*CLUE_RHO, None))
        out |= {"env_clues": np.zeros((size, size, 12)), "sky": _levels(sky)}
        out["ball"] = np.zeros((BALL_SIZE, BALL_SIZE, 3))
    out["slope_clues"] = slopes
    return {
        k: np.ascontiguousarray(np.moveaxis(v, -1, 0) if v.ndim == 3 else v, np.float32)
        for k, v in out.items()
    }


def _with_screen(rig: Rig) -> Rig:
    """With the screen that its sample and its camera would belong to."""
    return replace(rig, screen_size=2 * rig.sample_size, screen_height=float(rig.camera[2]))


def _levels(stack: Array) -> Array:
    """(N, S, S, 3) to (S, S, 3·N), level by level."""
    return np.concatenate(list(stack), -1)


def _relative_height(rig: Rig) -> float:
    centre = rig.screen_corner + sum(rig.screen_edges) / 2
    return float(centre[2] / math.sqrt(math.prod(rig.screen_sides)))


def white_level(lights: dict[str, Array], environment: bool = True) -> float:
    """Mean radiance of a white plane under these lights: the network's unit of radiance."""
    white = slice(3 * WHITE, 3 * WHITE + 3)
    level = lights["active_clues"][white].mean() / ALBEDO
    if environment:
        level = level + lights["env_clues"][white].mean() / ALBEDO
    return float(level)
