"""Where one photo shows the square of the sample that another one shows."""

from dataclasses import replace

import numpy as np

from invrender.capture.placement import find_place
from invrender.data.simulate_setup import without_screen
from invrender.files.images import Photo
from invrender.rig import Rig

HEIGHT, WIDTH = 450, 600
WEAVE = 2.2e-3  # metres a thread: a pixel or two of the comparison


def weave_photo(rig, light, lines):
    """A fine weave's square on a grey table; lines: how strongly its threads show."""
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
    rays = rig.rays(pixels, HEIGHT, WIDTH)
    at = (rig.camera - rays * (rig.camera[2] / rays[..., 2:]))[..., :2]
    threads = np.sign(
        np.sin(2 * np.pi * at[..., 0] / WEAVE) * np.sin(2 * np.pi * at[..., 1] / WEAVE)
    )
    inside = np.abs(at).max(-1) < rig.sample_size / 2
    slant = 1 + at @ light
    image = slant * np.where(inside, 0.7 + lines * threads, 0.3)
    return Photo(np.repeat(image[..., None], 3, -1).astype(np.float32))


def test_a_square_that_was_missed_is_found_by_another_photo_s():
    rig = without_screen(Rig())
    true = replace(rig, camera_shift=(6e-4, 0.0, 9e-4), camera_tilt=(-1.1, -0.3, -1.8))
    photos = weave_photo(true, (4.0, -3.0), 0.1), weave_photo(rig, (-2.0, 5.0), 0.15)
    place, _ = find_place(photos, (rig, rig))  # the first one's camera is taken for the nominal one
    corners = np.array([[1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1]]) @ place.T
    half = rig.sample_size / 2
    found = np.pad(corners[:, :2] / corners[:, 2:] * half, ((0, 0), (0, 1)))
    wanted = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) * half
    off = rig.project(found, HEIGHT, WIDTH) - true.project(wanted, HEIGHT, WIDTH)
    before = rig.project(wanted, HEIGHT, WIDTH) - true.project(wanted, HEIGHT, WIDTH)
    assert np.abs(before).max() > 5 and np.abs(off).max() < 1.5  # pixels
