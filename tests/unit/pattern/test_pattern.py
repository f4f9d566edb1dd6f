"""The light pattern: the shipped one, the design criterion and the command."""

from __future__ import annotations

import argparse
import re
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console

from benchmarks.common.chromium import CHROMIUM, Page
from invrender.capture.sheet_layout import capture_sheet, marker_dictionary
from invrender.cli.pattern import add_parser
from invrender.data.environments import procedural_environment
from invrender.data.tablets import TABLETS, find_tablet
from invrender.files.images import read_image
from invrender.files.rig_toml import read_rig, write_rig
from invrender.files.write import INCH
from invrender.pattern.default import block_pattern, default_pattern, mirrored
from invrender.pattern.design import (
    DARKEST,
    GROUP_PIXELS,
    NAMES,
    Criterion,
    design,
    draw_population,
    measure_responses,
    optimise,
    wheel,
)
from invrender.pattern.design.population import _shade
from invrender.pattern.design.sets import best_set, candidates, set_errors
from invrender.pattern.display import pattern_page
from invrender.pattern.guide import _guide, _sheet, needed_focal
from invrender.pattern.sets import pattern_set
from invrender.rig import Rig
from invrender.sampling import resize_pattern
from invrender.sphere import scale_environment
from invrender.types import InputError

RIG, SIDE, SAMPLES = Rig(), 5, 48


@pytest.fixture(scope="module")
def responses():
    return measure_responses(RIG, draw_population(RIG, 24, 7, rooms=2), SIDE, SAMPLES)


@pytest.fixture(scope="module")
def criterion(responses):
    return Criterion(responses)


# --- the shipped pattern ------------------------------------------------------------------------


def test_default_pattern_is_what_a_display_can_show():
    pattern = default_pattern(256)
    assert pattern.shape == (256, 256, 3) and pattern.dtype == np.float32
    assert pattern.min() >= 0.01 and pattern.max() <= 1
    # Every colour has its share of light and its full range, so that its gain can be read.
    assert np.all(pattern.mean((0, 1)) > 0.3)
    assert np.all(pattern.max((0, 1)) > 0.95) and np.all(pattern.min((0, 1)) < 0.05)
    assert np.array_equal(pattern, default_pattern(256))


def test_default_pattern_tells_its_orientation():
    pattern = default_pattern(64)
    turned = [np.rot90(p, k) for p in (pattern, mirrored(pattern)) for k in range(4)][1:]
    for other in turned:
        assert np.sqrt(np.mean((other - pattern) ** 2)) > pattern.std()


def test_default_pattern_holds_no_detail_that_the_ball_cannot_show():
    pattern = default_pattern(256)
    coarse = resize_pattern(resize_pattern(pattern, 16), 256)
    assert np.sqrt(np.mean((coarse - pattern) ** 2)) < 0.06


def test_callers_cannot_change_the_default():
    default_pattern(256)[:] = 0
    assert default_pattern(256).max() > 0.9


@pytest.mark.parametrize("size", [1, 7, 16, 100, 256, 300])
def test_resizing_keeps_the_mean(size):
    pattern = resize_pattern(block_pattern(256), size)
    assert pattern.shape == (size, size, 3)
    assert np.allclose(pattern.mean((0, 1)), block_pattern(256).mean((0, 1)), atol=2e-3)
    assert np.allclose(resize_pattern(np.full((9, 9, 3), 0.3), size), 0.3, atol=1e-6)
    wide = resize_pattern(block_pattern(256)[:, ::2], size)
    assert wide.shape == (size, size, 3)
    assert np.allclose(wide.mean((0, 1)), block_pattern(256).mean((0, 1)), atol=2e-3)


def test_resizing_up_is_bilinear_between_centres():
    ramp = np.repeat(np.array([0.0, 1.0])[None, :, None], 2, 0).repeat(3, 2)
    assert np.allclose(resize_pattern(ramp, 4)[0, :, 0], [0, 0.25, 0.75, 1])


# --- the criterion ------------------------------------------------------------------------------


def test_responses_add_up_to_the_render_of_any_pattern(responses):
    population = responses.population
    rng = np.random.default_rng(0)
    pattern = rng.uniform(0.02, 1, (SIDE, SIDE, 3))
    every = np.arange(len(population.x))
    direct = _shade(RIG, population, every, pattern, None, SAMPLES)
    summed = responses.screen @ pattern.reshape(-1, 3).astype(np.float32)
    assert np.abs(summed - direct).max() < 1e-3 * np.abs(direct).max()
    for row in range(4):  # value, ∂ρ, ∂s, ∂t
        scale = np.abs(direct[:, row]).mean()
        assert np.abs(summed[:, row] - direct[:, row]).mean() < 1e-3 * scale


def test_room_and_screen_add_up(responses):
    population = responses.population
    pattern = np.random.default_rng(1).uniform(0.02, 1, (SIDE, SIDE, 3))
    env = scale_environment(procedural_environment(3, 64), 0.5)
    every = np.arange(len(population.x))
    shade = lambda p, e: _shade(RIG, population, every, p, e, SAMPLES)[:, 0]  # noqa: E731
    both = shade(pattern, env)
    parts = shade(pattern, None) + shade(np.zeros_like(pattern), env)
    assert np.abs(both - parts).mean() < 1e-3 * np.abs(both).mean()


def test_gradient_is_the_derivative(criterion):
    rng = np.random.default_rng(2)
    pattern = rng.uniform(0.2, 0.8, (SIDE, SIDE, 3))
    _, gradient = criterion(pattern)
    for _ in range(3):
        d = rng.standard_normal(pattern.shape)
        h = 2e-3
        slope = (criterion(pattern + h * d)[0] - criterion(pattern - h * d)[0]) / (2 * h)
        assert slope == pytest.approx(float((gradient * d).sum()), rel=0.03, abs=1e-5)


def test_a_photo_never_makes_maps_less_certain(criterion):
    prior = np.sqrt(criterion.prior_mse)
    for pattern in (np.ones((SIDE, SIDE, 3)), wheel(SIDE)):
        errors = criterion.errors(pattern)
        assert all(0 < errors[m] < p for m, p in zip(NAMES, prior, strict=True))
        assert 0 < errors["criterion"] < 1


def test_brightness_alone_matters_little_colour_much(criterion):
    # Exposure follows the photo: a dimmer screen only changes how much of it the room is.
    white = np.ones((SIDE, SIDE, 3))
    full, half = (criterion.errors(white * k)["criterion"] for k in (1.0, 0.5))
    assert half == pytest.approx(full, rel=0.1)
    assert criterion.errors(wheel(SIDE))["criterion"] < 0.85 * full


def test_optimise_lowers_the_criterion_within_the_range_and_repeats(criterion):
    start = wheel(SIDE)
    found = optimise(criterion, start, iterations=12)
    assert criterion(found)[0] < criterion(start)[0] - 0.003
    assert found.min() >= DARKEST and found.max() <= 1
    assert np.array_equal(found, optimise(criterion, start, iterations=12))


def test_design_beats_what_it_is_compared_with_on_pixels_it_has_not_seen():
    steps: list[float] = []
    white = {"white": np.ones((SIDE, SIDE, 3))}
    found = design(
        RIG, white, groups=16, iterations=4, samples=16, cells=SIDE, rooms=1, progress=steps.append
    )
    assert found.pattern.shape == (SIDE, SIDE, 3)
    score = {k: e["criterion"] for k, e in found.errors.items()}
    assert score["optimised"] < 0.8 * score["white"]
    assert steps == sorted(steps) and steps[-1] <= 1


def test_population_is_seeded_and_in_range():
    a, b = draw_population(RIG, 50, 3), draw_population(RIG, 50, 3)
    assert np.array_equal(a.x, b.x) and np.array_equal(a.specular, b.specular)
    assert not np.array_equal(a.x, draw_population(RIG, 50, 4).x)
    assert len(a.x) == 50 * GROUP_PIXELS
    assert np.abs(a.x[:, :2]).max() <= RIG.sample_size / 2 and np.all(a.x[:, 2] == 0)
    assert a.normal[:, 2].min() > 0.7 and np.allclose(np.linalg.norm(a.normal, axis=1), 1)
    assert np.all((a.specular > 0) & (a.specular < 1) & (a.diffuse >= 0) & (a.diffuse <= 0.9))
    small = draw_population(replace(RIG, screen_size=0.1), 50, 3)
    assert np.abs(small.x).max() <= 0.025


@pytest.mark.slow
def test_shipped_pattern_scores_what_the_docs_say():
    held_out = Criterion(measure_responses(RIG, draw_population(RIG, 320, 3)))
    score = lambda p: held_out.errors(resize_pattern(p, 16))["criterion"]  # noqa: E731
    assert score(default_pattern()) == pytest.approx(0.380, abs=0.002)
    assert score(np.ones((16, 16, 3))) == pytest.approx(0.610, abs=0.002)


# --- the command --------------------------------------------------------------------------------


def run(*words: object) -> int:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    args = parser.parse_args(["pattern", *map(str, words)])
    return int(args.run(args, Console(quiet=True)))


def test_command_writes_both_handednesses(tmp_path):
    assert run("-o", tmp_path / "a.exr", "--size", 32) == 0
    assert run("-o", tmp_path / "b.png", "--size", 32, "--mirrored") == 0
    a, b = read_image(tmp_path / "a.exr"), read_image(tmp_path / "b.png")
    assert np.allclose(a, default_pattern(32), atol=1e-6)
    assert np.allclose(a[:, ::-1], b, atol=0.01)


@pytest.mark.parametrize(
    "words",
    [
        ("-o", "x.jpg"),
        ("-o", "missing/x.png"),
        ("-o", "x.png", "--size", 0),
        ("-o", "x.png", "--rig", "rig.toml"),
        ("-o", "x.pdf", "--rig", "missing.toml"),
        ("-o", "x.png", "--optimise", "--rig", "missing.toml"),
    ],
)
def test_command_refuses_bad_input(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError):
        run(*words)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_command_optimises_for_another_rig(tmp_path):
    write_rig(tmp_path / "rig.toml", replace(RIG, screen_size=0.24, screen_height=0.2))
    assert run("-o", tmp_path / "p.exr", "--optimise", "--rig", tmp_path / "rig.toml") == 0
    pattern = read_image(tmp_path / "p.exr")
    assert pattern.shape == (1024, 1024, 3)
    assert pattern.min() >= 0 and pattern.max() <= 1 and pattern.std() > 0.2


def test_png_for_a_device_has_its_size_and_is_mirrored(tmp_path):
    assert run("-o", tmp_path / "a.png", "--ppi", 100) == 0
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == (709, 709)  # 180 mm
        assert image.info["dpi"] == pytest.approx((100, 100), abs=0.01)
    assert np.allclose(read_image(tmp_path / "a.png")[:, ::-1], default_pattern(709), atol=0.01)


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("x.png", "--ppi", 0), "30 to 2000"),
        (("x.html", "--ppi", float("nan")), "30 to 2000"),
        (("x.png", "--ppi", 1999), "8192"),
        (("x.exr", "--ppi", 100), "for .png and .html"),
        (("x.html", "--size", 100), "--size is for"),
        (("x.pdf", "--mirrored"), "no pattern"),
        (("x.toml",), "for a --device"),
        (("x.html", "--device", "Nokia"), "known are: iPad"),
        (("x.html", "--device", "iPad mini", "--ppi", 300), "leave these out"),
    ],
)
def test_impossible_devices_are_refused(words, match, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=match):
        run("-o", *words)
    assert not list(tmp_path.iterdir())


def test_guide_is_two_pages_for_any_rig(tmp_path):
    second = ((279.4, 210), (210, 297))  # the capture sheet, or that there is none so large
    for size, rig in zip(second, (RIG, Rig(screen_size=0.5, screen_height=0.7)), strict=True):
        write_rig(tmp_path / "rig.toml", rig)
        out = tmp_path / "guide.pdf"
        assert run("-o", out, "--rig", tmp_path / "rig.toml") == 0
        pages = re.findall(rb"/MediaBox \[ *0 0 ([\d.]+) ([\d.]+)", out.read_bytes())
        millimetres = [[float(p) / 72 * 25.4 for p in page] for page in pages]
        assert millimetres == [pytest.approx((210, 297), abs=0.1), pytest.approx(size, abs=0.1)]
    # A 24 mm lens has a field of 71.6° across a 4:3 photo; the default sample needs 70° of it.
    assert needed_focal(RIG) == pytest.approx(23.6, abs=0.1)


@pytest.mark.parametrize(
    ("rig", "lengths"),
    [
        (Rig(), {"153", "34", "180", "90", "62"}),
        (Rig((0.228, 0.16), camera_height=0.2), {"153", "34", "228", "160", "80", "57", "200"}),
        (Rig(sample_side=0.06), {"153", "34", "180", "60", "47"}),
    ],
)
def test_the_guide_draws_the_rig_as_it_is(rig, lengths):
    figure = Figure()
    _guide(figure, rig)
    _, side, above = figure.axes
    numbers = {t.get_text() for axes in (side, above) for t in axes.texts}
    assert {n for n in numbers if n.isdigit()} == lengths
    drawn = [line.get_xydata() for line in above.lines]
    (width, depth), half = rig.screen_sides, rig.sample_size / 2
    for low, high in (
        ((half - rig.camera_offset - width, -depth / 2), (half - rig.camera_offset, depth / 2)),
        ((-half, -half), (half, half)),
    ):
        assert any(
            np.allclose(x.min(0), 1000 * np.array(low))
            and np.allclose(x.max(0), 1000 * np.array(high))
            for x in drawn
        )
    # 17.31 mm are half of the width of 4:3 with the diagonal of 36 × 24, of which 95% are used.
    reach = rig.optical_axis_x + half
    assert needed_focal(rig) == pytest.approx(17.31 * 0.95 * rig.camera[2] / reach, rel=1e-3)


def test_the_printed_sheet_is_the_one_that_is_looked_for():
    sheet, dots = capture_sheet(RIG), 200  # an inch
    x0, y0, x1, y1 = sheet.page
    figure = Figure(figsize=((x1 - x0) / INCH, (y1 - y0) / INCH), dpi=dots)
    canvas = FigureCanvasAgg(figure)
    _sheet(figure, sheet)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., 1]
    quads, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary()).detectMarkers(image)
    assert sorted(ids.ravel()) == sorted(sheet.ids)
    for number, quad in zip(ids.ravel(), quads, strict=True):
        at = (quad[0].mean(0) + 0.5) * INCH / dots * [1, -1] + [x0, y1]
        assert at == pytest.approx(sheet.corners[number - sheet.ids[0]].mean(0), abs=2e-4)


def test_page_is_one_file_of_the_rigs_size(tmp_path):
    write_rig(tmp_path / "rig.toml", replace(RIG, screen_size=0.15))
    assert run("-o", tmp_path / "a.html", "--rig", tmp_path / "rig.toml") == 0
    page = (tmp_path / "a.html").read_text()
    assert 'data-mm="150"' in page and "http" not in page.replace("http-equiv", "")


@pytest.mark.parametrize(
    ("name", "pixels"),
    [
        ("iPad Pro 11", (2420, 1668)),
        ("11-inch iPad Air", (2360, 1640)),
        ("ipad mini", (2266, 1488)),
        pytest.param('galaxy tab s9 ultra 14.6"', (2960, 1848), marks=pytest.mark.slow),
    ],
)
def test_tablets_are_known_by_name(name, pixels, tmp_path):
    tablet, _ = find_tablet(name)
    assert (tablet.long, tablet.short) == pixels
    assert run("--device", name, "-o", tmp_path / "rig.toml") == 0
    file = read_rig(tmp_path / "rig.toml")
    assert file.fov_from == "unknown" and len(file.unknown) == 2
    assert file.rig.screen_sides == pytest.approx(tablet.sides, abs=1e-4)
    assert file.rig.sample_size == pytest.approx(tablet.sides[1] / 2, abs=1e-4)
    assert capture_sheet(file.rig).paper == "A4 or Letter" or "14.6" in tablet.name
    assert run("--device", name, "-o", tmp_path / "a.png") == 0
    with Image.open(tmp_path / "a.png") as image:
        assert image.size == pytest.approx(pixels, abs=1)


def test_every_tablet_is_as_large_as_its_name_says():
    for tablet in TABLETS:
        inches = re.findall(r"([\d.]+)″", tablet.name)
        diagonal = np.hypot(*tablet.sides) / INCH
        # Makers round, and one panel has two names.
        assert min(abs(diagonal - float(i)) for i in inches) < 0.2, tablet
        assert tablet.long > tablet.short


def test_page_fills_the_display_and_warns_of_what_disturbs_it(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    path = tmp_path / "a.html"
    path.write_text(pattern_page(default_pattern(), (0.2, 0.1), 110))
    page = Page(1000, 600)
    try:
        page.open(path)
        assert page.js('at("metres").textContent') == "[0.2000, 0.1000]"
        page.js("document.documentElement.requestFullscreen = undefined")
        page.js("window.lock = { release() {} }")
        page.js("navigator.wakeLock.request = async () => { window.asked = 1; return lock }")
        page.js('at("show").click()')
        box = "(e => [e.left, e.width, e.height])(at('pattern').getBoundingClientRect())"
        wanted = [0, round(200 / 25.4 * 110), round(100 / 25.4 * 110)]
        assert page.js(box) == pytest.approx(wanted, abs=1) and page.js("asked") == 1
        page.js('at("pattern").click()')
        page.js('at("fill").click()')
        wide, high = page.js("display()")
        assert page.js("[state.side, state.deep]") == pytest.approx(
            [wide / 110 * 25.4, high / 110 * 25.4], abs=0.1
        )
        assert not page.js('at("show").disabled')
        # A tablet by name; a page that the browser zooms, or shows in a part of the display.
        page.js("Object.defineProperty(screen, 'width', { get: () => 1.15 * innerWidth })")
        page.js("Object.defineProperty(screen, 'height', { get: () => 1.15 * innerHeight })")
        page.js("state.side = state.deep = 50; layout(); show()")
        time.sleep(0.5)
        assert "zoom to 100%" in page.js('at("trouble").textContent')
        assert page.js('getComputedStyle(at("panel")).display') != "none"
        page.js("show()")  # a person may know better
        time.sleep(0.5)
        assert page.js("body.className") == "shown"
        page.js('hide(); at("tablet").value = "326"')
        page.js('at("tablet").dispatchEvent(new Event("change"))')
        assert page.js("state.ppi") == 326 and page.js('at("zoomed").hidden')
        text = page.js("document.body.textContent")
        assert all(word in text for word in ("Night Shift", "True Tone", "Full brightness"))
        assert not page.problems
    finally:
        page.close()


def test_page_shows_the_pattern_in_real_size(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    path = tmp_path / "a.html"
    path.write_text(pattern_page(default_pattern(), 0.18))
    page = Page(1300, 950)
    try:
        page.open(path)
        box = "(e => [e.left, e.top, e.width, e.height])({}.getBoundingClientRect())"
        page.js("setPpi(110)")
        card = page.js(box.format('at("card")'))
        assert card[2:] == pytest.approx([85.6 / 25.4 * 110, 53.98 / 25.4 * 110], abs=1)
        page.js('at("show").click()')
        x, y, w, h = page.js(box.format('at("pattern")'))
        assert x == 0 and w == h == round(180 / 25.4 * 110)
        assert y == pytest.approx((page.js("innerHeight") - h) / 2, abs=1)
        # Right side of the screen, mirrored: what it shows at its left is the pattern's right.
        page.screenshot(tmp_path / "a.png")
        seen = read_image(tmp_path / "a.png")
        assert np.allclose(seen[:, w + 2 :], 0)
        middle = seen[int(y) : int(y) + h, :w]
        assert np.abs(middle[:, ::-1] - default_pattern(w)).mean() < 0.01
        page.js('at("pattern").click()')
        assert page.js('getComputedStyle(at("panel")).display') != "none"
        # It remembers the scale, and says when the pattern does not fit.
        page.open(path)
        assert page.js("state.ppi") == 110
        page.js("setPpi(300)")
        assert page.js('at("show").disabled') and "too large" in page.js('at("fits").textContent')
        # A browser may refuse full screen without a touch.
        assert not [p for p in page.problems if "requestFullscreen" not in str(p)]
    finally:
        page.close()


def test_a_set_is_stepped_through_by_taps_or_by_a_timer(tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    path = tmp_path / "a.html"
    first, *rest = pattern_set(3, 16)
    path.write_text(pattern_page(first, 0.1, 110, rest=rest))
    page = Page(1000, 800)
    try:
        page.open(path)
        page.js("document.documentElement.requestFullscreen = undefined")
        page.js("window.setInterval = (f, after) => { window.tick = f; window.after = after }")
        page.js('at("show").click()')
        page.js('at("pattern").click()')
        assert page.js("[step, window.after === undefined]") == [1, True]  # by taps alone
        page.js('hide(); at("every").value = "2.5"; at("show").click()')
        assert page.js("[step, after]") == [0, 2500]
        page.js("tick(); tick()")
        assert page.js('[step, at("pattern").src === shown[2]]') == [2, True]
        assert page.js("body.className") == "shown"
        page.js("tick()")
        assert page.js("[step, body.className]") == [0, ""]
    finally:
        page.close()


def test_the_best_set_is_better_than_what_it_is_chosen_from(criterion):
    named = candidates(SIDE, resize_pattern(default_pattern(), SIDE))
    pair, three = (best_set(criterion, named, n, "default 0") for n in (2, 3))
    assert pair[0] == three[0] == "default 0" and len(set(three)) == 3
    score = lambda names: set_errors(criterion, [named[n] for n in names])["criterion"]  # noqa: E731
    assert score(three) < score(pair) < score(["default 0"])
    assert all(score(pair) <= score(["default 0", name]) + 1e-9 for name in named)
