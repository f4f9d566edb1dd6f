"""Camera raw: a DNG written here, tag by tag, whose camera has the primaries of sRGB."""

import struct
import sys

import image_files as made
import numpy as np
import pytest
import tifffile
from image_files import write_dng
from scipy import ndimage

from invrender.files.capture import load_capture
from invrender.files.images import RAW, read_image, read_photo
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.rig import Rig
from invrender.types import InputError

INNER = (slice(4, -4), slice(4, -4))


def ramp(height=64, width=96):
    y, x = np.mgrid[:height, :width]
    return np.stack([0.1 + 0.4 * x / width, 0.1 + 0.5 * y / height, 0.3 + 0 * x], -1)


def opcodes(number, *codes):
    blob = made.opcode_list(*codes)
    return [({2: 51009, 3: 51022}[number], 7, len(blob), blob, True)]


@pytest.mark.parametrize(
    "options",
    [{}, {"black": 512, "white": 4095}, {"black": 64, "white": 1023},
     {"neutral": np.array([0.7, 1.0, 0.4])}],
)  # fmt: skip
def test_raw_is_linear_black_is_black_and_white_is_balanced(tmp_path, options):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.dng", ramp(), **options)
    photo = read_photo(tmp_path / "a.dng")
    np.testing.assert_allclose(photo.image[INNER], ramp()[INNER], atol=3e-3)
    assert photo.clip_level == 1 and not photo.clipped.any()
    assert not photo.notes and not photo.warnings


@pytest.mark.parametrize(
    ("orientation", "turn"),
    [
        (2, lambda a: a[:, ::-1]), (3, lambda a: a[::-1, ::-1]), (4, lambda a: a[::-1]),
        (5, lambda a: a.swapaxes(0, 1)), (6, lambda a: np.rot90(a, -1)),
        (7, lambda a: np.rot90(a, 2).swapaxes(0, 1)), (8, np.rot90),
    ],
)  # fmt: skip
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


def shading(height, width, power):
    """A lens's shading of an image, the corners at 1/power."""
    y, x = (np.arange(n) / (n - 1) * 2 - 1 for n in (height, width))
    return 1 / (1 + (power - 1) * (x[None] ** 2 + y[:, None] ** 2) / 2)


@pytest.mark.parametrize("white", [1023, 16383, 65535])
def test_gain_maps_of_a_lens_are_applied(tmp_path, white):
    """A phone's: four maps, one a site of the mosaic. The corners came out at 0.39 without."""
    pytest.importorskip("rawpy")
    image = ramp() * 0.9
    shaded = image * shading(64, 96, 2.5)[..., None]
    gains = 1 / shading(33, 49, 2.5)
    codes = [(9, 0, made.gain_map(gains, (64, 96), top, left)) for top in (0, 1) for left in (0, 1)]
    write_dng(tmp_path / "a.dng", shaded, white=white, black=64, more=opcodes(2, *codes))
    photo = read_photo(tmp_path / "a.dng")
    scale = photo.image[32, 48, 1] / image[32, 48, 1]
    np.testing.assert_allclose(photo.image[INNER] / scale, image[INNER], rtol=0.03, atol=4e-3)
    assert scale == pytest.approx(1 / 2.5, rel=0.03)  # what is saturated in the corner is 1
    assert [n.code for n in photo.notes] == ["photo-lens-shading"] and not photo.clipped.any()


def test_gain_maps_differ_by_colour(tmp_path):
    pytest.importorskip("rawpy")
    gain = {(0, 0): 2.0, (0, 1): 1.0, (1, 0): 1.0, (1, 1): 1.25}
    codes = [(9, 0, made.gain_map(np.full((2, 2), g), (64, 96), *at)) for at, g in gain.items()]
    image = ramp() * 0.8
    write_dng(tmp_path / "a.dng", image / [2, 1, 1.25], more=opcodes(2, *codes))
    got = read_photo(tmp_path / "a.dng").image
    np.testing.assert_allclose(got[INNER] * 2, image[INNER], atol=6e-3)


def test_saturated_sites_are_known_under_a_gain_map(tmp_path):
    pytest.importorskip("rawpy")
    image = ramp() * 0.5
    image[10:20, 30:50] = 3
    codes = [(9, 0, made.gain_map(np.full((2, 2), 2.0), (64, 96), t, l)) for t in (0, 1)
             for l in (0, 1)]  # fmt: skip
    write_dng(tmp_path / "a.dng", image, more=opcodes(2, *codes))
    photo = read_photo(tmp_path / "a.dng")
    assert photo.clipped[11:19, 31:49].all() and photo.clipped.sum() < 1.5 * 200


def test_vignetting_is_corrected(tmp_path):
    """FixVignetteRadial: 1 + 0.8 r² + 0.3 r⁴, r = 1 in the corners."""
    pytest.importorskip("rawpy")
    y, x = np.mgrid[:64, :96]
    square = ((x + 0.5 - 48) ** 2 + (y + 0.5 - 32) ** 2) / (48**2 + 32**2)
    gain = 1 + 0.8 * square + 0.3 * square**2
    body = struct.pack(">7d", 0.8, 0.3, 0, 0, 0, 0.5, 0.5)
    image = ramp() * 0.9
    for number in (2, 3):
        write_dng(tmp_path / "a.dng", image / gain[..., None], more=opcodes(number, (3, 1, body)))
        photo = read_photo(tmp_path / "a.dng")
        np.testing.assert_allclose(photo.image[INNER] * gain.max(), image[INNER], atol=8e-3)
        assert [n.code for n in photo.notes] == ["photo-lens-shading"]


def test_distortion_is_corrected(tmp_path):
    """WarpRectilinear: the pixel at r is taken from (0.95 + 0.05 r²) r in the file."""
    pytest.importorskip("rawpy")
    y, x = np.mgrid[:128, :192]
    image = 0.4 + 0.3 * np.stack([np.sin(x / 9.0), np.cos(y / 11.0), np.sin((x + y) / 13.0)], -1)
    body = struct.pack(">I8d", 1, 0.95, 0.05, 0, 0, 0, 0, 0.5, 0.5)
    write_dng(tmp_path / "a.dng", image, more=opcodes(3, (1, 1, body)))
    photo = read_photo(tmp_path / "a.dng")
    dx, dy = x + 0.5 - 96, y + 0.5 - 64
    factor = 0.95 + 0.05 * (dx**2 + dy**2) / (96**2 + 64**2)
    place = (64 + dy * factor - 0.5, 96 + dx * factor - 0.5)
    expected = np.stack(
        [ndimage.map_coordinates(image[..., k], place, order=3) for k in range(3)], -1
    )
    np.testing.assert_allclose(photo.image[6:-6, 6:-6], expected[6:-6, 6:-6], atol=0.02)
    assert [n.code for n in photo.notes] == ["photo-distortion"]


def test_corrections_that_are_not_known(tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.dng", ramp(), more=opcodes(3, (2, 0, bytes(40))))
    with pytest.raises(InputError, match="WarpFisheye"):
        read_photo(tmp_path / "a.dng")
    write_dng(tmp_path / "a.dng", ramp(), more=opcodes(3, (2, 1, bytes(40)), (4, 1, bytes(4))))
    (warning,) = read_photo(tmp_path / "a.dng").warnings
    assert warning.code == "photo-lens-uncorrected" and "WarpFisheye" in warning.text
    for body in (b"", bytes(76), made.gain_map(np.full((2, 2), np.nan), (64, 96), 0, 0)):
        write_dng(tmp_path / "a.dng", ramp(), more=opcodes(2, (9, 0, body)))
        with pytest.raises(InputError, match="damaged lens corrections"):
            read_photo(tmp_path / "a.dng")


def test_linear_dng(tmp_path):
    """A raw photo that is no mosaic any more, as editors write it."""
    pytest.importorskip("rawpy")
    data = (ramp() * made.NEUTRAL * 65535 + 0.5).astype(np.uint16)
    matrix = made.NEUTRAL[:, None] * np.linalg.inv(made.SRGB_TO_XYZ)
    tags = [
        (274, 3, 1, 1, True), (50706, 1, 4, bytes([1, 4, 0, 0]), True),
        (50708, 2, 0, "invrender linear", True), (50717, 4, 3, (65535,) * 3, True),
        (50721, 10, 9, made.fractions(matrix), True),
        (50728, 5, 3, made.fractions(made.NEUTRAL), True), (50778, 3, 1, 21, True),
    ]  # fmt: skip
    tifffile.imwrite(tmp_path / "a.dng", data, photometric=34892, metadata=None, extratags=tags)
    photo = read_photo(tmp_path / "a.dng")
    np.testing.assert_allclose(photo.image, ramp(), atol=3e-3)


def test_a_dng_is_one_whatever_its_name(tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "a.tif", ramp())
    np.testing.assert_allclose(
        read_photo(tmp_path / "a.tif").image[INNER], ramp()[INNER], atol=3e-3
    )


def test_without_rawpy_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    write_dng(tmp_path / "a.dng", ramp())
    with pytest.raises(InputError, match=r"invrender\[raw\]"):
        read_image(tmp_path / "a.dng")


def test_damaged_raw_files_are_refused_or_finite(tmp_path):
    pytest.importorskip("rawpy")
    path = tmp_path / "a.dng"
    gains = made.gain_map(np.full((3, 3), 1.5), (64, 96), 0, 0)
    write_dng(path, ramp(), more=opcodes(2, (9, 0, gains)))
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for k in range(60):
        blob = bytearray(whole)
        if k % 4 == 0:
            blob = blob[: int(rng.integers(0, len(blob)))]
        else:
            for at in rng.integers(0, 900, 4):
                blob[at] = rng.integers(0, 256)
        path.write_bytes(bytes(blob))
        try:
            assert np.isfinite(read_image(path)).all()
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("name", ["photo" + suffix for suffix in RAW] + ["PHOTO.CR3"])
def test_a_capture_may_hold_any_raw_photo(name, tmp_path):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / name, ramp(96, 128))
    write_exr(tmp_path / "pattern.exr", np.full((4, 4, 3), 0.5))
    write_rig(tmp_path / "rig.toml", Rig(), "pattern.exr")
    assert load_capture(tmp_path).photo.image.shape == (96, 128, 3)
