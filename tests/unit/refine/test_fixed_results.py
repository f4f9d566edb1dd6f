"""Results of the refinement on one small sample are those that were stored.

What a stage does is tested elsewhere, by physics; here nothing may change unnoticed: a sign, a
limit, a number of the settings. Whoever means to change a result runs this file as a program, which
stores them anew, and says in the commit what became better.
"""

import json
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from invrender.data.environments import procedural_environment
from invrender.lights import Lights
from invrender.maps import constant_maps
from invrender.pattern.sets import pattern_set
from invrender.refine.checks import baked_light, coarse_error
from invrender.refine.flat import plane_terms
from invrender.refine.gauss_newton import Observation, refine
from invrender.refine.lobes import _plainness, fit_lobes, read_lobes
from invrender.refine.mirrors import take_mirrors
from invrender.refine.pixels import TOGETHER
from invrender.refine.posterior import explain
from invrender.refine.priors import lobe_prior, network_prior, pooled
from invrender.refine.registration import register
from invrender.refine.several import explain_together
from invrender.refine.shared import share
from invrender.refine.texture import without_light
from invrender.refine.theta import N, R, deviations, to_maps, to_theta
from invrender.render.fast.estimator import Fast
from invrender.rig import Rig
from invrender.sphere import scale_environment

STORED = Path(__file__).with_suffix(".json")
SIZE = 24
CLOSE = 2e-3  # relative to an image's own scale: single precision, other processors
FAR = {"together": 1e-2, "registered": 1e-2}  # the same, where many steps add up


@cache
def lights(k=0):
    room = scale_environment(procedural_environment(3, 64), 0.3)
    room[12:14, 30:32] += 60
    lamps = np.zeros_like(room)
    lamps[12:14, 30:32] = room[12:14, 30:32]
    return Lights(Rig(), pattern_set(3, 32)[k], room, 2.0, lamps=lamps)


@cache
def renderer(k=0):
    return Fast.under(lights(k))


def sample():
    """Paint, polished metal and a mixed border, with texture, relief and a dark corner."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    maps = constant_maps(SIZE, SIZE, (0.4, 0.25, 0.1), 0.04, 0.45)
    metal = np.clip((x - 0.55) * 12, 0, 1).astype(np.float32)[..., None]
    maps.diffuse *= (1 - metal) * (1 + 0.3 * rng.uniform(-1, 1, (SIZE, SIZE, 1))).astype(np.float32)
    maps.specular = (1 - metal) * maps.specular + metal * np.float32((0.9, 0.75, 0.5))
    maps.roughness = (0.45 - 0.3 * metal[..., 0] + 0.03 * np.sin(9 * y)).astype(np.float32)
    maps.diffuse[:6, :6] *= 0.1
    theta = to_theta(maps)
    theta[..., 7] += 0.12 * np.sin(20 * y)
    theta[..., 8] += 0.08 * np.cos(25 * x)
    return to_maps(theta)


@cache
def photo(k=0):
    shown = renderer(k).render(sample(), 64)
    noise = np.random.default_rng(7 + k).standard_normal(shown.shape)
    return np.asarray(shown * (1 + 0.01 * noise), np.float32)


@cache
def prior(off=1.0):
    """Of a network that is too rough, too dark and too flat, and blurs f0."""
    theta = to_theta(sample())
    theta[..., R] += 0.08 * off
    theta[..., :3] *= 1 - 0.15 * off
    theta[..., 3:6] = 0.8 * theta[..., 3:6] + 0.2 * np.roll(theta[..., 3:6], 3, 1)
    theta[..., N] *= 0.4
    level = np.linspace(0.5, 1.5, SIZE, dtype=np.float32)[:, None] * np.ones(SIZE, np.float32)
    sigma = {"diffuse": 0.04, "specular": 0.05, "roughness": 0.07, "normal": 0.03}
    return network_prior(to_maps(theta), {n: v * level for n, v in sigma.items()})


def shot(k=0, doubt=(0.0, 0.0), lamps=None, gain=1.0):
    clipped = np.zeros((SIZE, SIZE), bool)
    clipped[-3:, :5] = True
    return Observation(gain * photo(k), renderer(k), clipped, doubt, lamps)


def of_prior(p):
    return {"mean": p.mean, "sigma": p.sigma, "expected": p.expected}


def of_refined(r):
    sigmas = {f"sigma of {n}": x for n, x in deviations(r.sigma).items()}
    return {**r.maps.encoded(), **sigmas, "sigma": r.sigma}


def several():
    return [Observation((1.0, 1.04, 0.97)[k] * photo(k), renderer(k)) for k in range(3)]


def shared():
    found = share([shot(doubt=(0.01, 0.1), lamps=lights().lamps, gain=1.05)], prior())
    factors = {f"factor {i}": np.array(f) for i, f in enumerate(found.factors)}
    return {**of_prior(found.prior), **factors, "misfit": np.array(found.misfit)}


def pixels():
    found = refine([shot()], prior(0.5))
    history = np.array([[h["photo_error"], h["cost"]] for h in found.history])
    return {**of_refined(found), "history": history}


def lobes():
    found = read_lobes(photo(), renderer())
    plain = fit_lobes(photo(), renderer())
    e, b, a = plane_terms(renderer(), 16, 16, 0.2, 64)
    small = photo()[:16, :16]
    b[:4] *= 1e-3  # where nothing is mirrored
    texture = np.array([_plainness(small, e, b, a, metal) for metal in (False, True)])
    return {**vars(found.evidence), **found.maps.encoded(), "texture": texture,
            **{f"fitted {n}": x for n, x in plain.encoded().items()}}  # fmt: skip


def mirrors():
    found = take_mirrors(shot(), prior(2.0), sample())
    whole = constant_maps(SIZE, SIZE, 0.0, (0.9, 0.8, 0.6), 0.1)
    seen = Observation(renderer().render(whole, 64), renderer())
    return {**of_prior(found), **{f"whole {n}": x for n, x in of_prior(
        take_mirrors(seen, prior(2.0), whole)).items()}}  # fmt: skip


def together():
    found = explain_together(several(), prior(), s=replace(TOGETHER, whole=16))  # two sizes
    return {**of_refined(found), "errors": np.array(found.photo_errors)}


def registered():
    moved = [several()[0]]
    for o, by in zip(several()[1:], (1, -1), strict=True):
        moved.append(Observation(np.roll(o.photo, by, 1), o.renderer))
    found = register(moved, prior().mean)
    return {"places": np.array(found.places), "factors": np.array(found.factors)}


def checked():
    shown = renderer().render(to_maps(prior().mean), 64)
    return {
        "coarse": np.array(coarse_error(shown, photo(), np.zeros((SIZE, SIZE), bool))),
        "baked": np.array(baked_light(0.2 / (0.3 + photo()), renderer())),
        "lobe": lobe_prior(sample()).sigma,
        "pooled": pooled([prior(), prior(0.5)]).mean,
        "total": pooled([prior(), prior(0.5)]).expected,
    }


def light():
    with patch("invrender.refine.theta.DIELECTRIC_PART", 0.3):
        return of_prior(without_light([shot()], prior(), prior().mean[..., R] + 0.05))


def mixed():
    return of_refined(explain([shot()], prior()))


CASES = {
    f.__name__: f
    for f in (shared, light, mixed, pixels, lobes, mirrors, checked, together, registered)
}


def numbers(image):
    """A few sums that any change of an image changes."""
    x = np.asarray(image, np.float64).ravel()
    weights = np.random.default_rng(x.size).uniform(-1, 1, (3, x.size))
    sums = [x.mean(), np.abs(x).max(), x.std(), *(weights @ x / max(x.size, 1) ** 0.5)]
    return [float(f"{v:.7g}") for v in sums]


@pytest.mark.parametrize("name", CASES)
def test_results_are_as_stored(name):
    stored = json.loads(STORED.read_text())[name]
    found = {n: numbers(x) for n, x in CASES[name]().items()}
    assert list(found) == list(stored)
    for n, values in found.items():
        scale = max(abs(stored[n][1]), 1e-6)  # the greatest number of the image
        close = FAR.get(name, CLOSE) * scale
        np.testing.assert_allclose(values, stored[n], rtol=0, atol=close, err_msg=n)


if __name__ == "__main__":
    kept = json.loads(STORED.read_text()) if STORED.exists() else {}
    for case in sys.argv[1:] or CASES:
        kept[case] = {n: numbers(x) for n, x in CASES[case]().items()}
    STORED.write_text(json.dumps(kept, indent=1) + "\n")
