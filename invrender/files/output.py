"""Whether a place can take results: asked before the work that makes them."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path

from invrender.types import InputError


def check_output(
    out: Path, inputs: Iterable[Path] = (), *, file: bool = False, megabytes: float = 1
) -> None:
    """Raise `InputError` where results cannot or must not be written to ``out``.

    A folder, or with ``file`` a file, that is an input, lies in an input's folder, or holds an
    input or another capture, must not: results would replace what they are made from. What is not
    there yet, on a disk with room for ``megabytes``, that may be written to, can.
    """
    try:
        _check(Path(out), [Path(i) for i in inputs], file, megabytes)
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror or error}") from None


def _check(out: Path, inputs: list[Path], file: bool, megabytes: float) -> None:
    place = out.resolve()
    if file and out.is_dir():
        raise InputError(f"{out} is a folder; choose a file for the result")
    if not file and out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file; choose a folder for the results")
    for given in inputs:
        source = given.resolve()
        beside = not file and place == source.parent and not source.is_dir()
        if place == source or source in place.parents or beside:
            raise InputError(
                f"{out} is, or lies in, the input's folder: results there could replace what they "
                "are made from; choose another place"
            )
    # A result has a rig.toml too, and no report where a run was killed that was replacing it.
    result = any((out / name).is_file() for name in ("report.json", "sample.exr"))
    if not file and (out / "rig.toml").is_file() and not result:
        raise InputError(f"{out} holds a capture; choose another folder for the results")
    folder = place.parent if file or not out.exists() else place
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise InputError(f"{folder} is a file; {out} cannot be in it")
    with tempfile.TemporaryFile(dir=folder):
        pass
    free = shutil.disk_usage(folder).free / 1e6
    if free < megabytes:
        raise InputError(
            f"{out} cannot be written: {free:.0f} MB are free there, and about {megabytes:.0f} MB "
            "are needed"
        )
