"""What a result says of its maps."""

import numpy as np
import pytest

from invrender.lights import Lights
from invrender.maps import Estimate, constant_maps
from invrender.pattern.default import default_pattern
from invrender.refine.gauss_newton import Refined
from invrender.report.notices import map_notices
from invrender.report.summary import with_light_error
from invrender.rig import Rig


@pytest.mark.parametrize("channels", [(), (3,)])
def test_an_uncertain_mirror_makes_albedos_uncertain(channels):
    maps = constant_maps(4, 5, diffuse=0.5, specular=0.04)
    sigma = {name: np.full((4, 5, *channels), 0.01, np.float32) for name in ("diffuse", "specular")}
    estimate = Estimate(maps, {**sigma, "roughness": np.full((4, 5), 0.1, np.float32)})
    fit = {"light_deviation": 0.03}
    wider = with_light_error(estimate, Lights(Rig(), default_pattern(8), fit=fit))
    np.testing.assert_allclose(wider.sigma["diffuse"], np.hypot(0.01, 0.015), rtol=1e-6)
    np.testing.assert_allclose(wider.sigma["specular"], np.hypot(0.01, 0.0012), rtol=1e-6)
    assert wider.sigma["roughness"] is estimate.sigma["roughness"]
    stated = Lights(Rig(), default_pattern(8), fit={"light_deviation": 0.0})
    assert with_light_error(estimate, stated) is estimate


@pytest.mark.parametrize(
    ("state", "code"),
    [
        ({"interrupted": True, "contradicted": True}, "interrupted"),
        ({"contradicted": True}, "lights-contradicted"),
        ({}, "not-converged"),
        ({"converged": True}, None),
    ],
)
def test_one_sentence_tells_how_the_refinement_ended(state, code):
    refined = Refined(constant_maps(2, 2), np.zeros((2, 2, 9)), **state)
    clipped = np.zeros((2, 2), bool)
    said = map_notices(Lights(Rig(), default_pattern(8)), clipped, refined, "network", 0.0, 0.0)
    assert [notice.code for notice in said] == ([code] if code else [])
