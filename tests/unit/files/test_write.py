"""Files that are written: what their headers say, and that they are whole or not there."""

import os
import random
import signal
import struct
import subprocess
import sys
import time

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from invrender.colour import linear_to_srgb
from invrender.files import write
from invrender.files.images import read_image, read_photo
from invrender.files.maps import read_maps, write_maps
from invrender.files.write import atomic_path, write_exr, write_png
from invrender.maps import constant_maps
from invrender.types import InputError

RNG = np.random.default_rng(5)


def header(path):
    with OpenEXR.File(str(path), header_only=True) as f:
        return dict(f.header())  # it is emptied with the file


def test_exrs_say_their_colour_space_program_and_size(tmp_path):
    write_exr(tmp_path / "a.exr", np.ones((4, 100, 3)), width=0.254)
    told = header(tmp_path / "a.exr")
    assert told["colorInteropID"] == "lin_rec709_scene"
    rec709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # ITU-R BT.709
    np.testing.assert_allclose(told["chromaticities"], rec709, atol=1e-6)
    assert told["software"].startswith("invrender ")
    assert told["xDensity"] == pytest.approx(10)  # 100 pixels on 10 inches
    for image, options in ((np.ones((4, 5)), {}), (np.ones((4, 5, 3)), {"data": True})):
        write_exr(tmp_path / "d.exr", image, **options)
        told = header(tmp_path / "d.exr")
        assert told["colorInteropID"] == "data" and "chromaticities" not in told


def test_pngs_say_whether_they_are_linear(tmp_path):
    for linear in (False, True):
        write_png(tmp_path / "a.png", np.full((4, 4, 3), 0.5), linear=linear)
        blob = (tmp_path / "a.png").read_bytes()
        assert (b"sRGB\0" in blob) is not linear
        assert (b"gAMA" + struct.pack(">I", 100_000) in blob) is linear
        with Image.open(tmp_path / "a.png") as im:
            assert im.text["Software"].startswith("invrender ")


@pytest.mark.parametrize("half", [False, True])
def test_what_is_written_is_read_again(tmp_path, half):
    image = RNG.uniform(0.01, 4, (9, 7, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", image, half=half)
    photo = read_photo(tmp_path / "a.exr")
    np.testing.assert_allclose(photo.image, image, rtol=2**-11 if half else 0)
    assert not photo.notes and not photo.warnings
    write_png(tmp_path / "a.png", image / 4)
    got = read_photo(tmp_path / "a.png")
    assert np.abs(linear_to_srgb(got.image) - linear_to_srgb(image / 4)).max() <= 0.501 / 255
    assert not got.notes
    write_png(tmp_path / "l.png", image / 4, linear=True)
    for linear in (False, True):  # its gamma is 1: a colour and data alike
        back = read_image(tmp_path / "l.png", linear=linear)
        assert np.abs(back - image / 4).max() <= 0.501 / 255


def test_maps_are_read_again(tmp_path):
    maps = constant_maps(6, 5, diffuse=0.3, specular=0.06, roughness=0.4)
    write_maps(tmp_path, maps, width=0.127)
    back = read_maps(tmp_path)
    assert header(tmp_path / "diffuse.exr")["xDensity"] == pytest.approx(1)  # 5 pixels, 5 inches
    for name in ("diffuse", "specular", "roughness", "normal"):
        np.testing.assert_allclose(getattr(back, name), getattr(maps, name), atol=1e-6)


@pytest.mark.parametrize("writer", [write_exr, write_png])
def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path, writer):
    with pytest.raises(InputError, match="cannot be written: No such file"):
        writer(tmp_path / "none" / "a.png", np.ones((4, 4, 3)))


@pytest.mark.parametrize("writer", [write_exr, write_png])
def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path, writer):
    """A process that may write 20 kB a file, to which a disk is then full."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    image = RNG.random((100, 100, 3)).astype(np.float32)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        with pytest.raises(InputError, match="cannot be written") as e:
            writer(tmp_path / "a.png", image)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, old)
    assert "\n" not in str(e.value) and not list(tmp_path.iterdir())


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    class Full:
        def __init__(self, *args):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *args):
            pass

        def write(self, name):
            raise RuntimeError("iostream")

    usage = type("Usage", (), {"free": 0})()
    monkeypatch.setattr(write.OpenEXR, "File", Full)
    monkeypatch.setattr(write.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError, match="No space left on device"):
        write_exr(tmp_path / "a.exr", np.ones((4, 4)))


def test_names_of_all_scripts_stay_apart(tmp_path):
    names = ["Ähre", "Öhre", "hre", "木", "木目", "a b", "a_b", "[x]", "é", "e"]
    for k, name in enumerate(names):
        write_png(tmp_path / f"{name}.png", np.full((2, 2), k / 10), linear=True)
    for k, name in enumerate(names):
        got = read_image(tmp_path / f"{name}.png", linear=True)
        assert got.max() == pytest.approx(k / 10, abs=0.002)


LOOP = """
import sys
from pathlib import Path
import numpy as np
from invrender.files.write import write_exr, write_png
folder = Path(sys.argv[1])
print("ready", flush=True)
k = 0
while True:
    k = (k + 1) % 200
    write_exr(folder / "a.exr", np.full((300, 300, 3), k / 200, np.float32))
    write_png(folder / "a.png", np.full((300, 300, 3), k / 200), linear=True)
"""


@pytest.mark.slow
def test_killed_writes_leave_whole_files(tmp_path):
    """Killed at random moments: every file is one of those that were written, whole."""
    rng = random.Random(0)
    for _ in range(40):
        process = subprocess.Popen(
            [sys.executable, "-c", LOOP, str(tmp_path)], stdout=subprocess.PIPE
        )
        assert process.stdout is not None and process.stdout.readline() == b"ready\n"
        time.sleep(rng.uniform(0, 0.3))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        for name in ("a.exr", "a.png"):
            if (tmp_path / name).exists():
                assert np.ptp(read_image(tmp_path / name, linear=True)) == 0
        assert all(p.name in ("a.exr", "a.png") or p.name[0] == "." for p in tmp_path.iterdir())


def test_a_failed_write_keeps_the_old_file(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((4, 4, 3)))
    before = (tmp_path / "a.png").read_bytes()
    with pytest.raises(RuntimeError), atomic_path(tmp_path / "a.png") as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError
    assert (tmp_path / "a.png").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    with pytest.raises(ValueError, match="non-finite"):
        write_exr(tmp_path / "b.exr", np.full((2, 2, 3), np.inf))
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
