"""The wheel, installed outside the clone: all it needs is in it, and its types are seen."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


def run(*words, cwd):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [*map(str, words)], cwd=cwd, env=environment, capture_output=True, text=True
    )


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder that holds ``env``, a virtual environment with the wheel in it; what the package
    depends on comes from the environment that runs the tests."""
    folder = tmp_path_factory.mktemp("package")
    source = folder / "source"
    ignore = shutil.ignore_patterns("__pycache__")
    for name in ("invrender", "nets"):
        shutil.copytree(ROOT / name, source / name, ignore=ignore)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    built = run(*pip, "wheel", "-q", "--no-deps", "-w", folder, source, cwd=folder)
    if built.returncode and "No matching distribution" in built.stderr:
        pytest.skip("pip cannot fetch setuptools to build a wheel")
    assert built.returncode == 0, built.stderr
    venv.create(folder / "env")
    site = Path(sysconfig.get_path("purelib", vars={"base": folder / "env"}))
    # By this file, editable installations over there are not seen.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    (wheel,) = folder.glob("*.whl")
    python = folder / "env" / "bin" / "python"
    done = run(*pip, "--python", python, "install", "-q", "--no-deps", wheel, cwd=folder)
    assert done.returncode == 0, done.stderr
    shutil.rmtree(source)
    return folder


def test_commands_find_their_data(installed):
    command = installed / "env" / "bin" / "invrender"
    assert "refine" in run(command, "--help", cwd=installed).stdout
    for words in (
        ["refine", "example", "-o", "out", "--size", "16", "-q"],
        ["pattern", "-o", "pattern.html"],
    ):
        done = run(command, *words, cwd=installed)
        assert done.returncode == 0, done.stderr
    python = installed / "env" / "bin" / "python"
    where = "import invrender, nets; print(invrender.__file__, nets.__file__)"
    assert run(python, "-c", where, cwd=installed).stdout.count(str(installed)) == 2


def test_the_app_finds_its_page(installed):
    """All that the page loads is in the wheel."""
    python = installed / "env" / "bin" / "python"
    program = (
        "from importlib.resources import files as f\n"
        "import invrender.app.serve\n"
        "page = {p.name for p in (f('invrender.app') / 'page').iterdir()}\n"
        "assert {'index.html', 'app.css', 'app.js', 'icon.svg', 'tablet.js'} <= page, page\n"
        "assert (f('invrender.report') / 'templates' / 'viewer.js').is_file()\n"
    )
    done = run(python, "-c", program, cwd=installed)
    assert done.returncode == 0, done.stderr
    help = run(installed / "env" / "bin" / "invrender", "app", "--help", cwd=installed)
    assert "--lan" in help.stdout


def test_types_are_seen_from_outside(installed):
    (installed / "use.py").write_text(
        "from invrender.rig import Rig\nreveal_type(Rig().sample_size)\nRig(screen_size='large')\n"
    )
    python = installed / "env" / "bin" / "python"
    words = [sys.executable, "-m", "mypy", "--python-executable", python, "use.py"]
    found = run(*words, cwd=installed).stdout
    assert 'Revealed type is "float"' in found
    assert 'has incompatible type "str"; expected "float' in found
    assert "py.typed" not in found and "Found 1 error" in found
