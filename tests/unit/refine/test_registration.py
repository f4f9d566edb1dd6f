"""Photos of one sample under other lights, brought onto each other."""

import numpy as np
import pytest
from scipy import ndimage

from invrender.capture.placement import find_shift, find_turn
from invrender.data.environments import procedural_environment
from invrender.data.materials import procedural_material
from invrender.lights import Lights
from invrender.maps import constant_maps
from invrender.pattern.sets import pattern_set
from invrender.refine.flat import flat_maps
from invrender.refine.gauss_newton import Observation
from invrender.refine.registration import apply_place, factor_image, plane_grid, register
from invrender.refine.theta import to_theta
from invrender.render.fast.estimator import Fast
from invrender.rig import Rig
from invrender.sampling import resize
from invrender.sphere import scale_environment

SIZE, FINE = 48, 144
TENTH = 0.1 / (SIZE / 2)  # of a pixel, in halves of the side


@pytest.fixture(scope="module")
def renderers():
    room = scale_environment(procedural_environment(3, 64), 0.3)
    return [Fast.under(Lights(Rig(), p, room, 2.0)) for p in pattern_set(3, 32)]


def drawn_place(rng, shift=0.03, slope=0.01):
    place = np.eye(3) + np.pad(slope * rng.standard_normal((2, 2)), (0, 1))
    place[:2, 2] = shift * rng.uniform(-1, 1, 2)
    place[2, :2] = 0.002 * rng.standard_normal(2)
    return place


def moved(photo, place):
    """A fine photo that shows at ``place`` what stood where it was, as SIZE² means."""
    x, y = apply_place(np.linalg.inv(place), *plane_grid(FINE, FINE))
    at = [(1 - y) * FINE / 2 - 0.5, (x + 1) * FINE / 2 - 0.5]
    photo = ndimage.gaussian_filter(photo, (2, 2, 0))  # two thirds of a pixel, as lenses blur
    planes = [ndimage.map_coordinates(photo[..., c], at, order=3, mode="nearest") for c in range(3)]
    return resize(np.maximum(np.stack(planes, -1), 0).astype(np.float32), SIZE, SIZE)


def off(place, true):
    """RMS distance of two homographies over the square, in halves of its side."""
    a, b = (apply_place(h, *plane_grid(12, 12)) for h in (place, true))
    return float(np.sqrt(np.mean((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)))


def photographed(maps, renderers, places, noise=0.005):
    rng = np.random.default_rng(1)
    shots = []
    for k, (renderer, place) in enumerate(zip(renderers, places, strict=True)):
        photo = moved(renderer.render(maps, 64), place)
        photo = photo * factor_image(np.array([[0.04 * k, 0.02, 0]] * 3), SIZE, SIZE)
        photo = photo * (1 + noise * rng.standard_normal(photo.shape).astype(np.float32))
        shots.append(Observation(photo, renderer))
    return shots


def test_photos_under_other_lights_are_registered_to_a_tenth_of_a_pixel(renderers):
    rng = np.random.default_rng(2)
    places = [np.eye(3), *(drawn_place(rng) for _ in renderers[1:])]
    maps = procedural_material(5, FINE, FINE, kind="leather")
    shots = photographed(maps, renderers, places)
    start = to_theta(flat_maps(shots[0].photo, shots[0].renderer))
    found = register(shots, start)
    assert np.array_equal(found.places[0], np.eye(3)) and found.deviations[0] == 0
    errors = [off(p, t) for p, t in zip(found.places[1:], places[1:], strict=True)]
    assert min(off(np.eye(3), t) for t in places[1:]) > 2 * TENTH  # they were not before
    assert max(errors) < TENTH
    assert np.all(errors < 3 * found.deviations[1:]) and found.deviations.max() < 2 * TENTH
    drift = found.factors[:, :, 0].mean(1) - found.factors[:, :, 0].mean()
    np.testing.assert_allclose(drift, 0.04 * (np.arange(3) - 1), atol=0.025)


def test_a_sample_without_texture_stays_where_it_is_and_is_said_to_be_uncertain(renderers):
    shots = photographed(constant_maps(FINE, FINE, 0.4, 0.04, 0.6), renderers, [np.eye(3)] * 3)
    found = register(shots, to_theta(flat_maps(shots[0].photo, shots[0].renderer)))
    assert max(off(p, np.eye(3)) for p in found.places) < 2 * TENTH
    assert found.deviations[1:].min() > TENTH


@pytest.mark.parametrize("degrees", [0.0, 37.0, 90.0, -151.0])
def test_a_sample_turned_by_any_angle_is_found(renderers, degrees):
    maps = procedural_material(5, FINE, FINE, kind="leather")
    maps.diffuse *= np.linspace(0.3, 1, FINE, dtype=np.float32)[:, None, None]
    first, second = (r.render(maps, 32) for r in renderers[:2])
    second = ndimage.rotate(second, degrees, reshape=False, order=1, mode="reflect")
    found = find_turn(resize(second, 64, 64), resize(first, 64, 64))
    assert abs((found - degrees + 180) % 360 - 180) < 2.0


def test_a_shift_under_other_lights_is_found_and_none_where_nothing_is_alike(renderers):
    maps = procedural_material(5, 160, 160, kind="bricks")
    first, second = (r.render(maps, 32) for r in renderers[1:3])
    seen = (np.ones((96, 96), bool),) * 2
    # What lies 12 pixels further right and 7 further up in the second.
    shift, alike = find_shift(second[27:123, 8:104], first[20:116, 20:116], seen)
    np.testing.assert_allclose(shift * 48, [12, 7], atol=0.6)
    assert alike > 0.3
    other = procedural_material(6, 160, 160, kind="terrazzo")
    nothing, alike = find_shift(renderers[0].render(other, 32)[:96, :96], first[:96, :96], seen)
    assert alike < 0.15 and not nothing.any()
