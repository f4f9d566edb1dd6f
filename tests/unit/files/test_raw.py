"""Camera raw: a DNG written here, tag by tag, whose camera has the primaries of sRGB."""

import sys

import numpy as np
import pytest
import tifffile

from invrender.files.capture import load_capture
from invrender.files.images import read_image, read_photo
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.rig import Rig
from invrender.types import InputError

WHITE = 16383
NEUTRAL = np.array([0.5, 1.0, 0.6])  # what the camera sees of white
XYZ_TO_SRGB = np.linalg.inv(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip


def fractions(values):
    return tuple(int(k) for v in np.ravel(values) for k in (round(v * 100_000), 100_000))


def write_dng(path, image, orientation=1):
    """A linear image (H, W, 3) as a camera with an RGGB mosaic records it, clipped at `WHITE`."""
    camera = image * NEUTRAL
    mosaic = camera[..., 1].copy()
    mosaic[0::2, 0::2] = camera[0::2, 0::2, 0]
    mosaic[1::2, 1::2] = camera[1::2, 1::2, 2]
    data = np.clip(mosaic * WHITE + 0.5, 0, WHITE).astype(np.uint16)
    tags = [
        (274, 3, 1, orientation, True), (271, 2, 0, "invrender", True), (272, 2, 0, "test", True),
        (33421, 3, 2, (2, 2), True), (33422, 1, 4, bytes([0, 1, 1, 2]), True),
        (50706, 1, 4, bytes([1, 4, 0, 0]), True), (50707, 1, 4, bytes([1, 1, 0, 0]), True),
        (50708, 2, 0, "invrender test", True), (50714, 3, 1, 0, True), (50717, 4, 1, WHITE, True),
        (50721, 10, 9, fractions(NEUTRAL[:, None] * XYZ_TO_SRGB), True),
        (50728, 5, 3, fractions(NEUTRAL), True), (50778, 3, 1, 21, True),
    ]  # fmt: skip
    tifffile.imwrite(path, data, photometric=32803, metadata=None, extratags=tags)


def ramp(height=64, width=96):
    y, x = np.mgrid[:height, :width]
    return np.stack([0.1 + 0.4 * x / width, 0.1 + 0.5 * y / height, 0.3 + 0 * x], -1)


def test_raw_is_linear_and_white_balanced(tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.dng", ramp())
    photo = read_photo(tmp_path / "a.dng")
    inner = slice(4, -4), slice(4, -4)
    np.testing.assert_allclose(photo.image[inner], ramp()[inner], atol=2e-3)
    assert photo.clip_level == 1 and not photo.clipped.any()


@pytest.mark.parametrize(
    ("orientation", "turn"),
    [(3, lambda a: a[::-1, ::-1]), (6, lambda a: np.rot90(a, -1)), (8, np.rot90)],
)
def test_raw_is_upright_and_knows_what_is_saturated(tmp_path, orientation, turn):
    pytest.importorskip("rawpy")
    image = ramp()
    image[10:20, 30:50] = 3
    write_dng(tmp_path / "a.dng", image, orientation)
    photo = read_photo(tmp_path / "a.dng")
    full = np.zeros(image.shape[:2], bool)
    full[10:20, 30:50] = True
    assert photo.image.shape[:2] == turn(full).shape
    assert photo.clipped[turn(full)].all() and photo.clipped.sum() < 1.5 * full.sum()


def test_one_saturated_channel_is_known(tmp_path):
    """Behind the colour matrix of another camera it need not come out as the greatest value."""
    pytest.importorskip("rawpy")
    image = ramp()
    image[30:40, 30:50, 1] = 1.4
    write_dng(tmp_path / "a.dng", image)
    assert read_photo(tmp_path / "a.dng").clipped[31:39, 31:49].all()


def test_without_rawpy_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    write_dng(tmp_path / "a.dng", ramp())
    with pytest.raises(InputError, match=r"invrender\[raw\]"):
        read_image(tmp_path / "a.dng")


def test_damaged_raw_files_are_refused_or_finite(tmp_path):
    pytest.importorskip("rawpy")
    path = tmp_path / "a.dng"
    write_dng(path, ramp())
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for k in range(40):
        blob = bytearray(whole)
        if k % 4 == 0:
            blob = blob[: int(rng.integers(0, len(blob)))]
        else:
            for at in rng.integers(0, 600, 4):
                blob[at] = rng.integers(0, 256)
        path.write_bytes(bytes(blob))
        try:
            assert np.isfinite(read_image(path)).all()
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("name", ["photo.dng", "photo.nef", "PHOTO.CR3"])
def test_a_capture_may_hold_any_raw_photo(name, tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / name, ramp(96, 128))
    write_exr(tmp_path / "pattern.exr", np.full((4, 4, 3), 0.5))
    write_rig(tmp_path / "rig.toml", Rig(), "pattern.exr")
    assert load_capture(tmp_path).photo.image.shape == (96, 128, 3)
