"""Dr.Jit with a working compiler behind it: CUDA where there is a GPU, otherwise LLVM.

Dr.Jit loads libLLVM by name at run time. Versions before 15 are refused, and 15 and 16 abort the
process on x86 when a kernel holds a floating-point minimum or maximum, so one is chosen here,
before Dr.Jit or Mitsuba is first imported: the one that a user names in ``DRJIT_LIBLLVM_PATH``,
else that of the ``karellen-llvm-core`` wheel, else the newest on the system. Every module that
needs Dr.Jit imports it from here.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from importlib import metadata
from pathlib import Path

from invrender.types import InputError

MIN_LLVM = 17
_HINT = (
    "install one with `pip install karellen-llvm-core` (Linux x86-64) or `apt install libllvm19`"
)


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


def _system_llvm() -> Path | None:
    """The newest libLLVM of version 17 or later in the usual folders."""
    patterns = ["libLLVM-*.so*", "libLLVM.so.*", "libLLVM*.dylib"]
    roots = [
        *Path("/usr/lib").glob("*-linux-gnu"),
        *Path("/usr/lib").glob("llvm*/lib"),
        *(Path(p) for p in ("/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")),
        Path(sys.prefix) / "lib",
    ]
    best: tuple[int, Path] | None = None
    for root in roots:
        for pattern in patterns:
            for path in root.glob(pattern):
                version = re.search(r"(\d+)(?:\.\d+)*", path.name.removeprefix("libLLVM"))
                if version and (best is None or int(version[1]) > best[0]):
                    best = (int(version[1]), path)
    return best[1] if best and best[0] >= MIN_LLVM else None


def _select_llvm() -> str:
    """Point Dr.Jit at a libLLVM. Returns why there is none, or an empty string."""
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        return "" if Path(chosen).exists() else f"DRJIT_LIBLLVM_PATH names no file: {chosen}"
    path = _wheel_llvm() or _system_llvm()
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
    if _problem:
        raise InputError(f"Dr.Jit cannot run: {_problem}")
    if not dr.has_backend(dr.JitBackend.LLVM):
        raise InputError(f"Dr.Jit cannot load {os.environ.get('DRJIT_LIBLLVM_PATH')}; {_HINT}")
    if dr.detail.llvm_version()[0] < MIN_LLVM:
        raise InputError(
            f"Dr.Jit took LLVM {dr.detail.llvm_version()}, older than {MIN_LLVM}; {_HINT}"
        )
    import drjit.llvm.ad as ad  # type: ignore[no-redef]

Float = ad.Float
UInt = ad.UInt32

__all__ = ["BACKEND", "Float", "UInt", "ad", "dr", "vector"]


def vector(scalar: type, size: int) -> type:
    """The ``size``-vector type over ``Float`` or ``Float64``, e.g. Array3f."""
    return getattr(ad, f"Array{size}f" + ("64" if scalar is ad.Float64 else ""))
