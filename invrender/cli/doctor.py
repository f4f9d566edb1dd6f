"""``invrender doctor``: what this installation has, and whether it works."""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

# What each optional module is for, and the extra that brings it.
OPTIONAL = {
    "MaterialX": "export to MaterialX (export)",
    "flip_evaluator": "the metric FLIP (metrics)",
    "distributed": "a Dask cluster (cluster)",
}
REQUIRED = (
    "invrender", "drjit", "mitsuba", "torch", "kornia", "numpy", "scipy", "scikit-image", "OpenEXR",
    "pillow",
)  # fmt: skip


def add_parser(commands: Any) -> None:
    """Add the subcommand to argparse's subparsers."""
    parser = commands.add_parser(
        "doctor",
        help="check the installation",
        description="Print versions, back ends and optional parts, and run a self-test of some "
        "seconds: the back end, a render against its closed form, the network. Exit code 1 if "
        "something is broken.",
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace, console: Console) -> int:
    """Run the subcommand."""
    with console.status("checking …"):
        found = examine()
    if args.json:
        print(json.dumps(found))
    else:
        for title in ("machine", "versions", "optional"):
            print(title)
            for name, value in found[title].items():
                print(f"  {name:<16} {value}")
        print("self-test")
        for name, check in found["checks"].items():
            print(f"  {name:<16} {'ok' if check['ok'] else 'FAILED'}: {check['text']}")
    return 0 if all(check["ok"] for check in found["checks"].values()) else 1


def examine() -> dict[str, Any]:
    """Machine, versions, optional parts, and the checks: for each ``ok`` and a ``text``."""
    checks: dict[str, dict[str, Any]] = {}
    for name, check in (("back end", _backend), ("render", _render), ("network", _network)):
        began = time.perf_counter()
        try:
            text = check()
            checks[name] = {"ok": True, "text": f"{text} ({time.perf_counter() - began:.1f} s)"}
        except Exception as error:  # told to the user, whatever it is
            checks[name] = {"ok": False, "text": f"{type(error).__name__}: {error}"}
    return {
        "machine": {
            "python": platform.python_version(),
            "system": platform.platform(),
            "processors": os.cpu_count(),
        },
        "versions": {name: _version(name) for name in REQUIRED},
        "optional": {
            name: "there" if importlib.util.find_spec(name) else f"missing: {use}"
            for name, use in OPTIONAL.items()
        },
        "checks": checks,
    }


def _version(name: str) -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def _backend() -> str:
    from invrender.render.backend import Float, dr

    one = dr.sum(dr.arange(Float, 4))
    assert float(one[0]) == 6.0
    kind = "CUDA" if dr.backend_v(Float) == dr.JitBackend.CUDA else "LLVM"
    return f"{kind} {dr.detail.llvm_version() if kind == 'LLVM' else ''}".strip()


def _render() -> str:
    """A white diffuse sample under a lamp straight above it has radiance 1 (see `relight`)."""
    import numpy as np

    from invrender.maps import constant_maps
    from invrender.render.point_lights import relight
    from invrender.rig import Rig

    rig = Rig()
    maps = constant_maps(9, 9, diffuse=1.0, specular=0.0, roughness=1.0)
    image = relight(maps, rig, np.array([[0.0, 0.0, rig.screen_height]]))
    # Of the specular part Schlick's weight is left, less than 0.01 at this angle.
    error = float(np.abs(image[0, 4, 4] - 1).max())
    if not error < 0.02:
        raise RuntimeError(f"a white sample is {error:.3f} off its closed form")
    return f"a white sample is {error:.4f} off its closed form"


def _network() -> str:
    from nets.predict import Reconstructor

    Reconstructor()
    return "weights read"
