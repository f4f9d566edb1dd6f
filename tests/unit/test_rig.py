import math
from dataclasses import replace

import numpy as np
import pytest

from invrender.files.rig_toml import read_rig, write_rig
from invrender.lights import Device
from invrender.rig import Rig
from invrender.types import InputError

TOML = """
[screen]
size = 0.2
height = 0.16
[camera]
offset = 0.01
[ball]
radius = 0.01
reflectance = [0.8, 0.85, 0.9]
[pattern]
image = "p.png"
"""


def test_screen_is_the_samples_mirror_image():
    """Light from the screen's edges that the sample's edges mirror reaches the camera."""
    rig = Rig()
    corner, (e_x, e_y) = rig.screen_corner, rig.screen_edges
    for s, t in ((0, 0), (1, 0), (0, 1), (1, 1)):
        point = corner + s * e_x + t * e_y
        # Mirrored in the table, the way from the camera to the point crosses z = 0 half-way.
        crossing = (rig.camera + point) / 2
        on_sample = rig.sample_size / 2 * np.array([2 * s - 1, 2 * t - 1])
        np.testing.assert_allclose(crossing[:2], on_sample, atol=1e-12)
    assert corner[0] + rig.screen_size == pytest.approx(rig.optical_axis_x - 2 * rig.camera_offset)


def test_ball_is_at_the_photos_centre_and_right_is_x():
    rig = Rig()
    np.testing.assert_allclose(rig.project(rig.ball_centre, 960, 1280), [640, 480])
    right, up = rig.project(rig.ball_centre + np.array([[0.01, 0, 0], [0, 0.01, 0]]), 960, 1280)
    assert right[0] > 640 and right[1] == pytest.approx(480)
    assert up[1] < 480 and up[0] == pytest.approx(640)


def test_fov_is_the_photos_width():
    rig = Rig()
    half = rig.screen_height * math.tan(math.radians(rig.fov / 2))
    edge = rig.ball_centre + np.array([half, 0, 0])
    assert rig.project(edge, 960, 1280)[0] == pytest.approx(1280)


@pytest.mark.parametrize("tilt", [(0, 0, 0), (4.0, -3.0, 10.0)])
def test_rays_undo_projection(tilt):
    rig = replace(Rig(), camera_tilt=tilt, camera_shift=(0.003, -0.002, 0.001))
    pixels = np.random.default_rng(0).uniform(0, 900, (50, 2))
    points = rig.camera + 0.2 * rig.rays(pixels, 960, 1280)
    np.testing.assert_allclose(rig.project(points, 960, 1280), pixels, atol=1e-9)


def test_sample_points_have_row_0_at_plus_y():
    points = Rig().sample_points(4, 4)
    assert points[0, 0, 1] > 0 > points[0, 0, 0] and points[-1, -1, 0] > 0 > points[-1, -1, 1]
    assert points[..., 0].max() == pytest.approx(0.09 / 2 * 0.75)


def test_the_screens_cosines_make_its_form_factor():
    """Of a rectangle parallel to a surface and above it: Howell's catalogue of configuration
    factors, B-3, four corners; and nought above it."""
    rig = Rig()
    middle = rig.screen_corner + sum(rig.screen_edges) / 2
    a = rig.screen_size / 2 / middle[2]
    corner = 2 * a / math.sqrt(1 + a * a) * math.atan(a / math.sqrt(1 + a * a)) / (2 * math.pi)
    cosines = rig.screen_cosines(middle * [[1, 1, 0], [1, 1, 2]], 200)
    assert cosines.shape == (2, 200, 200)
    assert cosines[0].sum() / math.pi == pytest.approx(4 * corner, rel=1e-4)
    assert not cosines[1].any()


def test_scale_does_not_matter():
    small, large = Rig(), Rig(180.0, 153.0, 17.0, 9.5)
    points = small.sample_points(5, 5)
    np.testing.assert_allclose(
        small.project(points, 96, 128), large.project(points * 1000, 96, 128), atol=1e-9
    )


def test_file_round_trip(tmp_path):
    rig = Rig(0.2, 0.16, 0.01, 0.01, 60.0, (0.8, 0.85, 0.9), camera_tilt=(1.0, 2.0, 3.0))
    write_rig(tmp_path / "rig.toml", rig, "p.png", "truth/")
    found = read_rig(tmp_path / "rig.toml")
    assert (found.rig, found.files) == (rig, {"pattern": "p.png", "sample": "truth/"})
    assert found.device is None


def test_file_round_trip_of_a_real_rig(tmp_path):
    rig = Rig(
        screen_size=(0.228, 0.16), screen_bezel=0.01, camera_height=0.2, sample_side=0.07,
        screen_shift=tuple(np.array([1e-3, 0, 0])),
    )  # fmt: skip
    mixing = ((0.9, 0.1, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    device = Device(falloff=0.7, gamma=(1.1, 1.0, 0.9), black=0.01, mixing=mixing)
    write_rig(tmp_path / "rig.toml", rig, sample="truth/", device=device)
    found = read_rig(tmp_path / "rig.toml")
    assert (found.rig, found.files, found.device) == (rig, {"sample": "truth/"}, device)


def test_a_rectangle_is_the_square_that_a_square_is():
    """What rig.toml says in one number or two is one rig, where a square of side l has a = l/4."""
    l, delta = 0.2, 0.01
    square = Rig(l, 0.16, delta)
    for rig in (square, Rig((l, l), 0.16, delta), Rig(l, 0.16, delta, sample_side=l / 2)):
        assert rig.optical_axis_x == pytest.approx(l / 4 + delta)
        np.testing.assert_allclose(rig.screen_corner, [-0.75 * l - delta, -l / 2, 0.16])
        np.testing.assert_allclose(sum(rig.screen_edges), [l, l, 0])
    wide = Rig((0.228, 0.16), 0.16, delta, screen_bezel=0.008, camera_height=0.25)
    assert wide.sample_size == 0.08
    corner, (e_x, e_y) = wide.screen_body
    # The gap to the optical axis is twice delta, less the bezel; the camera is where it is said.
    assert wide.optical_axis_x - (corner + e_x)[0] == pytest.approx(2 * delta - 0.008)
    np.testing.assert_allclose(e_y, [0, 0.176, 0])
    np.testing.assert_allclose(wide.camera, [0.05, 0, 0.25])


def test_dimming_lowers_the_screens_cosines_by_its_power():
    rig = Rig()
    plain, dimmed = (rig.screen_cosines(np.zeros(3), 8, e) for e in (0.0, 1.5))
    e_x, e_y = rig.screen_edges
    t = (np.arange(8) + 0.5) / 8
    middle = rig.screen_corner + t[:, None] * e_x + (1 - t)[:, None, None] * e_y
    cosine = rig.screen_height / np.linalg.norm(middle, axis=-1)
    np.testing.assert_allclose(dimmed, plain * cosine**1.5)


def test_fov_of_the_file_comes_before_that_of_the_exif(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(TOML)
    assert read_rig(path, fov=50.0).rig.fov == 50
    assert read_rig(path).rig.fov == Rig().fov
    path.write_text(TOML.replace("offset = 0.01", "offset = 0.01\nfov = 65"))
    assert read_rig(path, fov=50.0).rig.fov == 65


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("size = 0.2", "size = -0.2", "must be positive"),
        ("size = 0.2", "size = nan", "must be finite"),
        ("size = 0.2", "size = true", "must be a number"),
        ("size = 0.2", 'size = "big"', "must be a number"),
        ("size = 0.2", "size = [0.2]", r"a number or \[width, depth\]"),
        ("size = 0.2", "size = [0.2, -0.1]", "must be positive"),
        ("size = 0.2", "size = 0.2\nbezel = -0.1", "must not be negative"),
        ("offset = 0.01", "offset = 0.01\nheight = 0", "camera_height must be positive"),
        ("[pattern]", "[device]\nfalloff = -1\n[pattern]", "falloff must lie"),
        ("[pattern]", "[device]\nmixing = [1, 0, 0]\n[pattern]", "three lists of three"),
        ("[pattern]", "[device]\ncurve = 1\n[pattern]", "known keys: black, falloff"),
        ("size = 0.2", "sise = 0.2", "unknown key 'sise'"),
        ("size = 0.2", "", "size is missing"),
        ("size = 0.2", "size = ", "not valid TOML"),
        ("[screen]", "[display]", "no such section"),
        ("height = 0.16", "height = 0", "above the table"),
        ("height = 0.16", "height = 0.16\ntilt = [80, 0, 0]\nshift = [0, 0, -0.1]", "below the"),
        ("radius = 0.01", "radius = -1", "must be positive"),
        ("offset = 0.01", "offset = -0.01", "must not be negative"),
        ("offset = 0.01", "offset = 0.01\nfov = 175", "between 1 and 170"),
        ("[0.8, 0.85, 0.9]", "[0.8, 0.85]", "list of three"),
        ("[0.8, 0.85, 0.9]", "1.5", "at most 1"),
        ('"p.png"', "3", "file name"),
    ],
)
def test_bad_rig_files(tmp_path, old, new, message):
    assert old in TOML
    (tmp_path / "rig.toml").write_text(TOML.replace(old, new))
    with pytest.raises(InputError, match=message) as e:
        read_rig(tmp_path / "rig.toml")
    assert "tilted screen" in str(e.value) or str(e.value).count("\n") <= 1


def test_missing_rig_file(tmp_path):
    with pytest.raises(InputError, match=r"rig\.toml is missing"):
        read_rig(tmp_path / "rig.toml")


PLAIN = (
    "[screen]\nsize = 0.18\nheight = 0.153\n[camera]\noffset = 0.017\nfov = 70\n"
    "[ball]\nradius = 0.0095\n"
)


@pytest.mark.parametrize(
    "blob",
    [
        b"\xef\xbb\xbf" + PLAIN.encode(),
        PLAIN.replace("\n", "\r\n").encode(),
        b"\xef\xbb\xbf" + PLAIN.replace("\n", "\r\n").encode(),
        PLAIN.replace("\n", "\r").encode(),
        PLAIN.encode("utf-16"),
    ],
)
def test_text_of_other_systems_is_read(tmp_path, blob):
    (tmp_path / "rig.toml").write_bytes(blob)
    assert read_rig(tmp_path / "rig.toml").rig == Rig(fov=70)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("0.153", "0,153", "line 3: write 0.153 with a point"),
        ("fov = 70", "fov = 73,7  # degrees", "line 6: write 73.7"),
        ("0.18", '"0,18"', r"\[screen\] size must be a number without quotes"),
    ],
)
def test_decimal_commas_get_a_hint_at_the_place(tmp_path, old, new, match):
    (tmp_path / "rig.toml").write_text(PLAIN.replace(old, new))
    with pytest.raises(InputError, match=match):
        read_rig(tmp_path / "rig.toml")


def test_other_encodings_are_named(tmp_path):
    (tmp_path / "rig.toml").write_bytes("# größe\n".encode("latin-1") + PLAIN.encode())
    with pytest.raises(InputError, match="UTF-8"):
        read_rig(tmp_path / "rig.toml")


def test_millimetres_are_told(tmp_path):
    text = PLAIN.replace("0.18", "180").replace("0.153", "153").replace("0.017", "17")
    (tmp_path / "rig.toml").write_text(text.replace("0.0095", "9.5"))
    (warning,) = read_rig(tmp_path / "rig.toml").warnings
    assert warning.code == "rig-units" and "divide them by 1000" in warning.text


def test_where_the_field_of_view_is_known_from(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(PLAIN)
    assert read_rig(path, fov=50.0).fov_from == "rig"
    path.write_text(PLAIN.replace("fov = 70\n", ""))
    assert read_rig(path, fov=50.0).fov_from == "exif"
    assert read_rig(path).fov_from == "unknown"


def test_a_rig_without_a_screen_goes_through_its_file(tmp_path):
    rig = Rig(screen_size=None, screen_height=0.2, camera_height=0.2, sample_side=0.06)
    write_rig(tmp_path / "rig.toml", rig, "pattern.exr", device=Device(falloff=1.0))
    assert "screen" not in (tmp_path / "rig.toml").read_text()
    told = read_rig(tmp_path / "rig.toml")
    assert told.rig == rig and not told.rig.has_screen and told.device is None
    assert rig.camera[2] == 0.2 and rig.sample_size == 0.06
    assert not rig.screen_cosines(np.zeros((2, 3)), 4).any()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[sample]\nsize = 0.09", "camera. height is missing, which a rig without"),
        ("height = 0.2", "sample. size is missing, which a rig without"),
        ('height = 0.2\n[pattern]\nimage = "p.png"', "screen. size is missing$"),
    ],
)
def test_what_a_rig_without_a_screen_needs_is_told(tmp_path, text, match):
    path = tmp_path / "rig.toml"
    path.write_text("[ball]\nradius = 0.01\n[camera]\noffset = 0.01\n" + text)
    with pytest.raises(InputError, match=match):
        read_rig(path)
    with pytest.raises(InputError, match="without a screen"):
        Rig(screen_size=None)
