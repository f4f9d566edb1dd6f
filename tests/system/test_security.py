"""Captures come from strangers: no code in files, no file outside the folder, no bombs.

HTML that strangers write is tested in test_report.py, names in exports in test_export.py.
"""

import ast
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from invrender.files.capture import load_capture
from invrender.types import InputError

ROOT = Path(__file__).parents[2]
SOURCES = [p for part in ("invrender", "nets") for p in sorted((ROOT / part).rglob("*.py"))]


def names(tree):
    """Dotted names of what a module imports and calls."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
        elif isinstance(node, ast.Call):
            yield ast.unparse(node.func)


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_code_is_read_from_files(path):
    """No pickle, no eval, no shell."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = set(names(tree))
    bad = {"pickle", "dill", "joblib", "marshal", "shelve", "eval", "exec", "torch.load",
           "np.load", "os.system", "yaml.load", "subprocess"}  # fmt: skip
    assert not found & bad


def rewrite(folder, old, new):
    path = folder / "rig.toml"
    path.write_text(path.read_text().replace(old, new))


@pytest.mark.parametrize("name", ["../secret.exr", "/etc/passwd", "a/../../secret.exr"])
def test_no_path_leaves_the_folder(capture, name):
    shutil.copy(capture / "pattern.exr", capture.parent / "secret.exr")
    (capture / "a").mkdir()
    rewrite(capture, "pattern.exr", name)
    with pytest.raises(InputError, match="leads out"):
        load_capture(capture)


def test_no_truth_from_outside(capture):
    shutil.copytree(capture / "truth", capture.parent / "truth")
    rewrite(capture, '"truth', '"../truth')
    with pytest.raises(InputError, match="leads out"):
        load_capture(capture)


def test_no_link_leaves_the_folder(capture):
    (capture / "pattern.exr").rename(capture.parent / "secret.exr")
    (capture / "pattern.exr").symlink_to(capture.parent / "secret.exr")
    with pytest.raises(InputError, match="leads out"):
        load_capture(capture)


def bomb():
    """A PNG of 60,000 × 60,000 pixels in a few hundred bytes."""

    def chunk(name, data):
        return (
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        )

    head = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    data = zlib.compress(b"\0" * 100_000, 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("name", ["photo", "pattern"])
def test_bombs_are_refused_by_size(capture, name):
    (capture / f"{name}.exr").unlink()
    (capture / f"{name}.png").write_bytes(bomb())
    rewrite(capture, "pattern.exr", "pattern.png" if name == "pattern" else "pattern.exr")
    with pytest.raises(InputError, match="pixels"):
        load_capture(capture)


def test_a_huge_exr_is_refused_by_its_header(capture):
    import OpenEXR

    path = capture / "photo.exr"
    with OpenEXR.File(
        {"compression": OpenEXR.ZIP_COMPRESSION}, {"RGB": np.zeros((64, 64, 3), np.float32)}
    ) as f:
        f.write(str(path))
    blob = path.read_bytes()
    for window in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        at = blob.index(window) + len(window) + 4
        blob = blob[:at] + struct.pack("<4i", 0, 0, 59_999, 59_999) + blob[at + 16 :]
    path.write_bytes(blob)
    with pytest.raises(InputError, match=r"pixels|readable"):
        load_capture(capture)
