"""Dr.Jit with a working compiler behind it: CUDA where there is a GPU, otherwise LLVM.

Dr.Jit loads libLLVM by name at run time. Versions before 15 are refused, and 15 and 16 abort the
process on x86 when a kernel holds a floating-point minimum or maximum, so one is chosen here,
before Dr.Jit or Mitsuba is first imported: the one that a user names in ``DRJIT_LIBLLVM_PATH``,
else that of the ``karellen-llvm-core`` wheel, else the newest on the system, else what the system's
loader finds. Every module that
needs Dr.Jit imports it from here.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from invrender.types import InputError

MIN_LLVM = 17
_HINT = "install one: " + {
    "darwin": "`brew install llvm`",
    "win32": "https://github.com/llvm/llvm-project/releases",
}.get(sys.platform, "`pip install karellen-llvm-core` (Linux x86-64) or `apt install libllvm19`")


def _wheel_llvm() -> Path | None:
    """libLLVM of the karellen-llvm-core wheel, its C++ runtime loaded."""
    try:
        files = metadata.files("karellen-llvm-core") or []
    except metadata.PackageNotFoundError:
        return None
    found = {p.name: Path(str(p.locate())) for p in files if ".so" in p.name}
    # libLLVM links against its own libc++, whose short names exist only after a first Python start
    # by a user who may write there: load them by their full names.
    for name in ("libunwind.so.1.0", "libc++abi.so.1.0", "libc++.so.1.0"):
        if name in found:
            ctypes.CDLL(str(found[name]))  # local: a global libunwind breaks C++ exceptions
    names = sorted(n for n in found if re.fullmatch(r"libLLVM\.so\.[\d.]+\w*", n))
    return found[names[-1]] if names else None


# Where LLVM's library lies, by the start of `sys.platform`; * as in globs, relative to the root.
# Linux: Debian, Fedora, Arch, Alpine, Gentoo, openSUSE; macOS: Homebrew on Apple's and Intel's
# processors, MacPorts; Windows: LLVM's own installer.
_PLACES = {
    "linux": (
        "usr/lib/*-linux-*", "usr/lib/llvm*/lib", "usr/lib/llvm*/lib64", "usr/lib/llvm/*/lib*",
        "usr/lib64", "usr/lib64/llvm*/lib*", "usr/lib", "usr/local/lib", "usr/local/lib64",
        "usr/local/llvm*/lib", "opt/llvm*/lib",
    ),
    "darwin": (
        "opt/homebrew/opt/llvm*/lib", "opt/homebrew/Cellar/llvm*/*/lib", "usr/local/opt/llvm*/lib",
        "usr/local/Cellar/llvm*/*/lib", "opt/local/libexec/llvm-*/lib", "opt/homebrew/lib",
        "usr/local/lib",
    ),
    "win": ("Program Files/LLVM/bin", "Program Files/LLVM*/bin"),
}  # fmt: skip
_LLVM_FILES = {
    "linux": ("libLLVM-*.so*", "libLLVM.so*"), "darwin": ("libLLVM*.dylib",), "win": ("LLVM-C.dll",)
}  # fmt: skip


_ROOT, _PREFIX = Path(Path.cwd().anchor), Path(sys.prefix)


def find_llvm(
    root: Path = _ROOT,
    platform: str = sys.platform,
    prefix: Path = _PREFIX,
    search: Sequence[Path] | None = None,
) -> Path | None:
    """The newest LLVM library of version 17 or later in the usual places.

    Where neither its name nor its folder's tells a version it comes last. root: of the system;
    prefix: of Python, where conda puts libraries; search: more folders, of the PATH on Windows and
    of the loader's variables elsewhere where it is None.
    """
    system = next((s for s in _PLACES if platform.startswith(s)), "linux")
    if search is None:
        names = {"win": ("PATH",), "darwin": ("DYLD_LIBRARY_PATH",)}.get(
            system, ("LD_LIBRARY_PATH",)
        )
        listed = os.pathsep.join(os.environ.get(name, "") for name in names)
        search = [Path(part) for part in listed.split(os.pathsep) if part]
    folders = [folder for place in _PLACES[system] for folder in root.glob(place)]
    folders += [prefix / "lib", prefix / "Library" / "bin", *search]
    found = []
    for folder in folders:
        for pattern in _LLVM_FILES[system]:
            with contextlib.suppress(OSError):
                found += [(_version(path), path) for path in folder.glob(pattern)]
    usable = [(version, path) for version, path in found if version is None or version >= MIN_LLVM]
    return max(usable, key=lambda item: item[0] or 0)[1] if usable else None


def _version(path: Path) -> int | None:
    """LLVM's major version by its library's name (libLLVM-19.so.1, libLLVM.so.19.1) or folder
    (llvm@18, llvm-17, llvm/19.1.7), links followed; None where nothing tells."""
    for name in (path, path.resolve()):
        text = re.search(r"libLLVM[-.](?:so\.|dylib\.)?(\d+)", name.name)
        folder = re.search(
            r"(?i)llvm[@-]?(\d+)(?:\D|$)|llvm(?:@\d+)?/(\d+)\.", name.parent.as_posix()
        )
        for match in (text, folder):
            if match:
                return int(next(group for group in match.groups() if group))
    return None


def _select_llvm() -> str:
    """Point Dr.Jit at a libLLVM. Returns what is wrong if it finds none then, or an empty string.

    What a user names in ``DRJIT_LIBLLVM_PATH`` may be a path, or a name that the system's loader
    knows. Where no file is found, Dr.Jit asks the loader itself.
    """
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        named = Path(chosen)
        missing = len(named.parts) > 1 and not named.exists()
        return f"DRJIT_LIBLLVM_PATH names no file: {chosen}" if missing else ""
    path = _wheel_llvm() or find_llvm()
    if path is None:
        return f"no LLVM {MIN_LLVM} or newer was found; {_HINT}"
    os.environ["DRJIT_LIBLLVM_PATH"] = str(path)
    return ""


_problem = "" if "drjit" in sys.modules else _select_llvm()

import drjit as dr  # noqa: E402  (the choice above must come first)

if dr.has_backend(dr.JitBackend.CUDA):
    BACKEND = "cuda"
    import drjit.cuda.ad as ad
else:
    BACKEND = "llvm"
    if not dr.has_backend(dr.JitBackend.LLVM):
        if _problem:
            raise InputError(f"Dr.Jit cannot run: {_problem}")
        raise InputError(f"Dr.Jit cannot load {os.environ.get('DRJIT_LIBLLVM_PATH')}; {_HINT}")
    if dr.detail.llvm_version()[0] < MIN_LLVM:
        raise InputError(
            f"Dr.Jit took LLVM {dr.detail.llvm_version()}, older than {MIN_LLVM}; {_HINT}"
        )
    import drjit.llvm.ad as ad  # type: ignore[no-redef]

Float = ad.Float
UInt = ad.UInt32

__all__ = ["BACKEND", "Float", "UInt", "ad", "dr", "vector", "while_loop"]


def while_loop(state: tuple[Any, ...], *args: Any, **options: Any) -> tuple[Any, ...]:
    """`drjit.while_loop`, of which Ctrl-C stays a KeyboardInterrupt instead of an error."""
    try:
        return tuple(dr.while_loop(state, *args, **options))
    except RuntimeError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):
            raise KeyboardInterrupt from error
        raise


def vector(scalar: type, size: int) -> type:
    """The ``size``-vector type over ``Float`` or ``Float64``, e.g. Array3f."""
    return getattr(ad, f"Array{size}f" + ("64" if scalar is ad.Float64 else ""))
