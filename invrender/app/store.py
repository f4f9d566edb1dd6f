"""Captures as plain folders: what is on disk is the truth.

    DATA/captures/ID/capture.json       name, notes, tags, corrections by hand, the job
                     photos/1/          a capture's folder: photo.*, rig.toml, pattern.exr
                     shown/1/           what the page shows of it: pictures, check.json
                     result/            what `invrender refine` writes
                     exports/
    DATA/kept/             lights that were found in photos, for as long as the program runs
    DATA/trash/ID, DATA/profiles.json, DATA/token

A folder appears whole, by a rename; a name in it never comes from outside.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from invrender.app.kept import read_found, write_found
from invrender.data import EXAMPLE
from invrender.files.images import PHOTOS
from invrender.files.write import atomic_path, write_exr
from invrender.types import Array, InputError

ID = re.compile(r"\d{8}-\d{6}-[0-9a-f]{6}")
LONGEST_NOTES = 10_000  # characters
MOST_TAGS = 30
LONGEST_TAG = 40  # characters
MOST_KEPT = 8  # photos whose lights are kept: 150 MB each where they have 12 megapixels
PHOTO_FILES = ("photo.jpg", "clipped.png", "check.json")


def prepare(root: Path) -> None:
    """Make the data folder, and remove what uploads that were cut off have left.

    Raises `InputError` where it cannot be written.
    """
    try:
        for name in ("captures", "trash"):
            (root / name).mkdir(parents=True, exist_ok=True)
        for name in ("uploads", "kept"):
            shutil.rmtree(root / name, ignore_errors=True)
            (root / name).mkdir(mode=0o700)
    except OSError as error:
        raise InputError(f"{root} cannot be written: {error.strerror or error}") from None


def token(root: Path) -> str:
    """The secret that opens the page, kept so that a phone's link outlives the server."""
    file = root / "token"
    try:
        known = file.read_text(encoding="ascii").strip()
        if re.fullmatch(r"[\w-]{20,100}", known):
            return known
    except (OSError, ValueError):
        pass
    known = secrets.token_urlsafe(18)
    file.touch(mode=0o600)
    file.chmod(0o600)
    file.write_text(known, encoding="ascii")
    return known


def folder_of(root: Path, id: str) -> Path:
    """A capture's folder. Raises `KeyError` where there is none."""
    folder = root / "captures" / id
    if not ID.fullmatch(id) or not folder.is_dir():
        raise KeyError(id)
    return folder


def all_ids(root: Path) -> list[str]:
    """Captures, the newest first."""
    places = (root / "captures").iterdir()
    return sorted((p.name for p in places if ID.fullmatch(p.name) and p.is_dir()), reverse=True)


def photo_suffix(name: str) -> str:
    """The ending of an uploaded file's name. Raises `InputError` for what is no photo."""
    suffix = Path(name).suffix.lower()
    if suffix not in PHOTOS:
        raise InputError(
            f"{name[:80]!r} is no photo that is known here: a raw file, JPEG, HEIC, PNG, TIFF or "
            "EXR is"
        )
    return suffix


def create(root: Path, name: str, rig_toml: str) -> str:
    """A new capture without photos; returns its id."""
    id = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
    new = root / "uploads" / id
    (new / "photos").mkdir(parents=True)
    (new / "rig.toml").write_text(rig_toml, encoding="utf-8")
    write_json(new / "capture.json", {"name": name[:80] or "Capture", "created": time.time()})
    new.rename(root / "captures" / id)
    return id


def create_example(root: Path) -> str:
    """A copy of the bundled capture; returns its id."""
    id = create(root, "Example", (EXAMPLE / "rig.toml").read_text(encoding="utf-8"))
    folder = folder_of(root, id)
    shutil.copytree(EXAMPLE, folder / "photos" / "1.new")
    (folder / "photos" / "1.new").rename(folder / "photos" / "1")
    update(folder, files={"1": {"file": "photo.exr", "pattern": "default"}})
    return id


def add_photo(
    folder: Path, uploaded: Path, suffix: str, file: str, pattern: str, image: Array
) -> int:
    """Take an uploaded file into a capture; returns the photo's number.

    pattern, image: the name of the pattern that was shown, and the pattern (h, w, 3).
    """
    number = 1 + max(photo_numbers(folder), default=0)
    new = folder / "photos" / f"{number}.new"
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir()
    shutil.copyfile(folder / "rig.toml", new / "rig.toml")
    write_exr(new / "pattern.exr", image, half=True)
    uploaded.rename(new / f"photo{suffix}")
    new.rename(folder / "photos" / str(number))
    files = read(folder)["files"]
    update(folder, files={**files, str(number): {"file": file[:120], "pattern": pattern}})
    return number


def photo_numbers(folder: Path) -> list[int]:
    """Numbers of the photos that a capture has."""
    places = (folder / "photos").iterdir()
    return sorted(int(p.name) for p in places if p.name.isdigit() and p.is_dir())


def read(folder: Path) -> dict[str, Any]:
    """``capture.json``; what is missing or damaged in it has a default."""
    content = read_json(folder / "capture.json")
    content = content if isinstance(content, dict) else {}
    defaults = {
        "name": folder.name, "created": 0.0, "notes": "", "tags": [], "files": {}, "fixes": {},
        "job": None,
    }  # fmt: skip
    return {k: content.get(k, v) for k, v in defaults.items()}


def update(folder: Path, **changes: Any) -> dict[str, Any]:
    """Change entries of ``capture.json``; returns all of it."""
    content = {**read(folder), **changes}
    write_json(folder / "capture.json", content)
    return content


def read_json(file: Path) -> Any:
    """A JSON file, None where there is none or a damaged one."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def checked_texts(values: dict[str, Any]) -> dict[str, Any]:
    """Name, notes and tags as a person typed them. Raises `InputError`."""
    out: dict[str, Any] = {}
    if "name" in values:
        if not isinstance(values["name"], str) or not values["name"].strip():
            raise InputError("a capture needs a name")
        out["name"] = values["name"].strip()[:80]
    if "notes" in values:
        if not isinstance(values["notes"], str) or len(values["notes"]) > LONGEST_NOTES:
            raise InputError(f"notes are text of at most {LONGEST_NOTES} characters")
        out["notes"] = values["notes"]
    if "tags" in values:
        tags = values["tags"]
        if not isinstance(tags, list) or not all(isinstance(t, str) for t in tags):
            raise InputError("tags are a list of words")
        clean = dict.fromkeys(t.strip()[:LONGEST_TAG] for t in tags if t.strip())
        out["tags"] = list(clean)[:MOST_TAGS]
    return out


def checked_fix(values: Any) -> dict[str, Any]:
    """What was set by hand in a photo: ``turn`` in quarters, ``ball`` (x, y, radius) and
    ``corners`` (4, 2) in pixels of the turned photo. Raises `InputError`."""

    def numbers(value: Any, count: int) -> list[float]:
        right = isinstance(value, list) and len(value) == count
        if not right or not all(
            isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e6 for v in value
        ):
            raise InputError("a ball is three numbers, a corner two")
        return [float(v) for v in value]

    if not isinstance(values, dict):
        raise InputError("what is set by hand is a ball, corners, or a turn")
    fix: dict[str, Any] = {}
    if values.get("turn") in (1, 2, 3):
        fix["turn"] = values["turn"]
    if values.get("ball") is not None:
        fix["ball"] = numbers(values["ball"], 3)
        if not fix["ball"][2] > 0:
            raise InputError("the ball's radius must be above 0")
    if values.get("corners") is not None:
        corners = values["corners"]
        if not isinstance(corners, list) or len(corners) != 4:
            raise InputError("the sample has four corners")
        fix["corners"] = [numbers(c, 2) for c in corners]
    return fix


def sources(folder: Path, number: int) -> dict[str, Any]:
    """What is found in a photo depends on: its files, and what was set by hand."""
    files = sorted((folder / "photos" / str(number)).iterdir())
    stamps = [(f.name, s.st_mtime_ns, s.st_size) for f in files for s in [f.stat()]]
    return {"files": stamps, "fix": read(folder)["fixes"].get(str(number), {})}


def keep(folder: Path, number: int, sources: dict[str, Any], found: Any) -> None:
    """Keep what was found in a photo, where the disk has room; `kept` brings it back."""
    places = folder.parents[1] / "kept"
    with suppress(OSError):
        with atomic_path(places / f"{folder.name}-{number}") as path:
            write_found(path, sources, found)
        for old in sorted(places.iterdir(), key=os.path.getmtime)[:-MOST_KEPT]:
            old.unlink(missing_ok=True)


def kept(folder: Path, number: int) -> Any:
    """What was found in a photo since the program began; None where there is none, or where its
    `sources` have changed. `prepare` empties the folder."""
    path = folder.parents[1] / "kept" / f"{folder.name}-{number}"
    try:
        return read_found(path, sources(folder, number))
    except (OSError, ValueError):
        return None


def discard(root: Path, id: str) -> None:
    """Move a capture to the trash."""
    folder_of(root, id).rename(root / "trash" / id)
    for file in (root / "kept").glob(f"{id}-*"):
        file.unlink(missing_ok=True)


def restore(root: Path, id: str) -> None:
    """Take a capture out of the trash. Raises `KeyError` where it is not there."""
    if not ID.fullmatch(id) or not (root / "trash" / id).is_dir():
        raise KeyError(id)
    (root / "trash" / id).rename(root / "captures" / id)


def write_json(file: Path, content: Any) -> None:
    """Write a JSON file, whole or not at all."""
    with atomic_path(file) as path:
        path.write_text(json.dumps(content, indent=1), encoding="utf-8")
