"""Crops, scales, turns, colour jitter and mixtures of material maps, and what is no material."""

from __future__ import annotations

import numpy as np

from invrender.data.materials.patterns import slopes, smoothstep
from invrender.maps import NAMES, Maps, crop_maps, resize_maps, rotate_maps, turn_maps, unit_normals
from invrender.types import Array, InputError


def jitter_maps(maps: Maps, rng: np.random.Generator, strength: float = 1.0) -> Maps:
    """Another colour, lightness, gloss and relief of the same material.

    The colour of metals changes in their specular albedo, of the rest in their diffuse one; f0 of
    dielectrics stays in 0.02–0.08. ``strength`` 0 changes nothing, 1 is the usual amount.
    """
    gain = np.exp(strength * (0.25 * rng.standard_normal() + 0.12 * rng.standard_normal(3)))
    colourful = np.exp(0.25 * strength * rng.standard_normal())

    def coloured(image: Array) -> Array:
        grey = image.mean(-1, keepdims=True)
        return (grey + (image - grey) * np.float32(colourful)) * gain.astype(np.float32)

    metallic = smoothstep(0.09, 0.2, maps.specular.max(-1))[..., None]
    f0 = np.clip(maps.specular * np.exp(0.2 * strength * rng.standard_normal()), 0.02, 0.08)
    f0 = f0 if strength > 0 else maps.specular
    specular = (1 - metallic) * f0 + metallic * np.clip(coloured(maps.specular), 0.01, 1)
    rough = maps.roughness ** np.exp(0.25 * strength * rng.standard_normal())
    relief = np.exp(0.35 * strength * rng.standard_normal())
    normal = maps.normal * np.array([relief, relief, 1], np.float32)
    return Maps(
        np.clip(coloured(maps.diffuse), 0, 0.95).astype(np.float32),
        specular.astype(np.float32),
        np.clip(rough, 0.03, 1).astype(np.float32),
        unit_normals(normal),
    )


def mix(a: Maps, b: Maps, mask: Array, step: float = 0.0) -> Maps:
    """Material a where the mask (H, W) is 0, b where it is 1, mixed between.

    Slopes, not normals, are mixed, and ``step`` raises b by that height (in pixels) over a, so that
    the border is seen in the relief. Raises `InputError` when the sizes differ.
    """
    if a.shape != b.shape or a.shape != mask.shape:
        raise InputError(f"cannot mix {a.shape}, {b.shape} with a mask of {mask.shape}")
    t = np.clip(mask, 0, 1).astype(np.float32)
    t3 = t[..., None]
    slope_a, slope_b = (m.normal[..., :2] / np.maximum(m.normal[..., 2:], 0.05) for m in (a, b))
    slope = slope_a + (slope_b - slope_a) * t3
    if step:
        x, y = slopes(t * np.float32(step), 1.0)
        slope = slope - np.stack([x, y], -1)
    normal = np.concatenate([slope, np.ones_like(t3)], -1)
    return Maps(
        a.diffuse + (b.diffuse - a.diffuse) * t3,
        a.specular + (b.specular - a.specular) * t3,
        a.roughness + (b.roughness - a.roughness) * t,
        unit_normals(normal),
    )


def augment(
    maps: Maps,
    rng: np.random.Generator,
    height: int,
    width: int,
    *,
    jitter: float = 1.0,
    free_rotation: float = 0.25,
) -> Maps:
    """A random piece of a material at (height, width): crop, scale, turn, mirror and recolour.

    Pieces are never enlarged unless the maps are smaller than what is asked for. Turned by any
    angle with probability ``free_rotation``, else by quarters; ``jitter`` as in `jitter_maps`.
    """
    h, w = maps.shape
    quarters, mirror = int(rng.integers(4)), bool(rng.random() < 0.5)
    tall, wide = (height, width) if quarters % 2 == 0 else (width, height)
    angle = rng.uniform(-np.pi / 4, np.pi / 4) if rng.random() < free_rotation else 0.0
    most = min(h / tall, w / wide)  # source pixels a pixel, at most
    scale = most ** rng.random() if most > 1 else most
    ch, cw = min(h, max(1, round(tall * scale))), min(w, max(1, round(wide * scale)))
    place = rng.random(2)
    spread = abs(np.cos(angle)) + abs(np.sin(angle))
    need = int(np.ceil(max(ch, cw) * spread)) + 1
    if angle and need <= min(h, w):
        top, left = int(place[0] * (h - need + 1)), int(place[1] * (w - need + 1))
        piece = rotate_maps(crop_maps(maps, top, left, need, need), angle, max(ch, cw))
        piece = crop_maps(piece, 0, 0, ch, cw)
    else:
        top, left = int(place[0] * (h - ch + 1)), int(place[1] * (w - cw + 1))
        piece = crop_maps(maps, top, left, ch, cw)
    piece = turn_maps(resize_maps(piece, tall, wide), quarters, mirror)
    return jitter_maps(piece, rng, jitter) if jitter > 0 else piece


def check_maps(maps: Maps) -> None:
    """Raise `InputError`, saying why, for maps that no network or renderer should see.

    Not finite, out of range, normals that are not unit or point into the surface, black, clipped to
    white, or the same everywhere in all maps.
    """
    for name in NAMES:
        image = getattr(maps, name)
        if not np.all(np.isfinite(image)):
            raise InputError(f"the {name} map holds NaN or infinity")
        if name != "normal" and (image.min() < 0 or image.max() > 1):
            raise InputError(f"the {name} map leaves [0, 1]")
    length = np.linalg.norm(maps.normal, axis=-1)
    if np.abs(length - 1).max() > 1e-3:
        raise InputError("the normals are not unit vectors")
    if maps.normal[..., 2].min() <= 0:
        raise InputError("some normals point into the surface")
    if maps.normal[..., 2].mean() < 0.4:
        raise InputError("the normals lie flat in the surface; this is no normal map")
    if maps.roughness.max() < 0.01:
        raise InputError("the roughness is zero everywhere")
    albedo = maps.diffuse + maps.specular
    if (
        np.percentile(maps.diffuse.max(-1), 95) < 1e-3
        and np.percentile(maps.specular.max(-1), 95) < 0.02
    ):
        raise InputError("the material is black")
    if np.mean(albedo.min(-1) >= 0.999) > 0.5:
        raise InputError("more than half of the albedo is clipped to white")
    if (
        max(float(getattr(maps, n).reshape(maps.roughness.size, -1).std(0).max()) for n in NAMES)
        < 1e-4
    ):
        raise InputError("all maps are constant")
