"""report.html: complete, small, quick, safe; its viewer draws what Python renders."""

import base64
import hashlib
import io
import re
import time
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from benchmarks.common.chromium import CHROMIUM, Page
from invrender.colour import linear_to_srgb, srgb_to_linear
from invrender.data.materials import procedural_material
from invrender.maps import NAMES, Maps
from invrender.report.page import report_html
from invrender.report.report import Report
from invrender.rig import Rig
from invrender.types import Notice

SIZE = 64
EVIL = '"><script>alert(1)</script><img src=x onerror=alert(2)>'
REPORT = Report(
    status="done",
    capture=EVIL, size=SIZE, init="flat", sample_size=0.09,
    seconds={"read": 0.1, "refine": 2.0}, photo_error={"initial": 0.5, "refined": 0.1},
    converged=True, history=[{"seconds": 1.0, "photo_error": 0.2}],
    capture_fit={"ball_centre": [1, 2], "ball_radius": 3, "ball_confidence": 0.9,
                 "gain": [1, 2, 3], "residual": 0.01},
    warnings=[Notice("evil", f"the ball's rim is clipped {EVIL}")],
    map_error={k: {n: 0.1 for n in (*NAMES, "average")} for k in ("initial", "refined")},
    versions={"invrender": "0", EVIL: EVIL},
)  # fmt: skip


def page_of(maps, environment=None, report=REPORT):
    rng = np.random.default_rng(0)
    size = maps.shape[0]
    sigma = {n: rng.uniform(0, 0.2, (size, size)).astype(np.float32) for n in NAMES}
    if environment is None:
        environment = rng.gamma(0.3, 1, (32, 64, 3)).astype(np.float32)
        environment[16:] = 0
    photo = rng.uniform(0, 2, (size, size, 3)).astype(np.float32)
    pattern = rng.uniform(0, 1, (16, 16, 3)).astype(np.float32)
    return report_html(report, maps, sigma, environment, pattern, photo, photo * 1.1)


@pytest.fixture(scope="module")
def maps():
    """Relief, polished and rough places, metal and not."""
    rng = np.random.default_rng(3)
    maps = procedural_material(3, SIZE, SIZE, kind="rusty_metal")
    rough = np.geomspace(0.05, 1, SIZE * SIZE).reshape(SIZE, SIZE)
    slopes = rng.normal(0, 0.15, (SIZE, SIZE, 2))
    normal = np.dstack([slopes, np.ones((SIZE, SIZE))])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    # Albedos as the page holds them: bytes of sRGB.
    diffuse, specular = (
        srgb_to_linear(np.rint(linear_to_srgb(x) * 255) / 255)
        for x in (maps.diffuse, maps.specular)
    )
    return Maps(diffuse, specular, rough.astype(np.float32), normal.astype(np.float32))


class Tags(HTMLParser):
    """The tags of a page with their attributes."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, attrs))


def test_complete_in_itself_and_escaped(maps):
    page = page_of(maps)
    assert "http://" not in page and "https://" not in page
    tags = Tags()
    tags.feed(page)
    links = [v for _, attributes in tags.found for k, v in attributes if k in ("src", "href")]
    assert len(links) > 10 and all(v.startswith("data:") for v in links)
    assert not [k for _, attributes in tags.found for k, _ in attributes if k.startswith("on")]
    assert [dict(a).get("type") for t, a in tags.found if t == "script"] == [
        "application/json",
        None,
    ]
    # The policy lets only the page's own script run, whatever else got in.
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.S)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page
    assert "default-src 'none'" in page


@pytest.mark.parametrize(("size", "seconds"), [(256, 2), (1024, 6)])
def test_quick_and_small(size, seconds):
    rng = np.random.default_rng(1)
    noise = rng.uniform(0, 1, (size, size, 3)).astype(np.float32)  # the worst to compress
    normal = np.dstack([noise[..., :2] - 0.5, np.ones((size, size), np.float32)])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    maps = Maps(noise, noise[::-1].copy(), noise[..., 0], normal)
    began = time.process_time()
    page = page_of(maps)
    assert time.process_time() - began < seconds
    assert len(page) < 10e6


def test_dark_room_and_no_truth(maps):
    dark = np.zeros((32, 64, 3), np.float32)
    report = replace(REPORT, map_error=None, history=[], warnings=[])
    page = page_of(maps, dark, report)
    assert '"room": null' in page and "ground truth" not in page


@pytest.fixture(scope="module")
def page(maps, tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(page_of(maps), encoding="utf-8")
    page = Page(1000, 1100)
    yield page if ready(page, path) else None
    page.close()


def ready(page, path):
    page.open(path)
    until = time.monotonic() + 60
    while page.js("document.documentElement.dataset.viewer") != "ready":
        assert time.monotonic() < until, page.js(
            "document.getElementById('viewer-note').textContent"
        )
        time.sleep(0.1)
    return True


def pixels(page, size, view="{}", **state):
    """(size, size, 3) bytes of the canvas, row 0 at the top."""
    settings = "".join(f"viewer.state.{k} = {v!r};" for k, v in state.items())
    # In one go, since the page sets the canvas' size itself when it draws later.
    text = page.js(
        f"{settings} viewer.canvas.width = viewer.canvas.height = {size};"
        f"btoa(viewer.pixels({view}).reduce((s, b) => s + String.fromCharCode(b), ''))"
    )
    data = np.frombuffer(base64.b64decode(text), np.uint8)
    return data.reshape(size, size, 4)[::-1, :, :3].astype(int)


def test_loads_without_a_complaint(page):
    assert page.problems == []
    assert page.js("document.title").startswith('"><script>')


def test_each_pixel_is_our_brdf(page, maps):
    """The camera and a light of the rig: what `relight` renders, within one byte."""
    from invrender.render.point_lights import relight

    rig = Rig()
    half = rig.sample_size / 2
    lights = np.array([[0.03, -0.02, 0.15], [-0.04, 0.045, 0.05]])
    expected = linear_to_srgb(0.5 * relight(maps, rig, lights)) * 255
    seen = 0
    for light, image in zip(lights, expected, strict=True):
        # relight's power is for the screen's height.
        power = 0.5 * np.pi * (rig.screen_height / half) ** 2
        eye = (rig.camera / half).tolist()
        view = f"{{eye: {eye}, reach: 1, lamp: {(light / half).tolist()}, power: {power}}}"
        drawn = pixels(page, SIZE, view, shape="plane", room=0, power=1, exposure=0)
        seen += np.count_nonzero((image > 5) & (image < 250))
        assert np.abs(drawn - np.rint(image)).max() <= 1
    assert seen > SIZE * SIZE


def test_room_of_constant_light(tmp_path):
    """Under a uniform sky the room's light is the BRDF's integral over the hemisphere."""
    from invrender.render.backend import Float, vector
    from invrender.render.point_lights import reflect
    from invrender.render.renderer import Material
    from invrender.sphere import directions, solid_angles

    if CHROMIUM is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    sky = np.ones((32, 64, 3), np.float32)
    sky[16:] = 0
    d = directions(256, 512)[:128].reshape(-1, 3)
    weight = np.repeat(solid_angles(256, 512)[:128], 512)
    vec3 = vector(Float, 3)
    l = vec3(d.T)
    roughness = [0.3, 0.5, 0.9]
    k_d, k_s = 0.2, 0.5
    one = np.ones((len(roughness), len(roughness), 3), np.float32)
    rows = np.array(roughness, np.float32)[:, None] * np.ones((1, 3), np.float32)
    maps = Maps(k_d * one, k_s * one, rows, np.float32([0, 0, 1]) * one)
    path = tmp_path / "report.html"
    path.write_text(page_of(maps, sky), encoding="utf-8")
    page = Page()
    try:
        ready(page, path)
        drawn = pixels(page, 3, "{reach: 1, eye: [0, 0, 1000]}", room=1.0, power=0)[:, 1, 0]
    finally:
        page.close()
    for rough, byte in zip(roughness, drawn, strict=True):
        material = Material(vec3(k_d), vec3(k_s), Float(rough), vec3(0, 0, 1))
        light = np.asarray(reflect(material, l, vec3(0, 0, 1)))[0] @ weight
        assert byte == pytest.approx(255 * linear_to_srgb(np.array(light)), abs=3)


def shot(page, tmp_path):
    """The canvas as the screen shows it, (H, W, 3) bytes."""
    page.js("scrollTo(0, 0)")
    page.screenshot(tmp_path / "shot.png")
    box = box_of(page)
    with Image.open(io.BytesIO((tmp_path / "shot.png").read_bytes())) as image:
        return np.asarray(image.convert("RGB").crop(box)).astype(int)


def box_of(page):
    return page.js(
        "(() => { const b = viewer.canvas.getBoundingClientRect();"
        "return [b.left, b.top, b.right, b.bottom].map(Math.round); })()"
    )


def test_dragging_moves_the_lamp(page, tmp_path):
    page.js("Object.assign(viewer.state, {shape: 'sphere', room: 0.5, power: 1})")
    page.js("viewer.draw()")
    left, top, right, bottom = box_of(page)
    at = lambda x, y: (left + x * (right - left), top + y * (bottom - top))  # noqa: E731
    images = []
    for end in (0.3, 0.3), (0.75, 0.7):
        page.drag(at(0.5, 0.5), at(*end))
        time.sleep(1)  # the last drawing is a quarter of a second after the last movement
        images.append(shot(page, tmp_path))
    first, second = images
    assert first.std() > 15 and second.std() > 15  # not blank
    h, w = first.shape[:2]
    place = lambda x: x.sum(-1)[: h // 2, : w // 2].mean() - x.sum(-1)[h // 2 :, w // 2 :].mean()  # noqa: E731
    assert place(first) > place(second) + 30  # the bright side went along
    turn = page.js("viewer.state.turn")
    page.drag(at(0.5, 0.5), at(0.6, 0.5), button="right")
    assert page.js("viewer.state.turn") != turn
    # What the screen shows is what was drawn.
    time.sleep(1)
    now = shot(page, tmp_path)
    size = page.js("viewer.canvas.width")
    drawn = Image.fromarray(pixels(page, size).astype(np.uint8)).resize((w, h), Image.BOX)
    inside = np.s_[10:-10, 10:-10]
    difference = np.abs(np.asarray(drawn).astype(int) - now)[inside]
    assert np.median(difference) <= 2 and difference.mean() < 6


def test_maps_one_by_one(page, maps):
    for name in NAMES:
        image = maps.encoded()[name]
        image = linear_to_srgb(image) if name in ("diffuse", "specular") else image
        image = image if image.ndim == 3 else image[..., None]
        view = "{reach: 1, eye: [0, 0, 1000]}"
        drawn = pixels(page, SIZE, view, shape="plane", show=name, turn=[0, 0])
        assert np.abs(drawn - image * 255).max() <= 1.5
    page.js("viewer.state.show = 'material'")


def folds(x, y):
    """The cloth's height."""
    at = [3.1 * x + 1.3 * y, -1.9 * x + 4.3 * y + 1, 6.7 * x - 5.2 * y + 2]
    return np.tensordot([0.1, 0.06, 0.018], np.sin(at), 1) - 0.1


def covered(shape, size, yaw, pitch):
    """Which pixels (size, size) show the shape, found by many small steps along each ray."""
    c, s, k, z = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    turn = np.array([[c, 0, s], [z * s, k, -z * c], [-k * s, z, k * c]])  # object to world
    q = ((np.arange(size) + 0.5) / size * 2 - 1) * 1.15
    x, y = np.meshgrid(q, -q)
    d = np.stack([x, y, np.full_like(x, -4)], -1) @ turn  # from the eye, in the object's axes
    o = np.array([0, 0, 4]) @ turn
    if shape == "sphere":
        b, dd = d @ o, (d**2).sum(-1)
        return b**2 > dd * (o @ o - 1)
    height = folds if shape == "cloth" else lambda x, y: 0 * x
    with np.errstate(divide="ignore"):
        near, far = (
            (h - o[2]) / d[..., 2] for h in ((0.08, -0.28) if shape == "cloth" else (1e-6, -1e-6))
        )
    t = near + (far - near) * np.linspace(0, 1, 400)[:, None, None]
    p = o[:, None, None, None] + t * np.moveaxis(d, -1, 0)[:, None]
    first = (p[2] <= height(p[0], p[1])).argmax(0)[None]
    place = np.abs(np.take_along_axis(p[:2], first[None], 1))[:, 0].max(0)
    return (d[..., 2] < 0) & (near > 0) & (place <= 1)


@pytest.mark.parametrize("shape", ["plane", "sphere", "cylinder", "cloth"])
def test_every_shape_is_where_it_is_from_every_side(page, shape):
    """Cylinders are closed, so that they are never a background; planes have no back."""
    for yaw, pitch in ((0, 0), (0.5, 0.4), (-0.9, -0.8), (-1.2, 1.0), (3.0, -0.7)):
        image = pixels(page, 96, shape=shape, turn=[yaw, pitch], room=0.5, power=1, show="material")
        shown = np.abs(image - [14, 15, 17]).max(-1) > 1
        if shape == "cylinder":
            assert shown.mean() > 0.3
        else:
            assert (shown == covered(shape, 96, yaw, pitch)).mean() > 0.99
    assert page.problems == []
