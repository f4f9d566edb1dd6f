"""Importing and asking for help loads nothing heavy, and takes little longer than Python itself."""

import subprocess
import sys
import time

import pytest

HEAVY = {
    "torch", "kornia", "drjit", "mitsuba", "matplotlib", "scipy", "skimage", "numpy", "PIL",
    "OpenEXR", "jinja2", "rich", "cv2", "nets",
}  # fmt: skip
HELP = "import runpy, sys; sys.argv[1:] = ['--help']; runpy.run_module('invrender')"


def run(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def seconds(code):
    """The least of five, of a whole process."""
    times = []
    for _ in range(5):
        began = time.perf_counter()
        run(code)
        times.append(time.perf_counter() - began)
    return min(times)


LISTED = "; import sys; print(sorted({m.split('.')[0] for m in sys.modules}))"


@pytest.mark.parametrize(
    "code",
    [
        "import invrender" + LISTED,
        "import atexit, sys\n"
        "atexit.register(lambda: print(sorted({m.split('.')[0] for m in sys.modules})))\n" + HELP,
    ],
    ids=["import", "help"],
)
def test_nothing_heavy_is_loaded(code):
    loaded = set(eval(run(code).splitlines()[-1]))
    assert "invrender" in loaded and not loaded & HEAVY


def test_start_is_as_quick_as_pythons():
    """Where that takes 0.1 s: at most 0.3 s for the package, 0.5 s for the help."""
    bare = seconds("pass")
    assert seconds("import invrender") < 4 * bare
    assert seconds(HELP) < 6 * bare


def test_small_parts_load_small_parts():
    """Types bring no Dr.Jit and no torch; a capture is read without them."""
    code = (
        "from invrender import Capture, InputError, Lights, Maps, Rig, find_lights, load_capture"
        + LISTED
    )
    assert not set(eval(run(code))) & {
        "torch",
        "kornia",
        "drjit",
        "mitsuba",
        "matplotlib",
        "cv2",
        "nets",
    }
