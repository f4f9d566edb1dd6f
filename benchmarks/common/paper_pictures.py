"""The paper's pictures: maps and re-renderings by all methods, clues, and the denoiser's work."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

from invrender.colour import linear_to_srgb
from invrender.maps import NAMES, Maps
from invrender.render.point_lights import rerender
from invrender.types import Array
from nets.batch import Batch
from nets.clues import BASIS

CENTRE = 4  # of the nine re-rendered images
DISPLAYED = ("diffuse", "specular")  # maps that are shown as sRGB


def draw_maps(
    file: Path, truth: Maps, found: Mapping[str, Maps], titles: Mapping[str, str]
) -> None:
    """A row a method, the truth first: the four maps and the sample under one point light."""
    rows = {"truth": truth, **{titles[k]: found[k] for k in titles}}
    images: list[list[tuple[str, Array]]] = []
    for title, maps in rows.items():
        encoded = maps.encoded()
        line = [(n, linear_to_srgb(encoded[n]) if n in DISPLAYED else encoded[n]) for n in NAMES]
        line.append(("re-rendered", rerender(maps)[CENTRE]))
        images.append([(title if i == 0 else "", x) for i, (_, x) in enumerate(line)])
    save_grid(file, images, (*NAMES, "re-rendered"))


def draw_clues(file: Path, batch: Batch, network: Any) -> None:
    """Plane clues, and normal clues with the normals that a network predicts, of one capture."""
    with torch.no_grad():
        view = network.view(batch)
        normal = network(batch)["normal0"]
        clues, _ = network.normal_clues(normal, view, None)
    names = [f"ρ {rho:g}, k_d {k_d:g}" for rho, k_d in BASIS]
    images = []
    for title, x in (("plane clues", view.plane), ("normal clues", clues)):
        each = [as_displayed(x[:, 3 * i : 3 * i + 3]) for i in range(len(BASIS))]
        images.append([(title if i == 0 else "", y) for i, y in enumerate(each)])
    save_grid(file, images, names)


def draw_denoised(
    file: Path, batch: Batch, network: Any, decode: Callable[[Tensor], Tensor]
) -> None:
    """The photo, what the denoiser makes of it, and what the ideal pattern would have shown."""
    with torch.no_grad():
        denoised = decode(network(batch)["denoised"])
    parts = (batch["photo"], denoised, batch["ideal"])
    save_grid(file, [[("", as_displayed(x)) for x in parts]], ("photo", "denoised", "ideal"))


def draw_perturbed(
    file: Path, curves: Mapping[str, Mapping[str, Sequence[tuple[float, float | None]]]]
) -> None:
    """A panel a perturbation: average map errors against its level, a curve a method."""
    figure, axes = plt.subplots(1, len(curves), figsize=(4 * len(curves), 3.2), squeeze=False)
    for axis, (kind, methods) in zip(axes[0], curves.items(), strict=True):
        for method, points in methods.items():
            known = sorted((x, y) for x, y in points if y is not None)
            axis.plot(*zip(*known, strict=True), "o-", ms=3, label=method)
        axis.set(xlabel=kind, ylabel="average map RMSE", ylim=(0, None))
        axis.grid(alpha=0.2)
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(file, dpi=100)
    plt.close(figure)


def as_displayed(x: Tensor) -> Array:
    """The first capture's radiance (B, 3, H, W), in units of a white plane, as sRGB (H, W, 3)."""
    image = np.clip(x[0].permute(1, 2, 0).numpy(), 0, 1)
    return linear_to_srgb(image)


def save_grid(
    file: Path, rows: list[list[tuple[str, Array]]], columns: tuple[str, ...] | list[str]
) -> None:
    """Images in rows, each with its row's title at the left; the columns' titles above."""
    figure, axes = plt.subplots(
        len(rows), len(columns), figsize=(1.5 * len(columns) + 1, 1.5 * len(rows) + 0.3),
        squeeze=False,
    )  # fmt: skip
    for line, images in zip(axes, rows, strict=True):
        for axis, (title, image) in zip(line, images, strict=True):
            axis.imshow(np.clip(image, 0, 1), cmap="gray", vmin=0, vmax=1)
            axis.set(xticks=[], yticks=[])
            axis.set_ylabel(title, fontsize=6)
    for axis, name in zip(axes[0], columns, strict=True):
        axis.set_title(name, fontsize=8)
    figure.tight_layout(pad=0.3)
    figure.savefig(file, dpi=100)
    plt.close(figure)
