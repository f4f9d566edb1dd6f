"""The maps of four runs, pinned: a change that moves any of them must do so on purpose.

``python tests/system/test_golden.py --write`` makes ``golden/maps.npz`` anew, after a change that
is meant to move them, and prints how far each moved; commit it together with that change.

On one machine the maps are the same to 1e-6. Between processors vector instructions round
differently. With those of AVX-512 forbidden to numpy, OpenBLAS and torch, the worst pixel without
networks moves by 1.3e-4 and its maps by less than 1e-6 on average; with networks, whose posterior
weighs alternatives, by 0.022 and 3.1e-4.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from invrender.cli.main import main
from invrender.colour import linear_to_srgb
from invrender.data import EXAMPLE
from invrender.files.images import read_image
from invrender.files.maps import read_maps
from invrender.maps import NAMES

GOLDEN = Path(__file__).parent / "golden"
SIZE = 32  # pixels a side of the maps
RUNS = ("network", "flat", "jpeg", "pair")
# Of a map's worst pixel, and of its mean change: a few times what vector instructions change.
FLAT_TOLERANCE, NETWORK_TOLERANCE = (1e-3, 1e-5), (0.06, 1e-3)


def jpeg_capture(folder):
    """The bundled capture with its photo as a JPEG, exposed to the 99.5th percentile."""
    shutil.copytree(EXAMPLE, folder)
    photo = read_image(folder / "photo.exr")
    (folder / "photo.exr").unlink()
    exposed = np.clip(photo / np.percentile(photo, 99.5), 0, 1)
    picture = Image.fromarray((linear_to_srgb(exposed) * 255 + 0.5).astype(np.uint8))
    picture.save(folder / "photo.jpg", quality=95, subsampling="4:4:4")
    return folder


def second_capture(folder):
    """The same sample in another room, with a larger ball.

    Its photo is 640 pixels wide: `simulate` with procedural room 5, a gain of 1, 128 samples, noise
    0.005 and seed 5, as a JPEG as above whose white is a radiance of 1.2.
    """
    folder.mkdir()
    rig = (EXAMPLE / "rig.toml").read_text()
    (folder / "rig.toml").write_text(rig.replace("radius = 0.0095", "radius = 0.02"))
    shutil.copy(EXAMPLE / "pattern.exr", folder)
    shutil.copytree(EXAMPLE / "truth", folder / "truth")
    shutil.copy(GOLDEN / "second.jpg", folder / "photo.jpg")
    return folder


def refined(run, folder):
    """The results' folder of a run."""
    folder.mkdir()
    words = [EXAMPLE]
    if run == "flat":
        words += ["--init", "flat"]
    elif run == "jpeg":
        words = [jpeg_capture(folder / "jpeg")]
    elif run == "pair":
        words += [second_capture(folder / "second"), "--joint"]
    out = folder / "out"
    command = ["refine", *map(str, words), "-o", str(out), "--size", str(SIZE), "--quiet"]
    assert main(command) == 0
    return out


def pinned(out):
    """The maps in a folder of results, and the mean of their standard deviations, by name."""
    maps = read_maps(out)
    found = {name: np.asarray(getattr(maps, name), np.float32) for name in NAMES}
    sigma = {f"sigma_{n}": read_image(out / f"sigma_{n}.exr").mean() for n in NAMES}
    return found | {name: np.float32(value) for name, value in sigma.items()}


@pytest.mark.parametrize("run", RUNS)
def test_maps_are_the_pinned_ones(run, tmp_path, example_result):
    known = run in ("network", "flat")
    pixel, mean = FLAT_TOLERANCE if run == "flat" else NETWORK_TOLERANCE
    out = example_result(run) if known else refined(run, tmp_path / run)
    with np.load(GOLDEN / "maps.npz") as golden:
        for name, found in pinned(out).items():
            moved = np.abs(found - golden[f"{run}/{name}"])
            assert moved.max() < pixel and moved.mean() < mean, name


def write():
    """Make the pinned maps anew; print how far each is from those before."""
    with tempfile.TemporaryDirectory() as folder, np.load(GOLDEN / "maps.npz") as before:
        new = {
            f"{run}/{name}": value
            for run in RUNS
            for name, value in pinned(refined(run, Path(folder) / run)).items()
        }
        for name, value in new.items():
            moved = np.abs(value - before[name])
            print(f"{name:24} moved by {moved.max():.1e}, on average {moved.mean():.1e}")
    np.savez_compressed(GOLDEN / "maps.npz", **new)


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit(__doc__)
    write()
