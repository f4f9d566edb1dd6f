import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from invrender.colour import linear_to_srgb, srgb_to_linear
from invrender.files import images, pillow, raster
from invrender.files.images import read_image, read_photo
from invrender.files.write import write_exr, write_png
from invrender.types import InputError

# Offset and step (x0, y0, dx, dy) of the seven passes of an interlaced PNG.
ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2),
         (0, 1, 1, 2))  # fmt: skip
RNG = np.random.default_rng(3)
RGB16 = RNG.integers(0, 65536, (23, 17, 3)).astype(np.uint16)
RAMP = (np.arange(48)[:, None, None] * 20 + np.arange(64)[None, :, None] * 2).repeat(3, -1)
RAMP = (RAMP % 256).astype(np.uint8)


def png16(path: Path, data: np.ndarray, filters: list[int], interlace: bool = False) -> None:
    """A 16-bit PNG, written by the letter of the standard, byte by byte."""
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[data.shape[2]]
    step = 2 * data.shape[2]
    raw = bytearray()
    for x0, y0, dx, dy in ADAM7 if interlace else ((0, 0, 1, 1),):
        part = data[y0::dy, x0::dx]
        before = np.zeros(part.shape[1] * step, int)
        for y in range(part.shape[0] if part.shape[1] else 0):
            row = np.frombuffer(part[y].astype(">u2").tobytes(), np.uint8).astype(int)
            left = np.concatenate([np.zeros(step, int), row[:-step]])
            corner = np.concatenate([np.zeros(step, int), before[:-step]])
            f = filters[y % len(filters)]
            guess = left + before - corner
            pa, pb, pc = abs(guess - left), abs(guess - before), abs(guess - corner)
            paeth = np.where((pa <= pb) & (pa <= pc), left, np.where(pb <= pc, before, corner))
            minus = [0, left, before, (left + before) // 2, paeth][f]
            raw += bytes([f]) + ((row - minus) % 256).astype(np.uint8).tobytes()
            before = row

    def chunk(name: bytes, body: bytes) -> bytes:
        return (
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        )

    head = struct.pack(">IIBBBBB", data.shape[1], data.shape[0], 16, kind, 0, 0, int(interlace))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(bytes(raw)))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("interlace", [False, True])
@pytest.mark.parametrize("filters", [[0], [1], [2], [3], [4], [4, 3, 0, 2, 1]])
def test_png16_keeps_all_sixteen_bits(tmp_path, filters, interlace):
    png16(tmp_path / "a.png", RGB16, filters, interlace)
    got = read_image(tmp_path / "a.png", linear=True)
    assert np.abs(got * 65535 - RGB16).max() < 0.01


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_png16_grey_and_alpha(tmp_path, channels):
    data = np.concatenate([RGB16, RGB16[..., :1] // 3], -1)[..., :channels]
    png16(tmp_path / "a.png", data, [4, 1])
    got = read_image(tmp_path / "a.png", linear=True)
    expected = data[..., :3] if channels == 4 else np.repeat(data[..., :1], 3, -1)
    assert np.abs(got * 65535 - expected).max() < 0.01


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_tiff(tmp_path, dtype, compression):
    data = RGB16 if dtype == np.uint16 else (RGB16 / 257).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", data, compression=compression, photometric="rgb")
    got = read_image(tmp_path / "a.tif", linear=True)
    scale = {np.uint8: 255, np.uint16: 65535, np.float32: 1}[dtype]
    np.testing.assert_allclose(got, data / np.float32(scale), rtol=1e-6)


def test_tiff_grey_is_repeated_and_planes_are_ordered(tmp_path):
    tifffile.imwrite(tmp_path / "g.tif", RGB16[..., 0], photometric="minisblack")
    got = read_image(tmp_path / "g.tif", linear=True)
    assert got.shape == (23, 17, 3) and np.ptp(got, axis=-1).max() == 0
    tifffile.imwrite(
        tmp_path / "p.tif", np.moveaxis(RGB16, -1, 0), photometric="rgb", planarconfig="separate"
    )
    np.testing.assert_allclose(
        read_image(tmp_path / "p.tif", linear=True), RGB16 / 65535.0, rtol=1e-6
    )


def test_integer_files_are_decoded_from_srgb(tmp_path):
    Image.fromarray(RAMP).save(tmp_path / "a.png")
    got = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(got, srgb_to_linear(RAMP / 255.0), atol=1e-6)
    np.testing.assert_allclose(linear_to_srgb(got), RAMP / 255.0, atol=1e-5)


def test_exr_round_trip_and_layers(tmp_path):
    data = RNG.normal(0, 3, (5, 7, 3)).astype(np.float32)
    write_exr(tmp_path / "a.exr", data)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), data)
    write_exr(tmp_path / "g.exr", data[..., 0])
    np.testing.assert_array_equal(read_image(tmp_path / "g.exr")[..., 2], data[..., 0])
    planes = {f"beauty.{c}": np.ascontiguousarray(data[..., i]) for i, c in enumerate("RGB")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, planes) as f:
        f.write(str(tmp_path / "l.exr"))
    np.testing.assert_array_equal(read_image(tmp_path / "l.exr"), data)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path, orientation):
    """The stored pixels are turned so that applying the tag gives the upright picture back."""
    undo = {
        1: lambda a: a, 2: lambda a: a[:, ::-1], 3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1], 5: lambda a: a.swapaxes(0, 1), 6: lambda a: np.rot90(a, 1),
        7: lambda a: np.rot90(a, 2).swapaxes(0, 1), 8: lambda a: np.rot90(a, -1),
    }  # fmt: skip
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = np.ascontiguousarray(undo[orientation](RAMP))
    Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png", linear=True) * 255, RAMP)


def test_exif_lens_and_exposure(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: 24, 0x829A: 0.02, 0x829D: 2.0, 0x8827: 200})
    Image.fromarray(np.zeros((200, 300, 3), np.uint8)).save(tmp_path / "a.jpg", exif=exif)
    photo = read_photo(tmp_path / "a.jpg")
    assert photo.fov == pytest.approx(73.74, abs=0.01)  # 36 mm over 24 mm, at 3:2
    assert photo.exposure == pytest.approx(0.02 * 2 / 4)
    assert photo.clip_level is not None and not photo.clipped.any()


@pytest.mark.parametrize("focal", [0, 60000])
def test_exif_that_lies_is_ignored(tmp_path, focal):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: focal, 0x829A: 0.0})
    Image.fromarray(RAMP).save(tmp_path / "a.jpg", exif=exif)
    photo = read_photo(tmp_path / "a.jpg")
    assert photo.fov is None and photo.exposure is None


def test_clipped_pixels_are_known(tmp_path):
    data = np.zeros((64, 64, 3), np.uint8)
    data[:32] = 255
    Image.fromarray(data).save(tmp_path / "a.jpg")
    clipped = read_photo(tmp_path / "a.jpg").clipped
    assert clipped[:30].all() and not clipped[34:].any()


def refused(path: Path, match: str) -> None:
    with pytest.raises(InputError, match=match) as e:
        read_image(path)
    assert "\n" not in str(e.value)


def test_refusals(tmp_path, monkeypatch):
    refused(tmp_path / "none.png", "does not exist")
    refused(tmp_path, "is a folder, not an image")
    for name in ("a.png", "a.exr", "a.jpg", "a.tif"):
        (tmp_path / name).write_bytes(b"")
        refused(tmp_path / name, "not a readable")
        (tmp_path / name).write_bytes(b"this is a text and no image at all")
        refused(tmp_path / name, "not a readable")
    bad = np.ones((4, 4, 3), np.float32)
    bad[1, 1] = np.nan
    tifffile.imwrite(tmp_path / "nan.tif", bad, photometric="rgb")
    refused(tmp_path / "nan.tif", "NaN")
    monkeypatch.setattr(raster, "MAX_MEMORY", 300)
    write_exr(tmp_path / "big.exr", np.zeros((11, 10, 3)))
    write_png(tmp_path / "big.png", np.zeros((11, 10, 3)))
    tifffile.imwrite(tmp_path / "big.tif", np.zeros((11, 10, 3), np.uint8), photometric="rgb")
    for kind in ("exr", "png", "tif"):
        refused(tmp_path / f"big.{kind}", "10 × 11 pixels")


def test_bomb_is_refused_before_decoding(tmp_path):
    """A few bytes that claim 60000 × 60000 pixels."""
    png16(tmp_path / "a.png", RGB16, [0])
    blob = bytearray((tmp_path / "a.png").read_bytes())
    blob[16:24] = struct.pack(">II", 60000, 60000)
    blob[29:33] = struct.pack(">I", zlib.crc32(bytes(blob[12:29])))
    (tmp_path / "a.png").write_bytes(bytes(blob))
    refused(tmp_path / "a.png", "pixels")


@pytest.mark.parametrize("kind", ["png", "png16", "jpg", "tif", "exr"])
def test_truncated_files_are_refused(tmp_path, kind):
    path = tmp_path / f"a.{kind[:3]}"
    noise = RNG.integers(0, 256, (64, 64, 3)).astype(np.uint8)
    if kind == "png16":
        png16(path, RGB16, [4])
    elif kind == "exr":
        write_exr(path, noise.astype(np.float32))
    elif kind == "tif":
        tifffile.imwrite(path, noise, photometric="rgb", compression="zlib")
    else:
        Image.fromarray(noise).save(path)
    blob = path.read_bytes()
    for share in (0.3, 0.7, 0.95):
        path.write_bytes(blob[: int(len(blob) * share)])
        refused(path, "not a readable")


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_damaged_files_never_crash(tmp_path, data):
    kind = data.draw(st.sampled_from(["png", "jpg", "tif", "exr"]))
    path = tmp_path / f"fuzz.{kind}"
    if kind == "exr":
        write_exr(path, RAMP / 255.0)
    elif kind == "tif":
        tifffile.imwrite(path, RAMP, photometric="rgb", compression="zlib")
    elif data.draw(st.booleans()) and kind == "png":
        png16(path, RGB16, [0, 1, 2, 3, 4])
    else:
        Image.fromarray(RAMP).save(path)
    blob = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        blob[data.draw(st.integers(0, len(blob) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(blob))
    try:
        image = read_image(path)
    except InputError as e:
        assert "\n" not in str(e)
    else:
        assert image.dtype == np.float32 and image.ndim == 3 and image.shape[2] == 3
        assert np.isfinite(image).all()


def test_a_damaged_name_in_an_exr_is_refused(tmp_path):
    write_exr(tmp_path / "a.exr", RAMP / 255.0)
    blob = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(blob.replace(b"lin_rec709_scene", b"lin_rec\xff09_scene"))
    refused(tmp_path / "a.exr", "not a readable")


def test_photos_of_many_megapixels_are_averaged_down(tmp_path, monkeypatch):
    """Means of light over whole blocks; what is left over at the border is dropped."""
    monkeypatch.setattr(images, "WHOLE_PIXELS", 400)
    codes = np.minimum(RAMP[:43, :61], 240)
    Image.fromarray(codes).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png")
    whole = srgb_to_linear(codes[:42, :60] / 255.0)
    expected = whole.reshape(14, 3, 20, 3, 3).mean((1, 3))
    np.testing.assert_allclose(photo.image, expected, atol=1e-6)
    assert [n.code for n in photo.notes] == ["photo-reduced"]
    assert read_image(tmp_path / "a.png").shape == (43, 61, 3)


def test_a_mean_over_a_saturated_pixel_counts_as_saturated(tmp_path, monkeypatch):
    """Channel by channel; the mean of dark and white would pass for a measured grey."""
    monkeypatch.setattr(images, "WHOLE_PIXELS", 400)
    codes = np.full((40, 60, 3), 50, np.uint8)
    codes[7, 10, 1] = 255
    Image.fromarray(codes).save(tmp_path / "a.png")
    photo = read_photo(tmp_path / "a.png")
    assert photo.clip_level is not None and photo.image.shape == (13, 20, 3)
    full = photo.image >= photo.clip_level
    assert np.argwhere(full).tolist() == [[2, 3, 1]]
    np.testing.assert_allclose(photo.image[~full], srgb_to_linear(50 / 255), rtol=1e-5)


def test_a_jpeg_beyond_memory_is_decoded_smaller(tmp_path, monkeypatch):
    monkeypatch.setattr(raster, "MAX_MEMORY", 64 * 48)
    monkeypatch.setattr(pillow, "MAX_MEMORY", 64 * 48)
    smooth = np.linspace(60, 200, 64).astype(np.uint8)[None, :, None].repeat(48, 0).repeat(3, 2)
    Image.fromarray(smooth).save(tmp_path / "a.jpg", quality=100)
    assert read_image(tmp_path / "a.jpg").shape == (24, 32, 3)
