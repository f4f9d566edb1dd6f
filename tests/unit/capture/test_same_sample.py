"""Photos of different samples are told from photos of one under other lights."""

import numpy as np
import pytest

from invrender.capture.same_sample import strangers
from invrender.capture.sample import Sample
from invrender.data.environments import procedural_environment
from invrender.data.materials import procedural_material
from invrender.lights import Lights
from invrender.maps import constant_maps
from invrender.pattern.sets import pattern_set
from invrender.pipeline import Stages, estimate_maps
from invrender.refine.flat import plain_image
from invrender.refine.gauss_newton import Observation
from invrender.render.fast.estimator import Fast
from invrender.rig import Rig
from invrender.sphere import scale_environment
from invrender.types import InputError

SIZE = 48


@pytest.fixture(scope="module")
def lights():
    rooms = [scale_environment(procedural_environment(k, 64), 0.3) for k in (3, 3, 4)]
    return [Lights(Rig(), p, r, 2.0) for p, r in zip(pattern_set(3, 32), rooms, strict=True)]


@pytest.fixture(scope="module")
def renderers(lights):
    return [Fast.under(x) for x in lights]


def shot(maps, renderer, exposure=1.0, noise=0.01):
    photo = renderer.render(maps, 64)
    rng = np.random.default_rng(0)
    photo = exposure * photo * (1 + noise * rng.standard_normal(photo.shape).astype(np.float32))
    return Observation(photo, renderer)


def odd_ones(photos):
    shown = [p.photo for p in photos]
    return strangers(shown, lambda i: plain_image(shown[i], photos[i].renderer))


def kinds(*names):
    return [procedural_material(5 + k, SIZE, SIZE, kind=n) for k, n in enumerate(names)]


@pytest.mark.parametrize("kind", ["leather", "bricks", "rusty_metal", "terrazzo"])
def test_one_sample_is_one_under_other_lights_rooms_and_exposures(renderers, kind):
    maps = kinds(kind)[0]
    photos = [shot(maps, r, e) for r, e in zip(renderers, (1.0, 0.4, 2.0), strict=True)]
    assert odd_ones(photos) == [] and odd_ones(photos[1:]) == []


@pytest.mark.parametrize(("kd", "rho"), [(0.4, 0.12), (0.02, 0.2), (0.7, 0.9)])
def test_a_plain_sample_that_mirrors_each_pattern_is_nobodys_stranger(renderers, kd, rho):
    maps = constant_maps(SIZE, SIZE, kd, 0.04, rho)
    assert odd_ones([shot(maps, r) for r in renderers]) == []


def test_the_odd_one_of_three_is_named_wherever_it_stands(renderers):
    leather, other = kinds("leather", "terrazzo")
    for odd in range(3):
        maps = [other if i == odd else leather for i in range(3)]
        photos = [shot(m, r) for m, r in zip(maps, renderers, strict=True)]
        assert odd_ones(photos) == [odd]


def test_two_samples_are_refused_in_one_sentence(lights, renderers):
    samples = [
        Sample(shot(maps, r).photo, np.zeros((SIZE, SIZE), bool), light)
        for maps, light, r in zip(kinds("leather", "terrazzo"), lights, renderers, strict=False)
    ]
    with pytest.raises(InputError, match="different samples"):
        estimate_maps(samples, Stages(), "flat")
