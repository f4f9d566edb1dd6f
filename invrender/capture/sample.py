"""A sample as a photo shows it, and where others of several photos show the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from invrender.capture.crop import crop_mask, crop_part, crop_sample
from invrender.capture.lights import FoundLights
from invrender.capture.placement import find_place
from invrender.files.images import Photo
from invrender.lights import Lights
from invrender.sampling import resize
from invrender.types import Array, InputError, Mask

STRAIGHT = 10.0  # degrees up to which networks read a turned sample


@dataclass(frozen=True)
class Sample:
    """A sample as a photo shows it: photo (N, N, 3), linear radiance; clipped (N, N), where it does
    not measure the sample; lights, what it was photographed under; whole, the photo that it is cut
    from, if any; place, where the first photo's square of several lies in this one's own."""

    photo: Array
    clipped: Mask
    lights: Lights
    whole: Photo | None = None
    place: Array | None = None

    @classmethod
    def of(cls, found: FoundLights, size: int, whole: bool = False) -> Sample:
        """Cut out of a capture's photo, ``size`` pixels a side; whole: to be registered, so that
        the photo is kept."""
        if size < 1:
            raise InputError(f"the size must be at least one pixel, got {size}")
        photo, rig = found.capture.photo, found.lights.rig
        crop, clipped = crop_sample(photo, rig, size), crop_mask(photo, rig, size)
        return cls(crop, clipped, found.lights, photo if whole else None)

    @property
    def is_straight(self) -> bool:
        """Whether the sample lies as in the first photo, by and large."""
        place = np.eye(3) if self.place is None else self.place
        return bool(abs(np.degrees(np.arctan2(place[1, 0], place[0, 0]))) < STRAIGHT)

    def shrunk(self, height: int, width: int) -> Sample:
        """With means over so many pixels; what touches a saturated one is saturated."""
        clipped = resize(self.clipped.astype(np.float32), height, width) > 0
        return replace(self, photo=resize(self.photo, height, width), clipped=clipped)

    def placed(self, place: Array, sharp: bool = False) -> Sample:
        """The square of the sample that lies where a homography takes this one's own, with the
        lights as they are seen from there; sharp: of `crop_part`."""
        if self.whole is None or (np.array_equal(place, np.eye(3)) and not sharp):
            return self
        rig, size = self.lights.rig, len(self.photo)
        crop = crop_part(self.whole, rig, size, place, sharp)
        clipped = crop_mask(self.whole, rig, size, place)
        return Sample(crop, clipped, self.lights.placed(place), None, place)


def place_samples(samples: Sequence[Sample]) -> list[Sample]:
    """The square of the first sample, cut out of each photo where this shows it."""
    first, *others = samples
    return [first, *(s.placed(_find_first(s, first)) for s in others)]


def _find_first(sample: Sample, first: Sample) -> Array:
    """Where a photo shows the square of the sample that the first one shows, (3, 3)."""
    if sample.whole is None or first.whole is None:
        return np.eye(3)
    photos, rigs = (sample.whole, first.whole), (sample.lights.rig, first.lights.rig)
    return find_place(photos, rigs)[0]
