"""Rigs that a person keeps by name, in millimetres, as the app's first step asks for them."""

from __future__ import annotations

import re
import secrets
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from invrender.app.store import read_json, write_json
from invrender.files.rig_toml import rig_text
from invrender.rig import BALL_SHAPES, Rig
from invrender.types import InputError

LONGEST_NAME = 80  # characters
MOST_PROFILES = 100
PHOTO_COUNTS = (1, 5)  # the default pattern alone, or a set


@dataclass(frozen=True)
class Profile:
    """A rig by name. Lengths in millimetres: ``side`` and ``depth`` of the pattern, along x and
    along y (None: a square), its ``height`` above the table, the ``gap`` from its edge to the
    middle of the lens, the ball's diameter, the ``sample``'s side (None: half of the pattern's
    shorter one). ``shape``: of the ball, or "" to find it in the photo. ``ppi``: of the display, or
    None if its page asks. ``photos``: how many a capture has. Raises `InputError` for what no rig
    is."""

    name: str = "My tablet"
    tablet: str = ""
    ppi: float | None = None
    side: float = 180.0
    height: float = 153.0
    gap: float = 34.0
    ball: float = 19.0
    shape: str = ""
    photos: int = 1
    id: str = ""
    depth: float | None = None
    sample: float | None = None

    def __post_init__(self) -> None:
        for field in ("side", "depth", "sample", "height", "gap", "ball"):
            value = getattr(self, field)
            if value is None and field in ("depth", "sample"):
                continue
            if not isinstance(value, int | float) or isinstance(value, bool):
                raise InputError(f"the rig's {field} must be a number of millimetres")
        for field in ("name", "tablet"):
            if not isinstance(getattr(self, field), str):
                raise InputError(f"the rig's {field} must be text")
        if not self.name.strip() or len(self.name) > LONGEST_NAME:
            raise InputError(f"give the rig a name of at most {LONGEST_NAME} characters")
        if self.shape not in ("", *BALL_SHAPES):
            raise InputError("the ball is a hemisphere, a sphere, or not stated")
        if self.ppi is not None and (
            isinstance(self.ppi, bool)
            or not isinstance(self.ppi, int | float)
            or not 30 <= self.ppi <= 2000
        ):
            raise InputError("a display has 30 to 2000 pixels an inch")
        if self.photos not in PHOTO_COUNTS:
            raise InputError(f"a capture has {' or '.join(map(str, PHOTO_COUNTS))} photos")
        if not all(1 <= side <= 5000 for side in (self.side, self.depth or 1)):
            raise InputError("the pattern's sides are 1 to 5000 mm")
        self.rig()

    def rig(self) -> Rig:
        """The rig in metres."""
        side = self.side / 1000
        return Rig(
            screen_size=side if self.depth is None else (side, self.depth / 1000),
            screen_height=self.height / 1000,
            camera_offset=self.gap / 2000,
            ball_radius=self.ball / 2000,
            ball_shape=self.shape or Rig.ball_shape,
            sample_side=None if self.sample is None else self.sample / 1000,
        )

    def rig_toml(self) -> str:
        """``rig.toml``: field of view, reflectance and an unknown shape are left to the photo."""
        unknown = {"fov", "ball_reflectance"} | ({"ball_shape"} if not self.shape else set())
        return rig_text(self.rig(), "pattern.exr", leave=frozenset(unknown))


def profile_of(values: Any, id: str = "") -> Profile:
    """A profile from JSON. Raises `InputError`."""
    known = {f.name for f in fields(Profile)} - {"id"}
    if not isinstance(values, dict) or not values.keys() <= known | {"id"}:
        raise InputError(f"a rig has {', '.join(sorted(known))}, and nothing else")
    try:
        return Profile(**{**values, "id": id})
    except TypeError as error:
        raise InputError(f"this is no rig: {error}") from None


def read_profiles(file: Path) -> list[Profile]:
    """The profiles of a file, what cannot be read left out; the default rig where there is none."""
    found, entries = [], read_json(file)
    for entry in entries if isinstance(entries, list) else []:
        id = entry.get("id", "") if isinstance(entry, dict) else ""
        if isinstance(id, str) and re.fullmatch(r"[0-9a-f]{8}", id):
            try:
                found.append(profile_of(entry, id))
            except InputError:
                continue
    return found or [Profile(name="Default rig", id="00000000")]


def save_profile(file: Path, profile: Profile) -> Profile:
    """Add a profile, or replace the one with its id; returns it with an id."""
    profiles = read_profiles(file)
    if not profile.id:
        profile = replace(profile, id=secrets.token_hex(4))
        if len(profiles) >= MOST_PROFILES:
            raise InputError(f"there are {MOST_PROFILES} rigs already: delete one first")
    kept = [p for p in profiles if p.id != profile.id]
    write_json(file, [asdict(p) for p in (profile, *kept)])
    return profile


def delete_profile(file: Path, id: str) -> None:
    """Forget a profile."""
    write_json(file, [asdict(p) for p in read_profiles(file) if p.id != id])
