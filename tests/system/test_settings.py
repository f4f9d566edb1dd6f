"""Settings nobody should give: each is refused in one sentence, or the result is a sound one."""

import contextlib
import io
import json
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from synthetic_photo import blocks, photograph

from invrender.cli.main import main
from invrender.files.capture import load_capture
from invrender.files.rig_toml import _FILES, _KEYS, write_rig
from invrender.files.write import write_exr
from invrender.rig import Rig
from invrender.types import InputError

QUICK = {"deadline": None, "suppress_health_check": list(HealthCheck)}
NUMBER = st.one_of(
    st.floats(), st.floats(1e-4, 200), st.integers(-3, 10**19),
    st.sampled_from([0, -0.0, 1e-300, 1e300, 5e-324, 90, 180, 360, -1]),
)  # fmt: skip
VALUE = st.one_of(
    NUMBER, NUMBER, st.lists(NUMBER, max_size=4), st.text(max_size=8), st.booleans(),
    st.lists(st.floats(-20, 20), min_size=3, max_size=3),
    st.lists(st.text(max_size=2), min_size=3, max_size=3),
)  # fmt: skip
KEY = st.one_of(
    st.sampled_from([*_KEYS, *sorted(_FILES)]),
    st.tuples(st.sampled_from(["screen", "camera", "ball", "lens", ""]), st.text(max_size=6)),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture in miniature, whose ball has a radius of eight pixels."""
    path = tmp_path_factory.mktemp("settings")
    image = photograph(Rig(), 144, 192, pattern=blocks(8, 16))
    write_exr(path / "photo.exr", image)
    write_exr(path / "pattern.exr", blocks(8, 16))
    return path


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A capture whose photo has no ball, which is soon seen."""
    path = tmp_path_factory.mktemp("tiny")
    write_exr(path / "photo.exr", photograph(Rig(), 36, 48, ball=None))
    write_exr(path / "pattern.exr", blocks(8, 16))
    write_rig(path / "rig.toml", Rig(), "pattern.exr")
    return path


def toml(value):
    """A value as TOML; nan, inf and -0.0 are TOML's own words."""
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value) if isinstance(value, (str, bool)) else repr(value)


def write(folder, changes):
    """``rig.toml`` with those entries instead of the usual ones, or beside them."""
    entries = {
        ("screen", "size"): 0.18, ("screen", "height"): 0.153, ("camera", "offset"): 0.017,
        ("camera", "fov"): 73.7, ("ball", "radius"): 0.0095, ("pattern", "image"): "pattern.exr",
    }  # fmt: skip
    sections = {}
    for (section, key), value in {**entries, **changes}.items():
        sections.setdefault(section, []).append(f"{json.dumps(key)} = {toml(value)}")
    lines = [line for s, e in sections.items() for line in (f"[{json.dumps(s)}]", *e)]
    (folder / "rig.toml").write_text("\n".join(lines), encoding="utf-8")


def run(*arguments):
    """Exit code and standard error of the command."""
    error = io.StringIO()
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main([str(a) for a in arguments])
        except SystemExit as stop:  # argparse
            code = stop.code
    return code, error.getvalue()


def one_sentence(text):
    return text.startswith(("invrender:", "usage:")) and "Traceback" not in text


@settings(max_examples=100, **QUICK)
@given(st.dictionaries(KEY, VALUE, min_size=1, max_size=3))
@example({("pattern", "image"): "\0"})
@example({("pattern", "image"): 5000 * "a"})
@example({("camera", "tilt"): [90.0, 0.0, 0.0]})
@example({("camera", "tilt"): 1e300})
@example({("screen", "size"): 1e300})
@example({("ball", "radius"): 5e-324})
@example({("camera", "shift"): [0.0, 0.0, -0.153]})
def test_a_rig_is_refused_or_its_geometry_is_finite(folder, changes):
    write(folder, changes)
    try:
        rig = load_capture(folder).rig
    except InputError as error:
        assert "\n" not in str(error).strip()
        return
    rays = rig.rays(np.array([[0.5, 0.5], [96, 72], [191.5, 143.5]]), 144, 192)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-6)
    seen = rig.project(rig.camera + rays, 144, 192)
    np.testing.assert_allclose(seen, [[0.5, 0.5], [96, 72], [191.5, 143.5]], atol=1e-3)
    with np.errstate(over="raise", invalid="raise"):
        assert np.isfinite(rig.screen_cosines(rig.sample_points(3, 3), 4)).all()


@settings(max_examples=25, **QUICK)
@given(st.dictionaries(st.sampled_from(list(_KEYS)), VALUE, min_size=1, max_size=2))
@example({("camera", "tilt"): [37.0, 0.0, 0.0]})  # past the ball
@example({("camera", "tilt"): [66.0, 0.0, 0.0]})
@example({("screen", "size"): 89})  # a sample beyond the photo
def test_inspect_refuses_a_rig_or_reads_the_lights(folder, changes):
    write(folder, changes)
    code, error = run("inspect", folder, "--json")
    assert code == 0 or (code == 2 and one_sentence(error)), error


@settings(max_examples=10, **QUICK)
@given(
    st.one_of(
        st.tuples(*[st.one_of(st.floats(), st.floats(0, 200), st.sampled_from([96, 72, 8]))] * 3),
        st.tuples(st.floats(90, 102), st.floats(66, 78), st.floats(2, 20)),
    )
)
@example((96.0, 72.0, 7.9))
@example((96.0, 72.0, 1e-9))
@example((math.nan, 72.0, 8.0))
def test_any_ball_by_hand(folder, ball):
    write_rig(folder / "rig.toml", Rig(), "pattern.exr")
    code, error = run("inspect", folder, "--json", f"--ball={','.join(map(repr, ball))}")
    assert code == 0 or (code == 2 and one_sentence(error)), error


@settings(max_examples=8, **QUICK)
@given(
    st.sampled_from(["--size", "--samples", "--gain", "--ball", "--environment"]),
    st.one_of(NUMBER.map(repr), st.text(max_size=6), st.sampled_from(["none", "1,2", "0,0,0"])),
)  # fmt: skip
@example("--size", "0")
@example("--size", "-5")
@example("--size", "100000000")
@example("--samples", "0")
@example("--gain", "nan")
def test_refine_refuses_what_cannot_be(tiny, tmp_path_factory, option, value):
    """The photo is too small to refine in earnest: nothing is written unless all was well."""
    assume("\0" not in value)
    folder = tiny
    out = tmp_path_factory.mktemp("out") / "result"
    code, error = run("refine", folder, "-o", out, "--init=flat", f"{option}={value}")
    assert code == 2 and one_sentence(error), error
    assert not out.exists()
