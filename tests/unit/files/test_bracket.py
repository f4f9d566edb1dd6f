"""Several exposures of one set-up become one linear photo."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from invrender.colour import linear_to_srgb, srgb_to_linear
from invrender.files.bracket import merge_bracket
from invrender.files.images import Photo
from invrender.types import InputError

SIZE = (240, 320)
LEVEL = float(srgb_to_linear(np.float32(250 / 255)))


def scene(seed=0):
    """Radiance (H, W, 3) from 0.005 to 4: textures of all sizes, with a bright square."""
    rng = np.random.default_rng(seed)
    image = sum(
        s**2 * ndimage.gaussian_filter(rng.standard_normal((*SIZE, 3)), (s, s, 0))
        for s in (1, 3, 9, 20)
    )
    image = np.exp(1.6 * image / image.std() - 2.2)
    image[90:150, 120:200] *= 4
    return np.clip(image, 0.005, 4)


def shoulder(x):
    """A phone's curve."""
    return x * 1.14 / (1 + x)


def expose(image, time, curve=shoulder, moved=0.0, seed=0):
    """An 8-bit photo; moved: pixels by which the hand has moved."""
    warp = np.array([[1, 0.003 * moved, moved], [-0.003 * moved, 1, -0.7 * moved]], np.float32)
    image = cv2.warpAffine(image, warp, SIZE[::-1], borderMode=cv2.BORDER_REFLECT)
    noise = np.random.default_rng(seed).normal(0, 0.001, image.shape)
    data = np.round(linear_to_srgb(np.clip(curve(image * time) + noise, 0, 1)) * 255) / 255
    return Photo(srgb_to_linear(data).astype(np.float32), LEVEL, exposure=time)


def error(merged, truth):
    """Median and ninth decile of the relative error, of what is bright enough, up to a factor."""
    inside = np.s_[12:-12, 12:-12]
    ratio = np.log(merged.image[inside]) - np.log(truth[inside])
    ratio = ratio[(truth[inside] < 3) & (truth[inside] > 0.02)]
    off = np.abs(ratio - np.median(ratio))
    return float(np.median(off)), float(np.quantile(off, 0.9))


@pytest.mark.parametrize("moved", [0.0, 3.0])
def test_exposures_are_merged_to_linear_radiance(moved):
    image = scene()
    shots = [expose(image, 0.25), expose(image, 1.0, moved=moved), expose(image, 4, moved=-moved)]
    merged = merge_bracket(shots, ["a", "b", "c"])
    median, most = error(merged, image)
    assert median < 0.03 and most < 0.12
    one = error(shots[0], image)[1]
    assert most < one / 2
    assert merged.clip_level is not None and merged.clip_level > shots[0].clip_level


def test_the_curve_needs_no_exif_where_it_is_nearly_straight():
    image = scene(1)
    shots = [expose(image, t, lambda x: x) for t in (1.0, 0.25)]
    merged = merge_bracket([replace(s, exposure=None) for s in shots], ["a", "b"])
    assert error(merged, image)[0] < 0.03


def unevenness(merged, truth):
    """By how much the logarithm of merged over true radiance differs between levels of that."""
    levels = np.geomspace(0.1, 2, 8)
    ratio = np.log(np.maximum(merged.image, 1e-6) / truth)
    inside = [(truth > a) & (truth < b) for a, b in itertools.pairwise(levels)]
    return float(np.ptp([np.median(ratio[k]) for k in inside]))


def film(x):
    """Narkowicz's fit of the ACES curve, which has a toe and a shoulder."""
    return 1.2 * x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)


@pytest.mark.parametrize("curve", [shoulder, film])
@pytest.mark.parametrize("times", [3.0, 10.0])
def test_two_exposures_however_far_apart_give_the_curve(curve, times):
    """A curve whose slope changes with a period of the exposures' ratio explains two photos as
    well: what curves are like decides."""
    image = scene(2)
    shots = [expose(image, 1 / times, curve), expose(image, 1.0, curve)]
    merged = merge_bracket(shots, ["a", "b"])
    assert unevenness(merged, image) < 0.12


def test_a_straight_curve_stays_straight():
    image = scene(3)
    shots = [expose(image, t, lambda x: x) for t in (0.1, 1.0)]
    merged = merge_bracket(shots, ["a", "b"])
    assert unevenness(merged, image) < 0.02


def test_bad_brackets_are_refused_in_one_sentence():
    image = scene()
    short, long = expose(image, 0.25), expose(image, 1.0)

    def refused(match, *photos):
        with pytest.raises(InputError, match=match):
            merge_bracket(photos, [f"photo_{i + 1}.jpg" for i in range(len(photos))])

    refused("does not show", short, expose(scene(5), 1.0))
    refused("same exposure", short, replace(expose(image, 0.25, seed=1), exposure=None))
    soft = Photo(ndimage.gaussian_filter(long.image, (6, 6, 0)), LEVEL, exposure=1.0)
    refused("photo_2.jpg is blurred", short, soft)
    refused("differ in size", short, Photo(long.image[:100], LEVEL))
    black = Photo(np.full_like(long.image, 1e-4), LEVEL, exposure=0.001)
    refused("does not show|in common", black, long)


def test_light_that_changed_between_exposures_is_told():
    image = scene()
    lamp = 1 + 1.5 * (np.arange(SIZE[1]) > 160)[None, :, None]
    merged = merge_bracket([expose(image, 0.25), expose(image * lamp, 0.5)], ["a", "b"])
    assert "bracket-unsteady" in {w.code for w in merged.warnings}
