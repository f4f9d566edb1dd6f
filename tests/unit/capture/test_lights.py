from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage
from synthetic_photo import blocks, grey_table, light_from, photograph, sky, textured_table

from invrender.capture import ball as ball_module
from invrender.capture import lights as lights_module
from invrender.capture.ball import find_ball
from invrender.capture.ball_image import trace_ball
from invrender.capture.crop import crop_part, crop_sample
from invrender.capture.environment import fill_environment
from invrender.capture.lights import find_lights, level_table, measure_lights
from invrender.capture.mirror import (
    horizon_points,
    make_ball,
    mirror_normals,
    outline_points,
    place_ball,
)
from invrender.capture.orientation import find_ball_and_orientation, likeness
from invrender.capture.settings import BALL_SEARCH, ORIENTATION
from invrender.capture.table import room_irradiance
from invrender.colour import linear_to_srgb
from invrender.files.capture import Capture, load_capture
from invrender.files.images import Photo, read_photo
from invrender.files.rig_toml import write_rig
from invrender.files.write import write_exr
from invrender.rig import Rig
from invrender.sampling import resize_pattern
from invrender.sphere import directions, irradiance
from invrender.types import InputError

RIG = Rig()
SIZE = (720, 960)
PATTERN = blocks()
GAIN = np.array([2.0, 2.1, 1.9])


def true_ball(shift=(0.0, 0.0)):
    return make_ball(RIG, RIG.ball_centre + np.array([*shift, 0]), RIG.ball_radius, SIZE)


def off(ball, truth):
    """Errors of centre and radius in shares of the radius."""
    d = np.subtract(ball.centre, truth.centre)
    return np.hypot(*d) / truth.radius, abs(ball.radius / truth.radius - 1)


@pytest.fixture(scope="module")
def clean():
    return photograph(RIG, *SIZE, table=textured_table)


@pytest.fixture(scope="module")
def lights(clean):
    capture = Capture(Photo(clean), RIG, PATTERN)
    return measure_lights(capture, find_ball(capture.photo, RIG))


# --- geometry of the mirror ---------------------------------------------------------------------


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.02, -0.03)])
def test_mirror_normals_and_tracing_are_inverse(shift):
    ball = true_ball(shift)
    centre = np.array(ball.position)
    rng = np.random.default_rng(1)
    wanted = (
        rng.normal(size=(200, 3)) * [1, 1, 0]
        + [0, 0, 0.3]
        + rng.uniform(0, 2, (200, 1)) * [0, 0, 1]
    )
    wanted /= np.linalg.norm(wanted, axis=-1, keepdims=True)
    normal = mirror_normals(RIG, centre, ball.radius_m, wanted, False)
    pixels = RIG.project(centre + ball.radius_m * normal, *SIZE)
    _, mirrored, seen = trace_ball(RIG, ball, pixels)
    assert seen.all()
    np.testing.assert_allclose(mirrored, wanted, atol=1e-6)
    near = centre + wanted * rng.uniform(0.1, 0.3, (200, 1))
    normal = mirror_normals(RIG, centre, ball.radius_m, near, True)
    point, mirrored, _ = trace_ball(RIG, ball, RIG.project(centre + ball.radius_m * normal, *SIZE))
    assert np.linalg.norm(np.cross(near - point, mirrored), axis=-1).max() < 1e-6


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.03, -0.04)])
def test_outline_and_horizon_are_where_they_should_be(shift):
    ball = true_ball(shift)
    centre = np.array(ball.position)
    edge = outline_points(RIG, centre, ball.radius_m)
    np.testing.assert_allclose(np.linalg.norm(edge - centre, axis=-1), ball.radius_m)
    assert edge[:, 2].min() >= -1e-12
    touching = np.sum((edge - centre) * (edge - RIG.camera), -1)
    assert np.abs(touching[edge[:, 2] > 1e-9]).max() < 1e-12
    for points, sign in ((horizon_points(RIG, centre, ball.radius_m), 0),):
        _, mirrored, _ = trace_ball(RIG, ball, RIG.project(points, *SIZE))
        np.testing.assert_allclose(mirrored[:, 2], sign, atol=1e-6)


def test_place_ball_makes_the_circle_asked_for():
    ball = place_ball(RIG, SIZE, 500.5, 300.25, 38.0)
    assert ball.centre == pytest.approx((500.5, 300.25), abs=1e-6)
    assert ball.radius == pytest.approx(38, abs=1e-6)


@pytest.mark.parametrize("circle", [(5, 5, 40), (500, 300, -1), (np.nan, 3, 3), (900, 300, 100)])
def test_manual_ball_must_be_in_the_photo(circle):
    with pytest.raises(InputError, match="ball"):
        find_ball(Photo(np.ones((*SIZE, 3), np.float32)), RIG, circle)


# --- finding the ball ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "shift"),
    [(grey_table, (0.0, 0.0)), (textured_table, (0.003, 0.004)), (textured_table, (-0.012, 0.002))],
)
def test_ball_is_found_within_one_percent(table, shift):
    image = photograph(RIG, *SIZE, table=table, ball=shift)
    ball = find_ball(Photo(image), RIG)
    assert max(off(ball, true_ball(shift))) < 0.01
    assert ball.confidence > 0.7


@pytest.mark.parametrize("damage", ["noise", "blur", "jpeg", "coins"])
def test_ball_is_found_in_damaged_photos(clean, tmp_path, damage):
    photo = Photo(clean)
    if damage == "noise":
        noise = np.random.default_rng(2).normal(0, 0.01, clean.shape)
        photo = Photo(np.maximum(clean + noise, 0).astype(np.float32))
    elif damage == "blur":
        photo = Photo(ndimage.gaussian_filter(clean, (1.2, 1.2, 0)))
    elif damage == "jpeg":
        data = (linear_to_srgb(clean) * 255 + 0.5).astype(np.uint8)
        Image.fromarray(data).save(tmp_path / "a.jpg", quality=85)
        photo = read_photo(tmp_path / "a.jpg")
    else:
        image = clean.copy()
        y, x = np.mgrid[: SIZE[0], : SIZE[1]]
        for cx, cy, r in ((560, 300, 40), (395, 420, 28), (430, 260, 45)):
            image[np.hypot(x - cx, y - cy) < r] = (0.7, 0.5, 0.3)
        photo = Photo(image)
    ball = find_ball(photo, RIG)
    assert max(off(ball, true_ball())) < 0.02
    assert ball.confidence > BALL_SEARCH.least_confidence


@pytest.mark.parametrize(
    ("level", "why"), [(0.0005, "expose it longer"), (1.2, "expose it shorter"), (0.5, "is grey")]
)
def test_a_photo_that_shows_nothing_is_told_why(level, why, monkeypatch):
    """The search itself is not what is tested."""
    noise = np.random.default_rng(0).uniform(0.9, 1, (*SIZE, 1))
    photo = Photo(np.repeat(np.minimum(level * noise, 1), 3, -1).astype(np.float32), 1.0)

    def nothing(capture, ball):
        raise InputError("no mirror ball found")

    monkeypatch.setattr("invrender.capture.lights.find_ball_and_orientation", nothing)
    with pytest.raises(InputError, match=f"no mirror ball found; .*{why}"):
        find_lights(Capture(photo, RIG, PATTERN))


@pytest.mark.parametrize(
    "table", [pytest.param(grey_table, marks=pytest.mark.slow), textured_table]
)
def test_no_ball_is_refused(table, monkeypatch):
    """And soon: the rim, which takes longest, is not fitted at places that look like no ball."""
    fitted = []
    fit_rim = ball_module.fit_rim

    def counted(*a, **k):
        fitted.append(a)
        return fit_rim(*a, **k)

    monkeypatch.setattr(ball_module, "fit_rim", counted)
    image = photograph(RIG, *SIZE, table=table, ball=None)
    noise = np.random.default_rng(4).normal(0, 0.005, image.shape)
    with pytest.raises(InputError, match="no mirror ball found"):
        find_ball(Photo(np.maximum(image + noise, 0).astype(np.float32)), RIG)
    assert len(fitted) <= 6


def test_a_room_that_is_given_holds_no_guessed_lamps(clean, monkeypatch):
    """Lamps of the ball's environment do not fit another one, in size or in place."""
    measure = lights_module._measure

    def with_lamps(*arguments, **known):
        lights, response = measure(*arguments, **known)
        return replace(lights, lamps=lights.environment / 2), response

    monkeypatch.setattr(lights_module, "_measure", with_lamps)
    room = np.full((8, 16, 3), 0.3, np.float32)
    found = find_lights(Capture(Photo(clean), RIG, PATTERN), environment=room)
    assert found.lights.lamps is None
    twice = found.lights.scaled(np.ones(3), np.full(3, 2.0), np.full(3, 5.0))
    np.testing.assert_allclose(twice.environment, 2 * room)


def test_coins_are_no_balls():
    image = photograph(RIG, *SIZE, ball=None)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    image[np.hypot(x - 480, y - 360) < 40] = (0.7, 0.5, 0.3)
    image[np.hypot(x - 480, y - 360) < 29] = (0.1, 0.1, 0.1)
    with pytest.raises(InputError, match="no mirror ball found"):
        find_ball(Photo(image), RIG)


def test_ball_cut_off_is_refused(clean):
    half = clean[:345]  # through the ball; the rig's optical axis is then the new middle
    with pytest.raises(InputError, match=r"cut off|no mirror ball"):
        find_ball(Photo(half), RIG)


def test_saturated_and_black_balls_are_refused(clean):
    photo = Photo(np.minimum(clean * 20, 1), 0.98)
    with pytest.raises(InputError, match="saturated"):
        find_ball(photo, RIG, (480, 360, 40))
    image = clean.copy()
    image[310:410, 430:530] = 0
    with pytest.raises(InputError, match="black"):
        find_ball(Photo(image), RIG, (480, 360, 40))


def test_too_small_a_photo_is_refused(clean):
    with pytest.raises(InputError, match="too small"):
        find_ball(Photo(clean[::6, ::6]), RIG)


# --- lights -------------------------------------------------------------------------------------


def test_environment_round_trip(lights):
    height = lights.environment.shape[0]
    truth = sky(directions(height, 2 * height))
    seen = lights.coverage
    assert seen[height // 2 :].max() == 0 and seen[:3].min() < 1.01
    e, t = (irradiance(x * seen[..., None]) for x in (lights.environment, truth))
    np.testing.assert_allclose(e, t, rtol=0.01)
    full = (seen > 0.99) & (directions(height, 2 * height)[..., 2] > 0.1)
    assert full.mean() > 0.3
    error = lights.environment[full] - truth[full]
    assert np.sqrt(np.mean(error**2)) / truth[full].mean() < 0.05
    upper = directions(height, 2 * height)[..., 2] > 0
    e, t = (irradiance(x * upper[..., None]) for x in (lights.environment, truth))
    np.testing.assert_allclose(e, t, rtol=0.05)


def test_small_lamp_keeps_its_energy():
    def lamp(d):
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        on = d @ (np.array([0.5, 0.6, 0.62]) / np.linalg.norm([0.5, 0.6, 0.62])) > np.cos(0.03)
        return np.where(on[..., None], 800.0, 0.1) * np.ones(3)

    image = photograph(RIG, *SIZE, environment=lamp, samples=5)
    got = measure_lights(Capture(Photo(image), RIG, PATTERN), true_ball())
    height = got.environment.shape[0]
    fine = lamp(directions(1024, 2048)).reshape(
        height, 1024 // height, 2 * height, 1024 // height, 3
    )
    truth = fine.mean((1, 3))
    e, t = (irradiance(x * got.coverage[..., None]) for x in (got.environment, truth))
    np.testing.assert_allclose(e, t, rtol=0.03)


def test_pattern_and_gain(lights):
    np.testing.assert_allclose(lights.gain, GAIN, rtol=0.01)
    assert lights.fit["gamma"] == pytest.approx(1, abs=0.03)
    middle = lights.pattern_captured[4::8, 4::8][2:-2, 2:-2] / lights.gain
    assert np.corrcoef(middle.ravel(), PATTERN[4::8, 4::8][2:-2, 2:-2].ravel())[0, 1] > 0.97


def test_gain_under_blur_and_display_gamma():
    image = photograph(RIG, *SIZE, pattern=PATTERN**1.3)
    photo = Photo(ndimage.gaussian_filter(image, (0.8, 0.8, 0)))
    fit = measure_lights(Capture(photo, RIG, PATTERN), true_ball()).fit
    assert fit["gamma"] == pytest.approx(1.3, abs=0.1)
    photo = Photo(ndimage.gaussian_filter(photograph(RIG, *SIZE), (0.8, 0.8, 0)))
    got = measure_lights(Capture(photo, RIG, PATTERN), true_ball())
    np.testing.assert_allclose(got.gain, GAIN, rtol=0.03)
    assert got.fit["blur"] == pytest.approx(0.8, abs=0.3)


def test_screen_is_not_in_the_environment(lights):
    """The brightest blocks of the screen are far above the sky around them."""
    height = lights.environment.shape[0]
    d = directions(height, 2 * height)
    behind = light_from(
        RIG, RIG.ball_centre, d, lambda x: np.zeros((*x.shape[:-1], 3)), PATTERN, GAIN
    )
    hidden = (behind.sum(-1) > 0) & (d[..., 2] > 0)
    assert lights.coverage[hidden].mean() < 0.02
    assert lights.environment[hidden].max() < 0.8 < GAIN.max()


def test_fill_is_exact_for_constant_light_and_smooth():
    coverage = np.ones((32, 64))
    coverage[4:12, 50:] = 0
    coverage[:2] = 0
    constant = np.where(coverage[..., None] > 0, 0.7, 0) * np.ones(3)
    filled = fill_environment(constant, coverage)
    np.testing.assert_allclose(filled[:16], 0.7, rtol=1e-6)
    with pytest.raises(InputError, match="nothing but the screen"):
        fill_environment(constant, np.zeros_like(coverage))


# --- a camera that does not look straight down ---------------------------------------------------


@pytest.fixture(scope="module")
def tilted():
    """A rig whose camera looks 2.3 degrees past straight down, and its photo."""
    rig = replace(RIG, camera_tilt=(1.8, -1.4, 0.0))
    return rig, Photo(photograph(rig, *SIZE, table=grey_table))


def test_the_table_is_levelled_about_the_ball(tilted):
    rig, photo = tilted
    ball = find_ball(photo, RIG)
    found = level_table(photo, RIG, ball)
    np.testing.assert_allclose(found.camera_tilt, rig.camera_tilt, atol=0.5)
    # The camera sees the ball and the screen where it saw them; only the table is another.
    centre = np.asarray(ball.position)

    def seen(rig):
        e_x, e_y = rig.screen_edges
        corner = rig.screen_corner
        points = np.array([centre, corner, corner + e_x, corner + e_y])
        return (points - rig.camera) @ rig.camera_axes.T

    np.testing.assert_allclose(seen(found), seen(RIG), atol=1e-9)


def test_a_tilted_camera_leaves_the_light_on_the_table(tilted):
    rig, photo = tilted
    height = 64
    truth = sky(directions(height, 2 * height))
    truth[height // 2 :] = 0
    points = RIG.sample_points(3, 3).reshape(-1, 3)
    true = room_irradiance(rig, points, truth)

    def error(lights):
        return np.abs(room_irradiance(lights.rig, points, lights.environment) / true - 1).mean()

    ball = find_ball(photo, RIG)
    told = measure_lights(Capture(photo, RIG, PATTERN), ball, height)
    assert told.fit["camera_tilt"] == pytest.approx(2.3, abs=0.6)
    # A JPEG's photo has a clipping level, and is taken as straight.
    straight = measure_lights(Capture(replace(photo, clip_level=1e3), RIG, PATTERN), ball, height)
    assert straight.fit["camera_tilt"] == 0
    assert error(told) < 0.5 * error(straight)


def test_the_tilt_turns_with_the_photo(tilted):
    """A photo of which it is not known which side is up is levelled as well."""
    rig, photo = tilted
    turned = Capture(Photo(np.rot90(photo.image, -1)), RIG, PATTERN)
    _, ball, notices = find_ball_and_orientation(turned)
    assert [n.code for n in notices] == ["photo-turned"] and ball.size == SIZE
    np.testing.assert_allclose(ball.camera_tilt, rig.camera_tilt, atol=0.5)


def test_a_screen_that_is_nearly_all_white_is_not_another_pattern():
    """An exposure for the sample: what is seen of the pattern says nothing of its orientation."""
    image = photograph(RIG, *SIZE, table=textured_table, gain=40 * GAIN)
    photo = Photo(np.minimum(image, 1).astype(np.float32), 1.0)
    here, ball, notices = find_ball_and_orientation(Capture(photo, RIG, PATTERN))
    assert here.pattern is PATTERN and not notices
    assert off(ball, true_ball())[0] < 0.05
    assert measure_lights(here, ball, 32).fit["saturated"] > 0.7


@pytest.mark.parametrize("white", [np.inf, 1.0])
def test_a_lamp_beside_the_screen_leaves_the_pattern_alike(white):
    """It shines into two cells, forty times as bright as the screen."""
    shown = resize_pattern(PATTERN, ORIENTATION.cells)
    seen = 2.0 * shown
    seen[-1, 15:17] = [70, 57, 38]
    seen, level = np.minimum(seen, white), np.full(3, white)
    assert likeness(seen, shown, level) > 0.95
    assert likeness(seen, np.rot90(shown), level) < 0.5


def test_a_tilt_that_the_rig_tells_is_kept(tilted):
    rig, photo = tilted
    ball = make_ball(rig, rig.ball_centre, rig.ball_radius, SIZE)
    assert level_table(photo, rig, ball) is rig


@pytest.mark.parametrize("tilt", [37.0, 66.0, 120.0])
def test_a_ball_outside_the_photo_is_refused(clean, tilt):
    """A camera that looks past the ball, or away from it."""
    away = replace(RIG, camera_tilt=(tilt, 0.0, 0.0))
    with pytest.raises(InputError, match="outside the photo"):
        find_ball(Photo(clean), away)


def test_photo_without_a_screen_is_refused(clean):
    dark = photograph(RIG, *SIZE, gain=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="screen is dark"):
        measure_lights(Capture(Photo(dark), RIG, PATTERN), true_ball())


# --- the sample ---------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 0.0), (2.0, -2.0, 1.0)])
@pytest.mark.parametrize("size", [32, 128, 400])
def test_crop_shows_the_sample(size, tilt):
    def table(p):
        x, y = p[..., 0] / RIG.sample_size, p[..., 1] / RIG.sample_size
        return np.stack([0.5 + x, 0.5 + y, 0.5 + 0.4 * np.sin(20 * x) * np.cos(17 * y)], -1)

    rig = replace(RIG, camera_tilt=tilt, fov=80.0)  # with room for the tilt
    photo = Photo(photograph(rig, *SIZE, table=table, ball=None))
    crop = crop_sample(photo, rig, size)
    truth = table(rig.sample_points(size, size))
    assert crop.shape == (size, size, 3)
    assert np.sqrt(np.mean((crop - truth) ** 2)) < (0.012 if size == 32 else 0.004)


@pytest.mark.parametrize(("size", "scale"), [(64, 1), (128, 1), (256, 1), (128, 2)])
def test_white_paper_around_the_sample_stays_out_of_the_crop(size, scale):
    """Through a lens that blurs by 0.6 pixels of a photo 960 wide, whatever the photo's size."""
    half = RIG.sample_size / 2
    inside = lambda p: np.abs(p[..., :2]).max(-1, keepdims=True) < half  # noqa: E731
    image = photograph(
        RIG, *np.multiply(SIZE, scale), table=lambda p: np.where(inside(p), 0.1, 0.8) + [0.0] * 3,
        ball=None,
    )  # fmt: skip
    image = ndimage.gaussian_filter(image, (0.6 * scale, 0.6 * scale, 0))
    assert np.abs(crop_sample(Photo(image), RIG, size) - 0.1).max() < 0.012


@pytest.mark.parametrize("tilt", [(6.0, 0.0, 0.0), (0.0, -5.0, 0.0), (4.0, 4.0, 5.0)])
def test_a_tilted_camera_gives_the_same_crop(tilt, folder):
    """A homography, where ``rig.toml`` tells the tilt: 5 to 8 degrees, and a turn in the plane."""

    def table(p):
        x, y = p[..., 0] / RIG.sample_size, p[..., 1] / RIG.sample_size
        return np.stack([0.5 + 0.4 * np.sin(25 * x), 0.5 + 0.4 * np.cos(19 * y), 0.5 + x * y], -1)

    crops = []
    for t in (tilt, (0.0, 0.0, 0.0)):
        rig = replace(RIG, camera_tilt=t, fov=84.0)
        write_exr(folder / "photo.exr", photograph(rig, *SIZE, table=table, ball=None))
        write_rig(folder / "rig.toml", rig, "pattern.exr")
        capture = load_capture(folder)
        crops.append(crop_sample(capture.photo, capture.rig, 200))
    assert np.sqrt(np.mean((crops[0] - crops[1]) ** 2)) < 0.003
    assert np.abs(crops[0] - crops[1]).max() < 0.02


@pytest.mark.parametrize("size", [160, 250])
def test_a_sharp_crop_is_the_mean_over_its_pixels(size):
    """Of waves, which a mean over a length shrinks by a sinc: the photo's pixels do as well."""
    wave = 2 * np.pi * size / RIG.sample_size / 4  # four of the crop's pixels long
    pixel = RIG.sample_size / np.ptp(RIG.project(RIG.sample_corners, *SIZE), axis=0)[0]

    def shown(p, length):
        mean = np.sinc(wave * length / (2 * np.pi)) ** 2
        return 0.5 + 0.4 * mean * np.cos(wave * p[..., :1]) * np.cos(wave * p[..., 1:2]) + [0.0] * 3

    photo = Photo(photograph(RIG, *SIZE, table=lambda p: shown(p, pixel), ball=None))
    truth = shown(RIG.sample_points(size, size), RIG.sample_size / size)
    inner = slice(8, -8)
    plain, sharp = (
        np.sqrt(np.mean((crop_part(photo, RIG, size, None, s) - truth)[inner, inner] ** 2))
        for s in (False, True)
    )
    assert sharp < 0.005 and sharp < 0.6 * plain, (sharp, plain)


def test_crop_does_not_alias():
    """Stripes finer than the crop's pixels average out."""
    photo = Photo(
        photograph(RIG, *SIZE, table=lambda p: np.sign(np.sin(p[..., :1] * 4000)) * 0.5 + [0.5] * 3)
    )
    crop = crop_sample(photo, RIG, 24)[2:-2, 2:-2]
    assert crop.std() < 0.1  # the stripes' own: 0.5


def test_sample_out_of_the_photo_is_refused():
    photo = Photo(np.ones((*SIZE, 3), np.float32))
    with pytest.raises(InputError, match="beyond the photo"):
        crop_sample(photo, replace(RIG, fov=30.0), 64)
    with pytest.raises(InputError, match="at least one pixel"):
        crop_sample(photo, RIG, 0)


# --- folders ------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "capture"
    path.mkdir()
    write_exr(path / "photo.exr", np.full((120, 160, 3), 0.5))
    write_exr(path / "pattern.exr", PATTERN)
    write_rig(path / "rig.toml", RIG, "pattern.exr")
    return path


def test_capture_folder(folder):
    capture = load_capture(folder)
    assert capture.photo.image.shape == (120, 160, 3) and capture.rig == RIG
    np.testing.assert_allclose(capture.pattern, PATTERN, atol=1e-6)
    assert capture.truth is None and capture.true_environment is None


def test_fov_comes_from_the_photo_where_rig_toml_has_none(folder):
    (folder / "photo.exr").unlink()
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: 28})
    Image.fromarray(np.full((200, 300, 3), 90, np.uint8)).save(folder / "photo.jpg", exif=exif)
    lines = (folder / "rig.toml").read_text().splitlines()
    (folder / "rig.toml").write_text("\n".join(x for x in lines if not x.startswith("fov")))
    assert load_capture(folder).rig.fov == pytest.approx(2 * np.degrees(np.arctan(18 / 28)))


def refused(folder, match):
    with pytest.raises(InputError, match=match) as e:
        load_capture(folder)
    assert "\n" not in str(e.value).strip()


def test_missing_files(folder, tmp_path):
    refused(tmp_path / "nowhere", "not a folder")
    (folder / "pattern.exr").unlink()
    refused(folder, "does not exist")
    (folder / "photo.exr").unlink()
    refused(folder, "has no photo")


def test_two_photos(folder):
    write_exr(folder / "photo.tif", np.ones((4, 4, 3)))
    refused(folder, "more than one photo")


@pytest.mark.parametrize(
    ("image", "match"),
    [
        (np.zeros((120, 160, 3)), "all black"),
        (np.full((1, 1, 3), 0.5), "too small"),
        (np.full((0, 0, 3), 0.5), "not a readable"),
    ],
)
def test_bad_photos(folder, image, match):
    if image.size:
        write_exr(folder / "photo.exr", image)
    else:
        (folder / "photo.exr").write_bytes(b"no image")
    refused(folder, match)


def test_nan_photo(folder):
    import OpenEXR

    data = np.full((120, 160, 3), np.nan, np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": data}) as f:
        f.write(str(folder / "photo.exr"))
    refused(folder, "NaN")


@pytest.mark.parametrize(("value", "match"), [(1.5, "relative radiance"), (0.0, "all black")])
def test_bad_patterns(folder, value, match):
    write_exr(folder / "pattern.exr", np.full((8, 8, 3), value))
    refused(folder, match)


@pytest.mark.parametrize("name", ["../outside.exr", "/etc/hostname", "link.exr", "sub/../../x.exr"])
@pytest.mark.parametrize("section", ["pattern", "sample"])
def test_names_must_stay_in_the_folder(folder, name, section):
    write_exr(folder.parent / "outside.exr", PATTERN)
    (folder / "link.exr").symlink_to(folder.parent / "outside.exr")
    names = {"pattern": "pattern.exr"} | {section: name}
    write_rig(folder / "rig.toml", RIG, **names)
    refused(folder, "leads out of the capture's folder")


def test_unknown_keys_and_low_screens(folder):
    text = (folder / "rig.toml").read_text()
    (folder / "rig.toml").write_text(text + "\n[pattern2]\nimage = 3\n")
    refused(folder, "unknown key")
    (folder / "rig.toml").write_text(text.replace("height = 0.153", "height = -0.1"))
    refused(folder, "above the table")
