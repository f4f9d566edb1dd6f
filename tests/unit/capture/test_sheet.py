"""The capture sheet in a photo: the camera by its markers, the light by its paper."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sheet_photo import irradiance, sheet_photo

from invrender.capture.lights import find_lights
from invrender.capture.mirror import make_ball
from invrender.capture.response import LOG_KNOTS, likely_curves
from invrender.capture.sheet import (
    _Camera,
    _fit,
    _from_homography,
    light_on_paper,
    moved_circle,
    use_paper,
    use_sheet,
)
from invrender.capture.sheet_layout import INK_REFLECTANCE, PAPER, capture_sheet
from invrender.capture.table import room_irradiance, screen_irradiance
from invrender.files.capture import Capture
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.pattern.default import default_pattern
from invrender.rig import Rig
from invrender.types import InputError

RIG = Rig()
HELD = Rig(camera_tilt=(4, -6, 3), camera_shift=(0.01, 0.005, 0.02))  # by hand
SIZE = (480, 640)
GAIN = (2.0, 1.5, 1.0)


def captured(image, *, rig=RIG, fov_from="rig", clip=None):
    return Capture(Photo(image, clip), rig, default_pattern(64), fov_from=fov_from)


def tilt_off(found, true):
    """Degrees between two cameras' axes."""
    return math.degrees(Rotation.from_matrix(found.camera_axes @ true.camera_axes.T).magnitude())


@pytest.fixture(scope="module")
def image():
    return sheet_photo(HELD, *SIZE, gain=GAIN, room=0, blur=0.8, noise=0.02, vignetting=0.2)


OPTICS = {"k1": -0.05, "centre": (0.004, -0.003)}


@pytest.fixture(scope="module")
def bent():
    return sheet_photo(HELD, *SIZE, **OPTICS)


# --- ink and paper ------------------------------------------------------------------------------


@pytest.mark.parametrize("ink", [0.04, 0.06])
def test_ink_and_paper_tell_how_steep_a_tone_curve_is(image, ink):
    printed = use_sheet(captured(image))[1].printed
    ratio = float(np.median(printed[:, 1] / printed[:, 0]))  # the lens mixes a little
    assert ratio == pytest.approx(PAPER / INK_REFLECTANCE, 0.12)
    paper = 0.6 * printed[:, 1] / printed.max()
    light = np.stack([paper * ink / PAPER, paper], -1)
    values = 2.3 * light / (1 + 1.3 * light)  # a strong shoulder (Reinhard)

    def error(curve):  # of the light on paper over that on ink, a logarithm
        log = np.log(values) + np.interp(np.log(values), LOG_KNOTS, curve)
        return abs(np.diff(log - np.log(light), axis=-1).mean())

    usual, told = likely_curves()[0], likely_curves(values)[0]
    assert error(usual) > 0.4 and error(told) < 0.6 * error(usual)


def test_ink_is_not_measured_where_paper_is_saturated(image):
    level = float(np.median(use_sheet(captured(image))[1].printed[:, 1]))
    clipped = use_sheet(captured(np.minimum(image, level), clip=level))[1].printed
    assert len(clipped) and clipped.max() < level


# --- the camera ---------------------------------------------------------------------------------


def analytic(true, *, k1=0.0, centre=(0.0, 0.0), noise=0.0, known="rig", focal_error=0.0, seed=0):
    """Errors of a camera fitted to projected corners, and the deviations that the fit expects."""
    photo, sheet = Photo(np.zeros((720, 960, 3), np.float32)), capture_sheet(RIG)
    rng, middle = np.random.default_rng(seed), np.array([480.0, 360.0])
    camera = _Camera(true.camera, true.camera_axes, true.focal(960), middle + centre, k1)
    quads = camera.project(sheet.corners)
    seen = ((quads > 0) & (quads < [960, 720])).all((1, 2))
    quads = quads[seen] + noise * rng.standard_normal(quads[seen].shape)
    places = sheet.corners[seen]
    start = _from_homography(places, quads, camera.focal * math.exp(focal_error), middle)
    fit = _fit(photo, RIG, known, places, quads, start)
    turn = Rotation.from_matrix(fit.camera.axes.T @ camera.axes).as_rotvec()
    log_focal = math.log(fit.camera.focal / camera.focal)
    optics = log_focal, fit.camera.ink, fit.camera.distortion - k1
    shift = fit.camera.place - camera.place
    return np.array([*shift, *turn, *optics, *(fit.camera.centre - camera.centre)]), fit.deviation


def test_exact_corners_give_the_exact_camera():
    for true in (RIG, HELD):
        error, _ = analytic(true)
        assert np.abs(error[:3]).max() < 2e-5 and np.abs(error[3:6]).max() < 2e-5
        assert abs(error[6]) < 1e-4 and abs(error[8]) < 1e-4 and np.abs(error[9:]).max() < 0.02


@pytest.mark.parametrize("known", ["rig", "unknown"])
def test_deviations_are_honest(known):
    """Seeds that were kept back; the numbers drawn from their priors."""
    scores = []
    for seed in range(100, 116):
        rng = np.random.default_rng(seed)
        true = replace(
            RIG,
            camera_tilt=tuple(3 * rng.standard_normal(3)),
            camera_shift=tuple(0.008 * rng.standard_normal(3)),
        )
        k1, *centre = rng.standard_normal(3) * [0.03, 2.5, 2.5]
        off = 0.005 * rng.standard_normal() if known == "rig" else 0.0
        error, deviation = analytic(
            true, k1=k1, centre=centre, noise=0.15, known=known, focal_error=off, seed=seed
        )
        scores.append(error / deviation)
    rms = np.sqrt(np.mean(np.square(scores), 0))
    assert np.all(rms < 1.8) and np.all(rms[[3, 4, 5, 8]] > 0.4)


def test_a_noisy_photo_gives_the_camera(image):
    used, found, notices = use_sheet(captured(image))
    assert found is not None and not notices and used.fov_from == "sheet"
    assert len(found.ids) >= 20 and found.residual < 0.3
    assert tilt_off(used.rig, HELD) < 0.1
    assert found.fov == pytest.approx(HELD.fov, rel=2e-3)
    off = np.abs(used.rig.camera - HELD.camera)
    assert np.all(off < 4 * np.array(found.place_deviation)) and off.max() < 1.5e-3
    at = [r.project(RIG.sample_corners, *SIZE) for r in (used.rig, HELD)]
    grown = (np.array(used.photo.image.shape[1::-1]) - SIZE[::-1]) / 2
    assert np.abs(at[0] - at[1]).max() < 1.0 + np.abs(grown).max()


@pytest.mark.parametrize("turned", [0.0, 0.03, 0.3])
@pytest.mark.parametrize("at", [0.25, 0.4, 0.55, 0.7])
def test_a_shadows_edge_over_markers_moves_no_corner(image, at, turned):
    """It crosses columns of markers, along their edges or aslant."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    edge = (x - at * SIZE[1] + turned * (y - SIZE[0] / 2)) / 4
    shade = 0.15 + 0.85 * np.clip(edge + 0.5, 0, 1)
    plain, shaded = (use_sheet(captured(im))[1] for im in (image, image * shade[..., None]))
    both = np.intersect1d(plain.ids, shaded.ids)
    assert len(both) >= 0.6 * len(plain.ids)
    a, b = (f.corners[[list(f.ids).index(k) for k in both]] for f in (plain, shaded))
    assert np.abs(a - b).max() < 2 and abs(plain.fov - shaded.fov) < 0.5


def test_a_strong_tilt_tells_the_field_of_view():
    true = Rig(camera_tilt=(0, 22, 0), camera_shift=(0.05, 0, 0.02), fov=60)
    image = sheet_photo(true, *SIZE, noise=0.005)
    _, found, _ = use_sheet(captured(image, fov_from="unknown"))
    assert abs(found.fov - 60) < min(3 * found.fov_deviation, 1.5)


def test_a_lying_field_of_view_is_told(image):
    _, found, notices = use_sheet(captured(image, rig=Rig(fov=60)))
    assert [n.code for n in notices] == ["fov-doubtful"] and "60.0°" in notices[0].text
    assert abs(found.fov - HELD.fov) < 3 * found.fov_deviation


@pytest.mark.parametrize("exposure", [1e-6, 1e3])
def test_exposure_does_not_matter(image, exposure):
    (a, _, _), (b, _, _) = (use_sheet(captured(image * np.float32(e))) for e in (1, exposure))
    assert tilt_off(a.rig, b.rig) < 1e-2


def test_optics_are_undone(bent):
    used, found, _ = use_sheet(captured(bent))
    assert found.distortion == pytest.approx(
        OPTICS["k1"], abs=max(4 * found.distortion_deviation, 2e-3)
    )
    assert found.principal == pytest.approx(OPTICS["centre"], abs=2e-3)
    assert tilt_off(used.rig, HELD) < 0.1
    _, found, _ = use_sheet(replace(used, rig=RIG, fov_from="unknown"))
    assert abs(found.distortion) < 0.004


def test_a_saturated_channel_leaves_the_others_as_they_are(bent):
    """A screen's red is saturated where its green is not: no white grows out of it."""
    red, level = np.array([1.0, 0.25, 0.05], np.float32), 1.0
    image = np.minimum(bent, 0.9)
    image[100:120, 300:330] = red
    used, _, _ = use_sheet(captured(image, clip=level))
    full = used.photo.image >= level
    assert full[..., 0].sum() > 300 and not full[..., 1:].any()
    inside = used.photo.image[full[..., 0]]
    np.testing.assert_allclose(np.median(inside, 0), red, atol=1e-3)


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_photo_is_set_upright(image, turns):
    used, _, notices = use_sheet(captured(np.rot90(image, -turns)))
    assert [n.code for n in notices] == ["photo-turned"] and f"{90 * turns}°" in notices[0].text
    assert tilt_off(used.rig, HELD) < 0.1


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_ball_by_hand_moves_with_the_photo(bent, turns):
    image, focal, x = bent, HELD.focal(SIZE[1]), HELD.project(RIG.ball_centre, *SIZE)
    q = (x - [SIZE[1] / 2, SIZE[0] / 2]) / focal
    x = [SIZE[1] / 2, SIZE[0] / 2] + focal * q * (1 + OPTICS["k1"] * (q @ q))
    x = x + np.array(OPTICS["centre"]) * SIZE[1]
    for _ in range(-turns % 4):  # where it lies in the turned photo
        width = image.shape[1]
        image, x = np.rot90(image), np.array([x[1], width - x[0]])
    capture = captured(image)
    used, found, _ = use_sheet(capture)
    moved = moved_circle(found, (*x, 20.0), capture.photo, used.photo)
    at = used.rig.project(RIG.ball_centre, used.photo.height, used.photo.width)
    assert found.turns == turns and moved == pytest.approx((*at, 20.0), abs=1.5)


@pytest.mark.parametrize("lies", [1, 2])
def test_a_turned_sheet_is_taken_as_it_lies(lies):
    high = Rig(camera_shift=(0, 0, 0.06))
    image = sheet_photo(high, *SIZE, lies=lies, noise=0.01)
    used, _, notices = use_sheet(captured(image))
    assert [n.code for n in notices] == ["sheet-turned"] and f"{90 * lies}°" in notices[0].text
    assert tilt_off(used.rig, high) < 0.2
    assert np.abs(used.rig.camera - high.camera).max() < 3e-3


def test_a_cut_sheet_serves_or_is_named(image):
    cut = image.copy()
    cut[:, 250:] = 0.1
    used, found, _ = use_sheet(captured(cut))
    assert 3 <= len(found.ids) <= 16 and tilt_off(used.rig, HELD) < 4 * found.tilt_deviation < 4
    x, y = np.floor(found.corners[:2].min(1) - 8).astype(int).T
    few = np.full_like(image, 0.1)
    for i in range(2):
        part = np.s_[max(y[i], 0) : y[i] + 60, max(x[i], 0) : x[i] + 60]
        few[part] = image[part]
    capture = captured(few)
    used, found, notices = use_sheet(capture)
    assert used is capture and found is None and [n.code for n in notices] == ["sheet-hidden"]


def test_another_rigs_sheet_is_refused(image):
    for rig in (Rig(screen_size=0.2), Rig(ball_radius=0.014)):
        with pytest.raises(InputError, match="another capture sheet"):
            use_sheet(captured(image, rig=rig))


def test_a_photo_without_a_sheet_stays():
    rng = np.random.default_rng(3)
    for image in (rng.uniform(0, 1, (300, 400, 3)), np.zeros((300, 400, 3)), np.ones((64, 64, 3))):
        capture = captured(image.astype(np.float32))
        assert use_sheet(capture) == (capture, None, ())


# --- the paper ----------------------------------------------------------------------------------


def test_the_paper_tells_the_screens_gain(image):
    """Also where the lights that the ball shows are wrong by a factor."""
    used, found, _ = use_sheet(captured(image))
    assert len(found.white) > 40 and found.white_radiance.shape == found.white.shape
    for factor in (1.0, 0.4):
        lights = Lights(used.rig, default_pattern(64), gain=factor * np.array(GAIN))
        light = light_on_paper(found, lights)
        assert light.gain == pytest.approx(GAIN, rel=0.05) and 0.06 < light.deviation < 0.1
    # A gain that the ball shows well is kept: the paper may reflect a little more or less.
    sure = light_on_paper(found, replace(lights, gain=0.96 * np.array(GAIN)), 0.005)
    assert sure.gain == pytest.approx(0.96 * np.array(GAIN), rel=0.01) and sure.deviation < 0.006


def test_saturated_paper_has_at_least_the_light_that_the_photo_shows(image):
    """Without it the rest, which is darker, would be taken as all that the screen lights."""
    _, whole, _ = use_sheet(captured(image))
    clip = float(np.quantile(whole.white_radiance.max(-1), 0.6))
    used, found, _ = use_sheet(captured(np.minimum(image, clip), clip=clip))
    assert tilt_off(used.rig, HELD) < 0.15
    full = found.white_saturated
    assert np.all(found.white_radiance[~full] < clip) and 0.2 < full.any(-1).mean() < 0.6
    dim = Lights(used.rig, default_pattern(64), gain=0.5 * np.array(GAIN))
    assert light_on_paper(found, dim).gain == pytest.approx(GAIN, rel=0.08)
    bound = replace(found, white_radiance=np.where(full, 0, found.white_radiance))
    bright = replace(dim, gain=2 * np.array(GAIN))
    assert light_on_paper(bound, bright).gain == pytest.approx(GAIN, rel=0.08)


def test_the_paper_stands_in_for_a_saturated_ball_and_contradicts_a_wrong_one(image):
    used, found, _ = use_sheet(captured(image))
    ball = make_ball(used.rig, used.rig.ball_centre, RIG.ball_radius, image.shape[:2])
    fit = {"saturated": 0.3, "gain_deviation": 0.4}
    dim = Lights(used.rig, default_pattern(64), gain=0.5 * np.array(GAIN), fit=fit)
    lights, notices = use_paper(found, dim, ball)
    assert lights.gain == pytest.approx(GAIN, rel=0.05)
    assert [n.code for n in notices] == ["gain-by-paper"]
    lights, notices = use_paper(found, replace(dim, fit={}), replace(ball, radius_m=0.0101))
    assert np.array_equal(lights.gain, dim.gain) and lights.fit["paper_gain"] > 1.8
    assert [n.code for n in notices] == ["sheet-scale", "paper-contradicts-ball"]
    assert "94%" in notices[0].text
    assert use_paper(None, dim, ball) == (dim, ())


def test_paper_in_a_shadow_does_not_overrule_a_ball_that_is_surer(image):
    """Two thirds of the paper lie in a shadow that no light explains, in another colour."""
    x = np.arange(image.shape[1])[None, :, None] / image.shape[1]
    used, found, _ = use_sheet(captured(image * np.where(x < 0.67, (0.5, 0.2, 0.2), 1.0)))
    ball = make_ball(used.rig, used.rig.ball_centre, RIG.ball_radius, image.shape[:2])
    fit = {"saturated": 0.15, "gain_deviation": 0.05}
    lights = Lights(used.rig, default_pattern(64), gain=np.array(GAIN), fit=fit)
    after, notices = use_paper(found, lights, ball)
    assert np.abs(np.log(after.gain / GAIN)).max() < 0.15
    assert "gain-by-paper" not in [n.code for n in notices]


def test_the_paper_tells_how_bright_guessed_lamps_are():
    """Lamps that a photo clips were made twenty times too bright, the screen half as bright."""
    used, found, _ = use_sheet(captured(sheet_photo(RIG, *SIZE, gain=GAIN, room=0.8)))
    ball = make_ball(used.rig, used.rig.ball_centre, RIG.ball_radius, SIZE)
    room = np.full((16, 32, 3), 20 * 0.8, np.float32)
    fit = {"saturated": 0.8, "gain_deviation": 0.3, "room_raised": 20.0}
    wrong = Lights(used.rig, default_pattern(64), room, 0.5 * np.array(GAIN), fit=fit, lamps=room)
    lights, notices = use_paper(found, wrong, ball)
    at = found.white[len(found.white) // 2][None]

    def light(gain, room):
        lit = lights.pattern, np.asarray(gain), lights.device
        return screen_irradiance(used.rig, at, lit, 24) + room_irradiance(used.rig, at, room)

    assert light(lights.gain, lights.environment) == pytest.approx(
        irradiance(used.rig, at, GAIN, 0.8), rel=0.08
    )
    assert lights.fit["room_raised"] < 3 and np.array_equal(lights.lamps, lights.environment)
    assert [n.code for n in notices] == ["gain-by-paper"]


def test_known_lights_take_the_camera_of_the_sheet(image):
    found = find_lights(captured(image), environment=np.zeros((8, 16, 3)), gain=GAIN)
    assert found.sheet is not None and tilt_off(found.lights.rig, HELD) < 0.1
