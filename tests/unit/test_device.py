import numpy as np
import pytest

from invrender.capture.lights import find_lights
from invrender.files.capture import load_capture
from invrender.lights import Device
from invrender.types import InputError

PATTERN = np.random.default_rng(0).uniform(0, 1, (3, 5, 3)).astype(np.float32)


def test_an_ideal_display_shows_the_pattern_itself():
    assert Device().shown(PATTERN) is PATTERN
    assert Device(falloff=1.0).shown(PATTERN) is PATTERN


def test_curve_then_black_then_mixing():
    """Numbers by hand: 0.5² = 0.25; 0.25 · 0.9 + 0.1 = 0.325; a tenth of red goes to green."""
    mixing = ((0.9, 0.0, 0.0), (0.1, 1.0, 0.0), (0.0, 0.0, 1.0))
    device = Device(gamma=(2.0, 1.0, 1.0), black=0.1, mixing=mixing)
    shown = device.shown(np.array([[[0.5, 0.0, 1.0]]]))
    np.testing.assert_allclose(shown[0, 0], [0.9 * 0.325, 0.1 + 0.1 * 0.325, 1.0], rtol=1e-6)


def test_dimming_is_a_power_of_the_cosine():
    assert Device(falloff=0.5).dimming(0.25) == 0.5
    np.testing.assert_array_equal(Device().dimming(np.array([0.1, 1.0])), 1.0)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("falloff", -0.1, "falloff must lie"),
        ("falloff", float("nan"), "finite"),
        ("gamma", (1.0, 1.0), "number of values"),
        ("gamma", (0.0, 1.0, 1.0), "gamma must lie"),
        ("black", 1.0, "below 1"),
        ("mixing", ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)), "without light"),
        ("mixing", ((1.0, -0.1, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), "not be negative"),
    ],
)
def test_what_no_display_does_is_refused(field, value, message):
    with pytest.raises(InputError, match=message):
        Device(**{field: value})


def test_a_display_that_rig_toml_tells_is_the_lights(capture):
    """Its curve and black are in the pattern, its dimming stays with lights that are given."""
    plain = load_capture(capture)
    rig = capture / "rig.toml"
    rig.write_text(rig.read_text() + "\n[device]\nfalloff = 0.7\ngamma = 1.5\nblack = 0.01\n")
    told = load_capture(capture)
    expected = Device(gamma=(1.5, 1.5, 1.5), black=0.01).shown(plain.pattern)
    np.testing.assert_allclose(told.pattern, expected, atol=1e-6)
    lights = find_lights(told, environment=np.zeros((8, 16, 3)), gain=1.0).lights
    assert lights.device == Device(falloff=0.7)
    assert plain.device == Device()
