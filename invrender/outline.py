"""Where the camera was, from the sample's outline in the photo.

The sample is a square of known size, so the four lines of its border tell the camera's whole pose:
a degree of tilt is one per cent of keystone. Border lines are searched near where the nominal rig
puts them; where the photo does not show them clearly, the nominal pose is kept.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from invrender.ball import alignment, edge_offsets, make_view
from invrender.images import Photo
from invrender.rig import Rig

Array = NDArray[np.floating[Any]]
# Standard deviations of a hand-held camera's tilt (degrees) and shift (of the sample's size).
TILT_SPREAD, SHIFT_SPREAD = 1.5, 3e-3 / 0.09
REACH = 0.12  # of the sample's side: how far from its nominal place a border line is looked for
CANDIDATES = 6  # lines kept for each side
LINE_WEIGHT = 40.0  # of a border line's share of edge against the deviations, in log likelihood
MIN_SHARE = 0.5  # of edge along the border: below, it is taken as not visible


def moved_camera(rig: Rig, u: Array) -> Rig:
    """The rig with the camera tilted and shifted by ``u`` (6,), in units of the spreads."""
    return replace(
        rig,
        camera_tilt=tuple(np.add(rig.camera_tilt, u[:3] * TILT_SPREAD)),
        camera_shift=tuple(np.add(rig.camera_shift, u[3:] * SHIFT_SPREAD * rig.sample_size)),
    )


def find_camera(photo: Photo, rig: Rig) -> tuple[Rig, float]:
    """The rig with the camera's pose, and the share of edge along the sample's border there.

    The share is in [0, 1]; below `MIN_SHARE` the border is not visible and the rig is as it was.
    """
    size = (photo.height, photo.width)
    side = rig.focal(photo.width) * rig.sample_size / rig.screen_height
    middle = rig.project(np.zeros(3), *size)
    view = make_view(photo, middle, 0.75 * side, side / 220)
    at = [view.at(p, rig) for p in _sides(rig, 2)]
    slopes = _slopes(view, rig)
    lines = [_candidates(view, p) for p in at]
    if not all(len(side_lines) for side_lines in lines):
        return rig, 0.0
    # All combinations at once: the most likely pose for each, and how likely it is.
    chosen = np.array(list(itertools.product(*(range(len(c)) for c in lines))))
    ends = np.concatenate([c[chosen[:, k], :2] for k, c in enumerate(lines)], 1)  # (n, 8)
    share = np.sum([c[chosen[:, k], 2] for k, c in enumerate(lines)], 0)
    spread = 1.5  # view pixels
    gain = np.linalg.solve(slopes.T @ slopes / spread**2 + np.eye(6), slopes.T / spread**2)
    u = ends @ gain.T
    misfit = ((ends - u @ slopes.T) ** 2).sum(1) / spread**2 + (u**2).sum(1)
    best = np.argmax(LINE_WEIGHT * share - misfit / 2)
    found = _refine(photo, rig, u[best], side)
    share = _share(view, found)
    return (found, share) if share >= MIN_SHARE else (rig, share)


def _sides(rig: Rig, count: int) -> list[Array]:
    """Points (count, 3) along each of the sample's four sides, counter-clockwise from -x, -y."""
    half = rig.sample_size / 2
    corner = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    t = np.linspace(0.03, 0.97, count)[:, None]
    return [corner[k] * (1 - t) + corner[(k + 1) % 4] * t for k in range(4)]


def _normal(ends: Array) -> Array:
    """Unit normal of the line through view positions (n, 2), from its first to its last."""
    along = ends[-1] - ends[0]
    return np.array([-along[1], along[0]]) / np.linalg.norm(along)


def _slopes(view: Any, rig: Rig) -> Array:
    """How the sides' ends move along their normals with the camera: (8, 6), view pixels."""
    out = np.zeros((8, 6))
    before = [view.at(p, rig) for p in _sides(rig, 2)]
    for k in range(6):
        moved = moved_camera(rig, 0.1 * np.eye(6)[k])
        for i, p in enumerate(_sides(rig, 2)):
            out[2 * i : 2 * i + 2, k] = (view.at(p, moved) - before[i]) @ _normal(before[i]) / 0.1
    return out


def _candidates(view: Any, ends: Array) -> Array:
    """The clearest lines near a side: (n, 3) offsets of its two ends and the share of edge."""
    length = float(np.linalg.norm(ends[1] - ends[0]))
    normal = _normal(ends)
    reach = int(REACH * length)
    tilts = np.tan(np.radians(np.arange(-5, 5.01, 0.5)))
    margin = int(tilts[-1] * length / 2) + 1
    u = np.linspace(0, 1, 96)
    v = np.arange(-reach - margin, reach + margin + 1)
    points = (ends[0] + (ends[1] - ends[0]) * u[:, None])[:, None] + v[:, None] * normal
    band = alignment(view, points.reshape(-1, 2), np.broadcast_to(normal, (points.size // 2, 2)))
    band = ndimage.maximum_filter1d(band.reshape(len(u), len(v)), 3, axis=1)
    score = np.zeros((len(tilts), 2 * reach + 1))
    for i, tilt in enumerate(tilts):
        rows = np.round(tilt * (u - 0.5) * length).astype(int) + margin
        score[i] = band[np.arange(len(u))[:, None], rows[:, None] + np.arange(2 * reach + 1)].mean(
            0
        )
    peaks = np.argwhere((score == ndimage.maximum_filter(score, (5, 7))) & (score > 0.15))
    order = np.argsort(-score[tuple(peaks.T)])[:CANDIDATES]
    out = []
    for i, j in peaks[order]:
        half = tilts[i] * length / 2
        out.append((j - reach - half, j - reach + half, score[i, j]))
    return np.array(out).reshape(-1, 3)


def _share(view: Any, rig: Rig) -> float:
    """Mean share of edge along the sample's border, as its weaker half has it."""
    shares = []
    for p in _sides(rig, 96):
        at = view.at(p, rig)
        n = np.broadcast_to(_normal(at), at.shape)
        shares.append(float(np.mean([alignment(view, at + d * n, n) for d in (-0.5, 0, 0.5)])))
    return float(np.mean(sorted(shares)[:3]))


def _refine(photo: Photo, rig: Rig, u: Array, side: float) -> Rig:
    """Sub-pixel pose by robust least squares on the edges nearest to the sides."""
    middle = rig.project(np.zeros(3), photo.height, photo.width)
    fine = make_view(photo, middle, 0.75 * side, side / 550)
    for turn in range(8):
        here = moved_camera(rig, u)
        moved = [moved_camera(rig, u + 0.02 * np.eye(6)[k]) for k in range(6)]
        matrix, right = np.eye(6), -u
        for k, points in enumerate(_sides(rig, 160)):
            at = fine.at(points, here)
            n = np.broadcast_to(_normal(at), at.shape)
            edge, weight = edge_offsets(fine, at, n, max(2.5, 8 * 0.75**turn))
            if weight.sum() < 10:
                continue
            slope = (
                np.stack([(fine.at(_sides(rig, 160)[k], m) - at) @ n[0] for m in moved], -1) / 0.02
            )
            spread = max(0.3, 1.48 * float(np.median(np.abs(edge[weight > 0.1]))))
            w = 0.25 * weight / (1 + (edge / spread) ** 2) / spread**2
            matrix = matrix + slope.T @ (slope * w[:, None])
            right = right + slope.T @ (w * edge)
        u = u + np.clip(np.linalg.solve(matrix, right), -0.5, 0.5)
    return moved_camera(rig, u)
