"""Where LLVM is found, in fake trees of the systems that the package runs on."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from invrender.render.backend import UInt, find_llvm, while_loop


def tree(root: Path, *files: str) -> None:
    """Empty files below a root; "link -> file" makes a link."""
    for file in files:
        name, arrow, target = file.partition(" -> ")
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if arrow:
            path.symlink_to(root / target)
        else:
            path.write_bytes(b"")


@pytest.mark.parametrize(
    ("platform", "files", "found"),
    [
        ("linux", ["usr/lib/x86_64-linux-gnu/libLLVM-14.so.1",
                   "usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"],
         "usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"),
        ("linux", ["usr/lib/aarch64-linux-gnu/libLLVM-18.so.1"],
         "usr/lib/aarch64-linux-gnu/libLLVM-18.so.1"),
        ("linux", ["usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", "usr/lib64/libLLVM-16.so"], None),
        ("linux", ["usr/lib64/libLLVM.so.20.1"], "usr/lib64/libLLVM.so.20.1"),
        ("linux", ["usr/lib64/llvm19/lib/libLLVM.so.19.1"], "usr/lib64/llvm19/lib/libLLVM.so.19.1"),
        ("linux", ["usr/lib/llvm/20/lib64/libLLVM.so.20.1"],
         "usr/lib/llvm/20/lib64/libLLVM.so.20.1"),
        ("linux", ["usr/lib/llvm17/lib/libLLVM.so"], "usr/lib/llvm17/lib/libLLVM.so"),
        ("linux", ["usr/lib/llvm-16/lib/libLLVM.so"], None),
        ("linux", ["usr/lib/libLLVM.so"], "usr/lib/libLLVM.so"),
        ("linux", ["opt/homebrew/opt/llvm/lib/libLLVM.dylib"], None),
        ("darwin", ["opt/homebrew/Cellar/llvm/19.1.7/lib/libLLVM.dylib"],
         "opt/homebrew/Cellar/llvm/19.1.7/lib/libLLVM.dylib"),
        ("darwin", ["opt/homebrew/Cellar/llvm/16.0.6/lib/libLLVM.dylib",
                    "opt/homebrew/opt/llvm/lib/libLLVM.dylib -> "
                    "opt/homebrew/Cellar/llvm/16.0.6/lib/libLLVM.dylib",
                    "opt/homebrew/opt/llvm@18/lib/libLLVM.dylib"],
         "opt/homebrew/opt/llvm@18/lib/libLLVM.dylib"),
        ("darwin", ["usr/local/opt/llvm/lib/libLLVM.dylib"],
         "usr/local/opt/llvm/lib/libLLVM.dylib"),
        ("darwin", ["opt/local/libexec/llvm-17/lib/libLLVM.dylib"],
         "opt/local/libexec/llvm-17/lib/libLLVM.dylib"),
        ("darwin", ["usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"], None),
        ("win32", ["Program Files/LLVM/bin/LLVM-C.dll"], "Program Files/LLVM/bin/LLVM-C.dll"),
        ("win32", ["tools/llvm/LLVM-C.dll"], "tools/llvm/LLVM-C.dll"),
        ("win32", ["python/Library/bin/LLVM-C.dll"], "python/Library/bin/LLVM-C.dll"),
        ("linux", ["python/lib/libLLVM.so.18.1"], "python/lib/libLLVM.so.18.1"),
        ("linux", ["tools/llvm/libLLVM.so.18.1"], "tools/llvm/libLLVM.so.18.1"),
        ("linux", [], None), ("darwin", [], None), ("win32", [], None),
    ],
)  # fmt: skip
def test_llvm_is_found_where_systems_have_it(tmp_path, platform, files, found):
    tree(tmp_path, *files)
    got = find_llvm(tmp_path, platform, tmp_path / "python", [tmp_path / "tools" / "llvm"])
    assert got == (None if found is None else tmp_path / found)


# A machine without the wheel, and with nothing in the usual folders.
BARE = """
import sys
sys.prefix = "/nonexistent"
from importlib import metadata
real = metadata.files
def files(name):
    if name == "karellen-llvm-core":
        raise metadata.PackageNotFoundError(name)
    return real(name)
metadata.files = files
import invrender.render.backend as b
print(b.BACKEND)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="of Linux's loader")
@pytest.mark.parametrize("named", ["", "libLLVM.so"])
def test_what_the_loader_finds_is_taken(tmp_path, named):
    """``DRJIT_LIBLLVM_PATH`` may be empty, or a bare name, as Dr.Jit itself has it."""
    import invrender.render.backend

    real = os.environ.get("DRJIT_LIBLLVM_PATH", "")
    if invrender.render.backend.BACKEND != "llvm" or not Path(real).exists():
        pytest.skip("no LLVM library in a file here")
    (tmp_path / "libLLVM.so").symlink_to(Path(real).resolve())
    for library in (
        Path(real).resolve().parent.glob("*-linux-gnu/*.so.1.0")
    ):  # the wheel's C++ runtime
        (tmp_path / library.name.removesuffix(".0")).symlink_to(library)
    env = os.environ | {
        "LD_LIBRARY_PATH": f"{tmp_path}:{Path(real).resolve().parent}", "DRJIT_LIBLLVM_PATH": named,
    }  # fmt: skip
    done = subprocess.run([sys.executable, "-c", BARE], env=env, capture_output=True, text=True)
    assert done.stdout.strip() == "llvm", done.stderr


def test_a_path_without_a_file_is_named(tmp_path):
    env = os.environ | {"DRJIT_LIBLLVM_PATH": str(tmp_path / "none.so")}
    done = subprocess.run([sys.executable, "-c", BARE], env=env, capture_output=True, text=True)
    if "cuda" in done.stdout:
        pytest.skip("runs on a GPU")
    assert "DRJIT_LIBLLVM_PATH names no file" in done.stderr


def test_ctrl_c_in_a_loop_stays_one():
    """Dr.Jit makes errors of what is raised while it records a loop's body."""

    def interrupted(i):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        while_loop((UInt(0),), lambda i: i < 3, interrupted)

    def wrong(i):
        raise ValueError("wrong")

    with pytest.raises(RuntimeError):
        while_loop((UInt(0),), lambda i: i < 3, wrong)
    (last,) = while_loop((UInt(0),), lambda i: i < 3, lambda i: (i + 1,))
    assert last[0] == 3
