"""Every format's tags of colour, geometry and exposure: the same scene comes out of all of them."""

import io
import struct

import image_files as made
import numpy as np
import pytest
import tifffile
from PIL import Image

from invrender.colour import PRIMARIES, to_rec709
from invrender.files.images import PHOTOS, read_image, read_photo
from invrender.types import InputError

SCENE = made.scene()
P3 = made.in_space(SCENE, made.P3_TO_XYZ)
ADOBE = made.in_space(SCENE, made.ADOBE_TO_XYZ)
P3_PROFILE = made.profile(made.P3_TO_XYZ)
# Half a code of eight bits, where the sRGB curve is steepest, and the JPEG's own rounding.
EIGHT, SIXTEEN = 0.5 / 255 * 2.4, 0.5 / 65535 * 2.4


def close(path, tolerance, scene=SCENE):
    photo = read_photo(path).in_rec709()
    np.testing.assert_allclose(photo.image, scene, atol=tolerance)
    return photo


def close_on_average(path, scene=SCENE, tolerance=2e-3):
    """What YCbCr rounds off is no bias: mean colours agree, of which P3 taken for sRGB, or one
    curve for another, is off by 0.01 and more."""
    photo = read_photo(path).in_rec709()
    np.testing.assert_allclose(photo.image.mean((0, 1)), scene.mean((0, 1)), atol=tolerance)
    np.testing.assert_allclose(photo.image, scene, atol=0.035)
    return photo


def codes_of(photo):
    return [n.code for n in photo.notes], [n.code for n in photo.warnings]


def refused(path, match):
    with pytest.raises(InputError, match=match) as e:
        read_photo(path)
    assert "\n" not in str(e.value)


# --- PNG


@pytest.mark.parametrize("levels", [255, 65535])
@pytest.mark.parametrize(
    ("name", "values", "chunks"),
    [
        ("untagged", made.srgb(SCENE), []),
        ("sRGB", made.srgb(SCENE), [(b"sRGB", b"\0")]),
        ("gAMA 1", SCENE, [(b"gAMA", struct.pack(">I", 100_000))]),
        ("gAMA 1/2.2", SCENE ** (1 / 2.2), [(b"gAMA", struct.pack(">I", 45_455))]),
        ("gAMA 1/1.8", SCENE ** (1 / 1.8), [(b"gAMA", struct.pack(">I", 55_556))]),
        ("sRGB over gAMA", made.srgb(SCENE),
         [(b"sRGB", b"\0"), (b"gAMA", struct.pack(">I", 100_000))]),
        ("cHRM of P3", made.srgb(P3),
         [(b"cHRM", struct.pack(">8I", *(round(v * 100_000) for v in
          (*made.P3_XY[6:], *made.P3_XY[:6]))))]),
        ("iCCP of P3", made.srgb(P3), [made.iccp(P3_PROFILE)]),
        ("iCCP over sRGB", made.srgb(P3), [made.iccp(P3_PROFILE), (b"sRGB", b"\0")]),
        ("iCCP linear Adobe", ADOBE, [made.iccp(made.profile(made.ADOBE_TO_XYZ, 1.0))]),
        ("cICP P3", made.srgb(P3), [(b"cICP", bytes([12, 13, 0, 1]))]),
        ("cICP linear", SCENE, [(b"cICP", bytes([1, 8, 0, 1]))]),
        ("cICP over iCCP", made.srgb(SCENE),
         [(b"cICP", bytes([1, 13, 0, 1])), made.iccp(P3_PROFILE)]),
    ],
)  # fmt: skip
def test_png(tmp_path, levels, name, values, chunks):
    made.write_png(tmp_path / "a.png", made.codes(values, levels), *chunks)
    # The matrices of the standards are given to four or five digits.
    close(tmp_path / "a.png", (EIGHT if levels == 255 else SIXTEEN) + 1.5e-3)


def test_png_pq_and_hlg(tmp_path):
    """ITU-R BT.2100: PQ 0.5806 is 203 cd/m²; HLG 0.75 is 0.265 of its peak."""
    grey = np.full((4, 4, 3), round(0.580689 * 65535), np.uint16)
    made.write_png(tmp_path / "a.png", grey, (b"cICP", bytes([9, 16, 0, 1])))
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), 1, rtol=2e-3)
    made.write_png(tmp_path / "a.png", made.codes(np.full((4, 4, 3), 0.75), 65535),
                   (b"cICP", bytes([9, 18, 0, 1])))  # fmt: skip
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), 0.26496, rtol=2e-3)


def test_png_of_narrow_range(tmp_path):
    codes = np.rint(16 + 219 * made.srgb(SCENE)).astype(np.uint8)
    made.write_png(tmp_path / "a.png", codes, (b"cICP", bytes([1, 13, 0, 0])))
    close(tmp_path / "a.png", 0.5 / 219 * 2.4)


def test_png_refusals(tmp_path):
    image = made.codes(SCENE)
    path = tmp_path / "a.png"
    made.write_png(path, image, (b"cICP", bytes([99, 13, 0, 1])))
    refused(path, "does not know")
    made.write_png(path, image, (b"iCCP", b"a\0\0junk"))
    refused(path, "damaged colour profile")
    made.write_png(path, image, made.iccp(made.profile(made.SRGB_TO_XYZ, 2.2, grey=True)))
    refused(path, "profile for GRAY on 3 channels")
    made.write_png(path, image, (b"gAMA", bytes(4)))
    refused(path, "gamma")
    made.write_png(path, image, (b"cHRM", bytes(32)))
    refused(path, "span no colours")
    made.write_png(path, image, (b"pHYs", struct.pack(">IIB", 300, 600, 0)))
    refused(path, "2 times as wide|0.5 times as wide")
    made.write_png(path, image, (b"acTL", struct.pack(">II", 3, 0)))
    refused(path, "animation")


@pytest.mark.parametrize("kind", ["alpha", "key", "palette"])
def test_png_transparency(tmp_path, kind):
    path = tmp_path / "a.png"
    image = made.codes(made.srgb(SCENE))
    if kind == "alpha":
        half = np.concatenate([image, np.full_like(image[..., :1], 128)], -1)
        made.write_png(path, half)
        photo = close(path, EIGHT)  # straight alpha is no factor of the colours
        assert codes_of(photo) == (["photo-alpha"], [])
        half[0, 0, 3] = 0
        made.write_png(path, half)
    elif kind == "key":
        made.write_png(path, image, (b"tRNS", image[5, 5].astype(">u2").tobytes()))
    else:
        Image.fromarray(image).quantize(16).save(path, transparency=0)
    refused(path, "transparent pixels")
    read_image(path)  # a texture may have holes


def test_data_are_no_colours(tmp_path):
    """Roughness and normals stand for themselves, whatever the file says of colours."""
    image = made.codes(SCENE)
    for chunk in (made.iccp(P3_PROFILE), (b"gAMA", struct.pack(">I", 100_000)), (b"sRGB", b"\0")):
        made.write_png(tmp_path / "a.png", image, chunk)
        got = read_image(tmp_path / "a.png", linear=True)
        np.testing.assert_allclose(got, image / 255.0, atol=1e-6)
    made.write_exr(tmp_path / "a.exr", {**made.planes(SCENE), "A": 0.5 + 0 * SCENE[..., 0]},
                   chromaticities=PRIMARIES["ap0"])  # fmt: skip
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr", linear=True), SCENE)


# --- EXR


def test_exr_chromaticities_and_interop_ids(tmp_path):
    path = tmp_path / "a.exr"
    for space in ("ap0", "ap1", "p3d65", "rec2020", "adobergb"):
        there = np.linalg.inv(to_rec709(PRIMARIES[space]))
        values = (SCENE @ there.T).astype(np.float32)
        made.write_exr(path, made.planes(values), chromaticities=PRIMARIES[space])
        assert codes_of(close(path, 1e-5)) == (["photo-colour"], [])
        made.write_exr(path, made.planes(values), colorInteropID=f"lin_{space}_scene")
        close(path, 1e-5)
    made.write_exr(path, made.planes(P3.astype(np.float32)), chromaticities=made.P3_XY)
    close(path, 1e-3)  # by the standard's own matrix
    made.write_exr(
        path, made.planes(SCENE @ made.SRGB_TO_XYZ.T), colorInteropID="lin_ciexyzd65_scene"
    )
    close(path, 1e-3)
    made.write_exr(path, made.planes(made.srgb(SCENE)), colorInteropID="srgb_rec709_scene")
    close(path, 1e-5)
    made.write_exr(path, made.planes(SCENE ** (1 / 2.2)), colorInteropID="g22_rec709_scene")
    close(path, 1e-5)
    made.write_exr(path, made.planes(SCENE), chromaticities=PRIMARIES["rec709"])
    assert codes_of(close(path, 0)) == ([], [])
    made.write_exr(path, made.planes(SCENE), colorInteropID="acme:log_secret_scene")
    refused(path, "colour space 'acme:log_secret_scene'")
    made.write_exr(path, made.planes(SCENE), chromaticities=(0.3,) * 8)
    refused(path, "span no colours")


def test_exr_luminance_chroma(tmp_path):
    y = SCENE @ [0.212639, 0.715169, 0.072192]
    red, blue = ((SCENE[..., k] - y) / y for k in (0, 2))
    made.write_exr(tmp_path / "a.exr", {"Y": y, "RY": red, "BY": blue})
    close(tmp_path / "a.exr", 2e-4)
    made.subsampled_exr(
        tmp_path / "s.exr", {"Y": (y, 1), "RY": (red[::2, ::2], 2), "BY": (blue[::2, ::2], 2)}
    )
    photo = read_photo(tmp_path / "s.exr")  # beyond the last chroma samples they are repeated
    np.testing.assert_allclose(photo.image[:-1, :-1], SCENE[:-1, :-1], atol=3e-3)
    assert codes_of(photo)[1] == ["photo-chroma"]
    made.write_exr(tmp_path / "y.exr", {"Y": y})
    close(tmp_path / "y.exr", 1e-6, np.repeat(y[..., None], 3, -1))
    made.write_exr(tmp_path / "r.exr", {"Y": y, "RY": red})
    refused(tmp_path / "r.exr", "RY")
    made.subsampled_exr(tmp_path / "g.exr", {"R": (y, 1), "G": (y[::2, ::2], 2), "B": (y, 1)})
    refused(tmp_path / "g.exr", "subsampled")


def test_exr_layers(tmp_path):
    path, wrong = tmp_path / "a.exr", np.full_like(SCENE, 0.5)
    for name in ("beauty", "Combined", "ViewLayer.Combined", "rgba", "RGBA"):
        made.write_exr(path, made.planes(wrong, "albedo.") | made.planes(SCENE, f"{name}."))
        assert codes_of(close(path, 0)) == (["photo-layer"], [])
    made.write_exr(
        path, made.planes(wrong, "Combined.") | made.planes(SCENE) | {"Z": wrong[..., 0]}
    )
    close(path, 0)
    made.write_exr(path, made.planes(wrong, "beauty.") | made.planes(SCENE, "Combined."))
    close(path, 0)
    made.write_exr(path, made.planes(wrong, "albedo.") | made.planes(wrong, "diffuse."))
    refused(path, r"albedo\..*diffuse\.")
    made.write_exr(path, made.planes(wrong, "A.Combined.") | made.planes(wrong, "B.Combined."))
    refused(path, "more than one picture")
    made.write_exr(path, {"Z": wrong[..., 0]})
    refused(path, "it has Z")
    made.write_exr(path, {"R": wrong[..., 0], "G": wrong[..., 0]})
    refused(path, "it has")


def test_exr_parts(tmp_path):
    import OpenEXR

    def parts(**images):
        head = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
        listed = [
            OpenEXR.Part(dict(head), {c: np.ascontiguousarray(image[..., k], np.float32)
                                      for k, c in enumerate("RGB")}, name=name)
            for name, image in images.items()
        ]  # fmt: skip
        with OpenEXR.File(listed) as f:
            f.write(str(tmp_path / "a.exr"))

    parts(albedo=0 * SCENE, beauty=SCENE)
    close(tmp_path / "a.exr", 0)
    parts(left=SCENE, right=SCENE)
    refused(tmp_path / "a.exr", "left.*right")


def test_deep_exr_is_refused(tmp_path):
    import OpenEXR

    deep = np.empty((4, 5), object)
    for at in np.ndindex(4, 5):
        deep[at] = np.ones(1 + sum(at) % 2, np.float32)
    with OpenEXR.File(
        {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION},
        {c: deep.copy() for c in "RGBA"},
    ) as f:
        f.write(str(tmp_path / "a.exr"))
    refused(tmp_path / "a.exr", "deep")


def test_exr_windows(tmp_path):
    path = tmp_path / "a.exr"
    h, w = SCENE.shape[:2]
    shown = made.window(0, 0, w - 1, h - 1)
    part = SCENE[10:, 20:]
    made.write_exr(path, made.planes(part), dataWindow=made.window(20, 10, w - 1, h - 1),
                   displayWindow=shown)  # fmt: skip
    refused(path, "does not fill")
    pasted = np.zeros_like(SCENE)
    pasted[10:, 20:] = part
    np.testing.assert_array_equal(read_image(path), pasted)
    wide = np.pad(SCENE, [(3, 4), (5, 6), (0, 0)], constant_values=9)  # overscan
    made.write_exr(path, made.planes(wide), dataWindow=made.window(-5, -3, w + 5, h + 3),
                   displayWindow=shown)  # fmt: skip
    close(path, 0)
    moved = made.window(100, 50, 100 + w - 1, 50 + h - 1)
    made.write_exr(path, made.planes(SCENE), dataWindow=moved, displayWindow=moved)
    close(path, 0)
    made.write_exr(path, made.planes(SCENE), pixelAspectRatio=2.0)
    refused(path, "2 times as wide")


def test_exr_alpha(tmp_path):
    path = tmp_path / "a.exr"
    alpha = np.linspace(0.2, 1, SCENE.shape[1], dtype=np.float32)[None].repeat(len(SCENE), 0)
    made.write_exr(path, made.planes(SCENE * alpha[..., None]) | {"A": alpha})
    assert codes_of(close(path, 1e-6)) == (["photo-alpha"], [])
    made.write_exr(path, made.planes(SCENE) | {"A": np.ones_like(alpha)})
    assert codes_of(close(path, 0)) == ([], [])
    alpha[3, 3] = 0
    made.write_exr(path, made.planes(SCENE * alpha[..., None]) | {"A": alpha})
    refused(path, "transparent")


# --- TIFF


@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize(
    ("compression", "predictor"),
    [(None, None), ("lzw", 2), ("lzw", None), ("zlib", 2), ("zstd", 2), ("packbits", None),
     ("zlib", 3), ("zstd", 3), ("lzw", 3)],
)  # fmt: skip
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float16", "float32"])
def test_tiff_kinds(tmp_path, bigtiff, byteorder, compression, predictor, dtype):
    floats = dtype.startswith("float")
    if predictor and floats != (predictor == 3):
        pytest.skip("a predictor of the other kind of numbers")
    levels = {"uint8": 255, "uint16": 65535}.get(dtype)
    data = SCENE.astype(dtype) if floats else made.codes(made.srgb(SCENE), levels)
    tifffile.imwrite(tmp_path / "a.tif", data, photometric="rgb", bigtiff=bigtiff,
                     byteorder=byteorder, compression=compression, predictor=predictor,
                     rowsperstrip=7)  # fmt: skip
    close(tmp_path / "a.tif", {"uint8": EIGHT, "uint16": SIXTEEN, "float16": 3e-4}.get(dtype, 0))


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_tiff_bits(tmp_path, bits):
    """Codes of 10, 12 and 14 bits in words of 16: white is 2^bits - 1."""
    data = (made.srgb(SCENE) * (2**bits - 1) + 0.5).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", data, photometric="rgb", bitspersample=bits)
    close(tmp_path / "a.tif", 0.5 / (2**bits - 1) * 2.4)


def test_tiff_of_32_bit_integers(tmp_path):
    data = (made.srgb(SCENE) * (2**32 - 1)).astype(np.uint32)
    tifffile.imwrite(tmp_path / "a.tif", data, photometric="rgb")
    close(tmp_path / "a.tif", SIXTEEN * 2)


def test_tiff_profiles(tmp_path):
    path = tmp_path / "a.tif"
    for data, blob, tolerance in (
        (made.codes(made.srgb(P3)), P3_PROFILE, EIGHT),
        (made.codes(made.srgb(P3), 65535), P3_PROFILE, SIXTEEN),
        (made.codes(SCENE, 65535), made.profile(made.SRGB_TO_XYZ, 1.0), SIXTEEN),
        (made.codes(ADOBE ** (1 / 2.2), 65535), made.profile(made.ADOBE_TO_XYZ, 2.2), SIXTEEN),
        (P3.astype(np.float32), made.profile(made.P3_TO_XYZ, 1.0), 0),
        (made.srgb(P3).astype(np.float32), P3_PROFILE, 0),
    ):
        tifffile.imwrite(path, data, photometric="rgb", iccprofile=blob)
        # LittleCMS keeps a profile's numbers to four digits.
        assert codes_of(close(path, tolerance + 1.5e-3))[1] == []


def test_float_tiff_above_white_keeps_its_curve(tmp_path):
    bright = SCENE * 4
    tifffile.imwrite(tmp_path / "a.tif", (bright ** (1 / 2.2)).astype(np.float32),
                     photometric="rgb", iccprofile=made.profile(made.SRGB_TO_XYZ, 2.2))  # fmt: skip
    np.testing.assert_allclose(read_image(tmp_path / "a.tif"), bright, rtol=5e-3)


def test_16_bit_tiff_without_a_profile_is_told(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", made.codes(made.srgb(SCENE), 65535), photometric="rgb")
    assert codes_of(close(tmp_path / "a.tif", SIXTEEN)) == ([], ["photo-curve-unknown"])


def test_tiff_tags_of_colour(tmp_path):
    """WhitePoint, PrimaryChromaticities and TransferFunction, without a profile."""
    path = tmp_path / "a.tif"
    steps = tuple(int(v) for v in np.rint((np.arange(256) / 255) ** 1.8 * 65535))
    tags = [
        (318, 5, 2, made.fractions(made.P3_XY[6:]), True),
        (319, 5, 6, made.fractions(made.P3_XY[:6]), True), (301, 3, 256, steps, True),
    ]  # fmt: skip
    data = made.codes(P3 ** (1 / 1.8))
    tifffile.imwrite(path, data, photometric="rgb", extratags=tags)
    close(path, 0.5 / 255 * 1.8 + 1e-3)


def test_tiff_colour_models(tmp_path):
    path = tmp_path / "a.tif"
    rgb = made.codes(made.srgb(SCENE))
    tifffile.imwrite(path, np.dstack([255 - rgb, 0 * rgb[..., :1]]), photometric="separated")
    refused(path, "CMYK")
    weights = np.array([0.299, 0.587, 0.114])
    y = rgb @ weights
    cb, cr = ((rgb[..., k] - y) / (2 - 2 * weights[k]) + 128 for k in (2, 0))
    ycc = (np.stack([y, cb, cr], -1) + 0.5).astype(np.uint8)
    tifffile.imwrite(path, ycc, photometric="ycbcr", extratags=[(530, 3, 2, (1, 1), True)])
    close_on_average(path)
    tifffile.imwrite(path, rgb, photometric="rgb", compression="jpeg",
                     compressionargs={"level": 100}, subsampling=(1, 1))  # fmt: skip
    close_on_average(path)
    tifffile.imwrite(path, 255 - rgb[..., 0], photometric="miniswhite")
    close(path, EIGHT, SCENE[..., :1].repeat(3, -1))
    Image.fromarray(rgb).quantize(256).save(path)
    close(path, 0.1)
    tifffile.imwrite(path, rgb.astype(np.int16), photometric="rgb")
    refused(path, "int16")
    tifffile.imwrite(path, rgb[..., 0], photometric=32803, extratags=[(33421, 3, 2, (2, 2), True)])
    refused(path, "camera raw")


@pytest.mark.parametrize("bits", [8, 16])
def test_tiff_lab(tmp_path, bits):
    """CIE L*a*b* under D50, as Photoshop writes it, against LittleCMS's own conversion."""
    from PIL import ImageCms

    rgb = Image.fromarray(made.codes(made.srgb(SCENE)))
    lab = np.asarray(ImageCms.profileToProfile(
        rgb, ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB"), outputMode="LAB"
    ))  # fmt: skip
    if bits == 16:
        wide = lab.astype(np.int16) * 256
        wide[..., 1:] = lab[..., 1:].astype(np.int8).astype(np.int16) * 256
        lab16 = wide.view(np.uint16).copy()
        lab16[..., 0] = lab[..., 0].astype(np.uint16) * 257
        lab = lab16
    tifffile.imwrite(tmp_path / "a.tif", lab, photometric="cielab")
    close(tmp_path / "a.tif", 0.02)  # a step of a* or b* is a hundredth of light


def test_tiff_pages_and_thumbnails(tmp_path):
    path, data = tmp_path / "a.tif", made.codes(made.srgb(SCENE))
    with tifffile.TiffWriter(path) as f:
        f.write(data[::8, ::8], photometric="rgb", subfiletype=1)
        f.write(data, photometric="rgb")
    close(path, EIGHT)
    with tifffile.TiffWriter(path) as f:
        f.write(data, photometric="rgb", subifds=1)
        f.write(data[::8, ::8], photometric="rgb", subfiletype=1)
    close(path, EIGHT)
    with tifffile.TiffWriter(path) as f:
        f.write(data[::8, ::8], photometric="rgb", subfiletype=1, subifds=1)
        f.write(data, photometric="rgb")
    close(path, EIGHT)
    with tifffile.TiffWriter(path) as f:
        f.write(data, photometric="rgb")
        f.write(data, photometric="rgb")
    refused(path, "holds 2 pictures")
    tifffile.imwrite(path, np.stack([data] * 3), photometric="rgb", volumetric=True,
                     tile=(16, 16, 16))  # fmt: skip
    refused(path, "dimensions|pixels")


def test_a_tiff_without_most_of_its_tiles_is_refused_at_once(tmp_path):
    """Of a width of millions, and a dozen tiles: it took minutes."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, made.codes(SCENE, 65535), photometric="rgb", tile=(16, 16))
    with tifffile.TiffFile(path, mode="r+") as f:
        f.pages[0].tags["ImageWidth"].overwrite(3_539_000)
    refused(path, "not a readable TIFF")


def test_tiff_alpha_aspect_and_orientation(tmp_path):
    path, alpha = tmp_path / "a.tif", np.full(SCENE.shape[:2], 0.5, np.float32)
    four = np.dstack([SCENE * 0.5, alpha])
    tifffile.imwrite(path, four, photometric="rgb", extrasamples=["assocalpha"])
    assert codes_of(close(path, 1e-6)) == (["photo-alpha"], [])
    tifffile.imwrite(
        path, np.dstack([SCENE, alpha]), photometric="rgb", extrasamples=["unassalpha"]
    )
    close(path, 1e-6)
    tifffile.imwrite(path, SCENE, photometric="rgb", resolution=(100, 200))
    refused(path, "as wide as high")
    turned = np.ascontiguousarray(np.rot90(SCENE))
    tifffile.imwrite(path, turned, photometric="rgb", extratags=[(274, 3, 1, 6, True)])
    assert codes_of(close(path, 0)) == (["photo-orientation"], [])


# --- JPEG, WebP, AVIF, HEIC


def test_jpeg_profiles(tmp_path):
    path = tmp_path / "a.jpg"
    for values, blob in (
        (made.srgb(P3), P3_PROFILE),
        (ADOBE ** (1 / 2.2), made.profile(made.ADOBE_TO_XYZ, 2.2)),
        (made.srgb(SCENE), made.profile(made.SRGB_TO_XYZ)),
    ):
        path.write_bytes(made.jpeg(made.codes(values), icc_profile=blob))
        assert codes_of(close_on_average(path)) == (["photo-colour"], [])


def test_jpeg_grey_profile(tmp_path):
    grey = made.codes(SCENE[..., 0] ** (1 / 1.8))
    blob = made.profile(made.SRGB_TO_XYZ, 1.8, grey=True)
    Image.fromarray(grey).save(tmp_path / "a.jpg", quality=100, icc_profile=blob)
    close_on_average(tmp_path / "a.jpg", SCENE[..., :1].repeat(3, -1))


@pytest.mark.parametrize("tag", ["interoperability", "colour space"])
def test_jpeg_adobe_rgb_by_exif(tmp_path, tag):
    exif = Image.Exif()
    if tag == "colour space":
        exif.get_ifd(0x8769)[0xA001] = 2
    else:
        exif.get_ifd(0x8769)[0xA001] = 0xFFFF
        exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    path = tmp_path / "a.jpg"
    path.write_bytes(made.jpeg(made.codes(ADOBE ** (256 / 563)), exif=exif))
    assert codes_of(close_on_average(path)) == (["photo-colour"], [])


def test_jpeg_of_unknown_colours_is_told(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    (tmp_path / "a.jpg").write_bytes(made.jpeg(made.codes(made.srgb(SCENE)), exif=exif))
    assert codes_of(read_photo(tmp_path / "a.jpg")) == ([], ["photo-colour-unknown"])


def test_jpeg_cmyk(tmp_path):
    rgb = Image.fromarray(made.codes(made.srgb(SCENE)))
    rgb.convert("CMYK").save(tmp_path / "a.jpg", quality=100)
    refused(tmp_path / "a.jpg", "CMYK without a colour profile")


@pytest.mark.parametrize(("subsampling", "told"), [(0, []), (1, ["photo-chroma"]),
                                                   (2, ["photo-chroma"])])  # fmt: skip
def test_chroma_subsampling_is_told(tmp_path, subsampling, told):
    path = tmp_path / "a.jpg"
    path.write_bytes(made.jpeg(made.codes(made.srgb(SCENE)), subsampling=subsampling))
    assert codes_of(read_photo(path)) == ([], told)


def test_gain_maps_are_ignored_and_said_so(tmp_path):
    body = made.jpeg(made.codes(made.srgb(SCENE)))
    xmp = b'http://ns.adobe.com/xap/1.0/\0<x xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/"/>'
    segment = b"\xff\xe1" + struct.pack(">H", len(xmp) + 2) + xmp
    (tmp_path / "a.jpg").write_bytes(
        body[:2] + segment + body[2:] + made.jpeg(np.zeros((8, 8), "u1"))
    )
    assert codes_of(close_on_average(tmp_path / "a.jpg")) == (["photo-gain-map"], [])


def test_jpeg_pixels_that_are_not_square(tmp_path):
    path = tmp_path / "a.jpg"
    blob = bytearray(made.jpeg(made.codes(made.srgb(SCENE))))
    at = blob.index(b"JFIF\0") + 7
    blob[at : at + 5] = struct.pack(">BHH", 0, 1, 2)
    path.write_bytes(bytes(blob))
    refused(path, "as wide as high")


def test_webp(tmp_path):
    image = Image.fromarray(made.codes(made.srgb(P3)))
    image.save(tmp_path / "a.webp", lossless=True, icc_profile=P3_PROFILE)
    assert codes_of(close(tmp_path / "a.webp", EIGHT + 1.5e-3)) == (["photo-colour"], [])
    image.save(tmp_path / "a.webp", quality=95)
    assert codes_of(read_photo(tmp_path / "a.webp"))[1] == ["photo-chroma"]
    image.save(tmp_path / "a.webp", save_all=True, append_images=[image.rotate(90)])
    refused(tmp_path / "a.webp", "animation")


def test_avif(tmp_path):
    path = tmp_path / "a.avif"
    Image.fromarray(made.codes(made.srgb(P3))).save(
        path, quality=100, subsampling="4:4:4", icc_profile=P3_PROFILE
    )
    # The codec's own rounding; the wrong primaries cost 0.03.
    assert codes_of(close_on_average(path, tolerance=8e-3)) == (["photo-colour"], [])
    Image.fromarray(made.codes(made.srgb(SCENE))).save(path, quality=100, subsampling="4:2:0")
    assert codes_of(read_photo(path))[1] == ["photo-chroma"]


def test_avif_of_ten_bits_and_other_primaries(tmp_path):
    """What its nclx box says, and all of its bits."""
    import imagecodecs

    codes = (made.srgb(P3) * 1023 + 0.5).astype(np.uint16)
    blob = imagecodecs.avif_encode(
        codes, level=100, bitspersample=10, pixelformat="444", primaries=12, transfer=13, matrix=1
    )
    (tmp_path / "a.avif").write_bytes(blob)
    assert codes_of(close(tmp_path / "a.avif", 8e-3)) == (["photo-colour"], [])


def test_heic(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    path = tmp_path / "a.heic"
    for values, options in (
        (made.srgb(P3), {"icc_profile": P3_PROFILE}),
        (made.srgb(SCENE), {}),
    ):
        image = heif.from_pillow(Image.fromarray(made.codes(values)))
        image.info.update(options)
        image.save(path, quality=100, chroma=444)
        close_on_average(path)
    # An iPhone's photo that is named .jpg.
    path.rename(tmp_path / "a.jpg")
    close_on_average(tmp_path / "a.jpg")


# --- Radiance


@pytest.mark.parametrize("axes", [b"-Y +X", b"+Y +X", b"-Y -X", b"+Y -X",
                                  b"+X -Y", b"+X +Y", b"-X -Y", b"-X +Y"])  # fmt: skip
def test_radiance_orientations(tmp_path, axes):
    made.write_hdr(tmp_path / "a.hdr", SCENE, axes=axes)
    close(tmp_path / "a.hdr", 1 / 256)


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        (b"EXPOSURE=4\n", 4), (b"EXPOSURE=4\nEXPOSURE= 0.5\n", 2),
        (b"COLORCORR=2 1 0.5\n", (2, 1, 0.5)), (b"EXPOSURE=2\nCOLORCORR=1 2 4\n", (2, 4, 8)),
    ],
)  # fmt: skip
def test_radiance_exposure(tmp_path, header, factor):
    made.write_hdr(tmp_path / "a.hdr", SCENE * factor, header)
    photo = close(tmp_path / "a.hdr", 1 / 64)
    assert [n.code for n in photo.notes] == ["photo-exposure"]


def test_radiance_colours(tmp_path):
    path = tmp_path / "a.hdr"
    made.write_hdr(path, SCENE @ made.SRGB_TO_XYZ.T)
    path.write_bytes(path.read_bytes().replace(b"rle_rgbe", b"rle_xyze"))
    close(path, 0.02)
    xy = " ".join(map(str, made.P3_XY)).encode()
    made.write_hdr(path, P3, b"PRIMARIES= " + xy + b"\n")
    close(path, 8e-3)
    made.write_hdr(path, SCENE, b"PIXASPECT=2\n")
    refused(path, "as wide as high")
    made.write_hdr(path, SCENE, b"EXPOSURE=much\n")
    refused(path, "damaged EXPOSURE")
    made.write_hdr(path, SCENE, b"GAMMA=2.2\n")
    refused(path, "gamma")


def test_radiance_old_runs_and_windows_lines(tmp_path):
    flat = SCENE[:, :1].repeat(600, 1)
    made.write_hdr(tmp_path / "a.hdr", flat, old=True)
    close(tmp_path / "a.hdr", 1 / 256, flat)
    made.write_hdr(tmp_path / "b.hdr", SCENE)
    blob = (tmp_path / "b.hdr").read_bytes()
    head, rest = blob[: blob.index(b"-Y")], blob[blob.index(b"-Y") :]
    (tmp_path / "b.hdr").write_bytes(head.replace(b"\n", b"\r\n") + rest)
    close(tmp_path / "b.hdr", 1 / 256)


# --- all


def test_other_formats_are_refused_by_name(tmp_path):
    for name in ("GIF", "BMP", "PPM", "ICO"):
        stream = io.BytesIO()
        Image.fromarray(made.codes(SCENE)).save(stream, name)
        (tmp_path / "photo.png").write_bytes(stream.getvalue())
        refused(tmp_path / "photo.png", "known are EXR")


def test_a_format_is_told_by_its_content(tmp_path):
    (tmp_path / "photo.png").write_bytes(made.jpeg(made.codes(made.srgb(SCENE))))
    close_on_average(tmp_path / "photo.png")
    assert len(set(PHOTOS)) == len(PHOTOS)


def test_a_cropped_photo_has_no_field_of_view(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: 24, 0xA002: 4000, 0xA003: 3000})
    path = tmp_path / "a.jpg"
    path.write_bytes(made.jpeg(made.codes(SCENE), exif=exif))  # 64 × 48, scaled down
    assert read_photo(path).fov == pytest.approx(71.59, abs=0.01)
    path.write_bytes(made.jpeg(made.codes(SCENE[:, :40]), exif=exif))
    photo = read_photo(path).in_rec709()
    assert photo.fov is None and codes_of(photo) == ([], ["photo-cropped"])
