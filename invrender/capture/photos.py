"""The photos of one sample: read, and the lights of each found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from invrender.capture.lights import FoundLights, find_lights
from invrender.capture.which_pattern import find_pattern
from invrender.files.capture import Capture, holds_set, load_capture, load_set
from invrender.types import Array, InputError, Notice

# A capture, and the patterns of which its photo shows one; none where it is known which.
Shown = tuple[Capture, list[Array]]


def read_captures(folder: Path) -> list[Shown]:
    """A folder's captures: one, or as many as there are photos in a set."""
    if folder.is_dir() and holds_set(folder):
        captures, patterns = load_set(folder)
        return [(c, patterns) for c in captures]
    return [(load_capture(folder), [])]


@dataclass(frozen=True)
class Seen:
    """What one photo of several shows: the capture, the number of its pattern in the set, from
    nought, if it is one's; and its lights, or why it is left out."""

    capture: Capture
    pattern: int | None
    found: FoundLights | None
    error: InputError | None = None


def see_each(captures: Sequence[Shown], known: dict[str, Any]) -> Iterator[Seen]:
    """The lights of each capture of several, one after another. known: of `find_lights`."""
    for i, (capture, patterns) in enumerate(captures):
        which = None
        try:
            twin = next((c for c, _ in captures[:i] if _same(c, capture)), None)
            if twin is not None:
                raise InputError(f"it is the same photo as {twin.name}")
            if patterns:
                capture, which = find_pattern(capture, patterns)
            yield Seen(capture, which, find_lights(capture, **known))
        except InputError as error:
            yield Seen(capture, which, None, error)


def find_every_light(
    captures: Sequence[Shown],
    known: dict[str, Any],
    progress: Callable[[float], None] = lambda share: None,
) -> list[FoundLights]:
    """The lights of each capture; those of several that have none, or that are there twice, are
    left out, which the first one's notices say. known: of `find_lights`. Raises `InputError` where
    none is left."""
    if len(captures) == 1 and not captures[0][1]:
        return [find_lights(captures[0][0], **known)]
    found: list[FoundLights] = []
    problems: list[InputError] = []
    notices = []
    for i, seen in enumerate(see_each(captures, known)):
        name = seen.capture.name
        if seen.pattern is not None:
            notices.append(
                Notice("pattern-of-set", f"{name} shows pattern {seen.pattern + 1} of the set")
            )
        if seen.error is not None:
            problems.append(seen.error)
            notices.append(Notice("photo-left-out", f"{name} was left out: {seen.error}"))
        if seen.found is not None:
            found.append(seen.found)
        progress((i + 1) / len(captures))
    if not found:
        raise problems[0]
    return [replace(found[0], notices=(*found[0].notices, *notices)), *found[1:]]


def without_photo(found: FoundLights) -> FoundLights:
    """Without the photo's pixels, which nothing needs once the sample is cut out."""
    photo = replace(found.capture.photo, image=np.zeros((0, 0, 3), np.float32))
    return replace(found, capture=replace(found.capture, photo=photo), sheet=None)


def _same(a: Capture, b: Capture) -> bool:
    return a.photo.image.shape == b.photo.image.shape and np.array_equal(
        a.photo.image, b.photo.image
    )
