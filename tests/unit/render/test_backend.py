"""The back end: an LLVM that works is chosen, and its C++ runtime leaves other libraries alone."""

import os
import subprocess
import sys

import pytest

from invrender.render.backend import BACKEND, MIN_LLVM, _system_llvm, dr

llvm_only = pytest.mark.skipif(BACKEND != "llvm", reason="the CUDA back end is in use")


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"}
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**variables, **environment},
    )


@llvm_only
def test_llvm_is_new_enough():
    assert dr.detail.llvm_version()[0] >= MIN_LLVM


def test_minimum_and_maximum_compile():
    """LLVM 15 and 16 abort the process here."""
    code = (
        "from invrender.render.backend import Float, dr\n"
        "x = dr.clip(dr.maximum(Float([1, -2, 3]), 0), 0, 2)\n"
        "assert list(x) == [1, 0, 2]"
    )
    done = run(code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("first", ["torch", "invrender.render.backend"])
def test_exceptions_and_import_order(first):
    """A C++ exception becomes a Python one, whichever library came first."""
    pytest.importorskip("torch")
    code = (
        f"import {first}\n"
        "from invrender.render.backend import dr\n"
        "import torch, mitsuba as mi\n"
        "mi.set_variant('llvm_ad_rgb')\n"
        "try:\n"
        "    mi.load_dict({'type': 'no such plugin'})\n"
        "except Exception:\n"
        "    print('caught', dr.sum(mi.Float([1, 2]))[0], torch.ones(2).sum().item())"
    )
    done = run(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["caught", "3.0", "2.0"]


@llvm_only
def test_wrong_path_is_one_sentence(tmp_path):
    code = (
        "from invrender.types import InputError\n"
        "try:\n"
        "    import invrender.render.backend\n"
        "except InputError as e:\n"
        "    print(e)"
    )
    done = run(code, DRJIT_LIBLLVM_PATH=str(tmp_path / "none.so"))
    assert done.returncode == 0, done.stderr
    assert "DRJIT_LIBLLVM_PATH names no file" in done.stdout


def test_system_llvm_is_none_or_new_enough():
    path = _system_llvm()
    assert path is None or path.exists()
