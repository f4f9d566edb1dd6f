"""The networks' blocks."""

import numpy as np
import pytest
import torch

from invrender.capture.lights import find_lights
from invrender.data import EXAMPLE
from invrender.files.capture import load_capture
from invrender.maps import Maps
from invrender.render import Fast
from nets.blocks import without_grid
from nets.predict import Reconstructor


def alternating(n):
    return torch.arange(n) % 2 * 0.01 - 0.005


@pytest.mark.parametrize("size", [(64, 72), (61, 50), (17, 17)])
def test_a_grid_is_taken_away_and_nothing_else(size):
    h, w = size
    y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    smooth = 0.1 * torch.stack([x * y + y, torch.cos(3 * x + y)])[None]
    rows, columns = alternating(h)[:, None].expand(h, w), alternating(w).expand(h, w)
    grid = torch.stack([rows - columns, 200 * rows * columns])
    found = without_grid(smooth + grid)
    # At the border a slope that is reflected has an edge.
    inside = (..., slice(8, -8), slice(8, -8)) if h > 20 else (..., 8, 8)
    assert (without_grid(smooth) - smooth)[inside].abs().max() < 3e-4
    assert (found - smooth)[inside].abs().max() < 3e-4
    assert ((found - smooth) ** 2).mean() < 0.01 * (grid**2).mean()


def test_a_single_edge_or_line_stays():
    image = torch.zeros(1, 1, 64, 64)
    image[..., 31] = 1.0
    assert (without_grid(image) - image).abs().max() < 0.005


def test_small_images_are_left_alone():
    image = torch.rand(2, 3, 5, 40)
    assert torch.equal(without_grid(image), image)


def grid_of(image):
    """RMS of what alternates over the whole of an image (H, W, C)."""
    phases = np.stack([image[i::2, j::2].mean((0, 1)) for i in (0, 1) for j in (0, 1)])
    return float(np.sqrt(np.mean((phases - phases.mean(0)) ** 2)))


def test_a_plain_metal_has_no_grid():
    """Without it they alternate by up to 0.0015."""
    lights = find_lights(load_capture(EXAMPLE)).lights
    one = np.ones((128, 128, 3), np.float32)
    up = one * np.float32([0, 0, 1])
    steel = Maps(0.02 * one, 0.55 * one, 0.35 * one[..., 0], up)
    photo = Fast.under(lights).render(steel, 256)
    photo *= 1 + 0.005 * np.random.default_rng(0).standard_normal(photo.shape, np.float32)
    maps = Reconstructor()(photo, lights).maps.encoded()
    for name, image in maps.items():
        assert grid_of(np.atleast_3d(image)) < 4e-4, name
