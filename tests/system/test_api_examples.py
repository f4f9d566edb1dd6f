"""What docs/guide/python.md shows: the public names at work, and that the results are right."""

from dataclasses import replace

import numpy as np
import pytest

import invrender
from invrender.data import EXAMPLE

RIG = invrender.Rig()


@pytest.fixture(scope="module")
def lights():
    """A display of coloured blocks in a bright room."""
    from invrender.data import procedural_environment, scale_environment
    from invrender.pattern.default import block_pattern

    room = scale_environment(procedural_environment(0, 32), 0.5)
    return invrender.Lights(RIG, block_pattern(64), room, gain=2.0)


@pytest.fixture(scope="module")
def capture():
    return invrender.load_capture(EXAMPLE)


@pytest.fixture(scope="module")
def result(capture):
    return invrender.reconstruct(invrender.find_lights(capture), size=64)


def test_reconstruct_a_capture(capture, result):
    assert result.report.status == "done" and result.report.capture == "example"
    found = invrender.evaluate(result.estimate, capture.truth)
    assert found["maps"]["average"] < 0.07
    assert found["rerender"]["rmse"] < 0.1
    assert all(0.3 < share <= 1 for share in found["calibration"].values())
    assert found["maps"] == {
        name: pytest.approx(error) for name, error in result.report.map_error["refined"].items()
    }


def test_a_saved_result_is_rendered_again(result, tmp_path):
    result.save(tmp_path / "out")
    again = invrender.Result.load(tmp_path / "out")
    np.testing.assert_allclose(again.render(), result.render(), rtol=2e-4, atol=1e-5)
    np.testing.assert_allclose(again.render(), result.rendering, rtol=2e-4, atol=1e-5)
    for name, sigma in result.estimate.sigma.items():
        np.testing.assert_array_equal(again.estimate.sigma[name], sigma)
    assert again.report == replace(result.report, seconds=again.report.seconds)
    assert again.lights.fit == pytest.approx(result.lights.fit)
    assert again.lights.rig == result.lights.rig
    # In a dark room, under the display at half its brightness: half the display's share.
    dark = np.zeros_like(again.lights.environment)
    screen = replace(again.lights, environment=dark)
    half = replace(screen, gain=again.lights.gain / 2)
    np.testing.assert_allclose(again.render(half), again.render(screen) / 2, rtol=1e-3)
    assert again.render(screen).mean() < again.render().mean()
    again.save(tmp_path / "copy")
    assert invrender.Result.load(tmp_path / "copy").report == again.report


def test_optimise_own_maps_with_drjit(lights):
    """Roughness from a constant start, everything else known: every pixel finds its own."""
    import drjit as dr
    from drjit.opt import Adam

    from invrender.maps import constant_maps
    from invrender.render import Fast, Material, make_view

    truth = constant_maps(24, 24, diffuse=0.3, specular=0.3, roughness=0.3)
    truth.roughness[:, 12:] = 0.5
    start = constant_maps(24, 24, diffuse=0.3, specular=0.3, roughness=0.4)

    renderer = Fast.under(lights)
    view, known = make_view(renderer.scene, 24, 24), Material.from_maps(start)
    photo = type(known.diffuse)(renderer.render(truth).reshape(-1, 3).T)
    opt = Adam(lr=0.01, params={"roughness": known.roughness})
    for _ in range(60):
        material = replace(known, roughness=opt["roughness"])
        error = renderer.radiance(view, material, samples=64) - photo
        dr.backward(dr.sum(dr.squared_norm(error)))
        opt.step()
    found = np.array(opt["roughness"]).reshape(24, 24)

    assert np.abs(start.roughness - truth.roughness).mean() == pytest.approx(0.1)
    assert np.abs(found - truth.roughness).mean() < 0.02


def test_optimise_own_maps_with_torch(lights):
    import torch

    from invrender.maps import constant_maps
    from invrender.render import Fast
    from invrender.render.torch import Renderer

    truth = constant_maps(24, 24, diffuse=0.3, specular=0.3, roughness=0.3)
    truth.roughness[:, 12:] = 0.5
    start = constant_maps(24, 24, diffuse=0.3, specular=0.3, roughness=0.4)

    renderer = Renderer(Fast.under(lights))
    names = ("diffuse", "specular", "roughness", "normal")
    diffuse, specular, roughness, normal = (torch.from_numpy(getattr(start, n)) for n in names)
    photo = renderer(*(torch.from_numpy(getattr(truth, n)) for n in names))
    roughness.requires_grad_()
    opt = torch.optim.Adam([roughness], lr=0.01)
    for _ in range(60):
        opt.zero_grad()
        loss = ((renderer(diffuse, specular, roughness, normal) - photo) ** 2).sum()
        loss.backward()
        opt.step()

    assert np.abs(roughness.detach().numpy() - truth.roughness).mean() < 0.02


def test_draw_training_data():
    from nets.training.dataset import Options, make_group

    samples = make_group(np.random.default_rng(0), Options(size=32, per_room=2, samples=16))
    assert 1 <= len(samples) <= 2
    assert samples[0]["photo"].shape == (3, 32, 32)


def test_a_result_takes_nothing_from_the_one_that_it_replaces(result, tmp_path):
    """Lights that a person states have no coverage, which those from a ball have."""
    result.save(tmp_path / "out")
    stated = replace(result, lights=replace(result.lights, coverage=None))
    stated.save(tmp_path / "out")
    assert invrender.Result.load(tmp_path / "out").lights.coverage is None


def test_simulate_and_load(tmp_path):
    from invrender.data import procedural_environment, procedural_material
    from invrender.pattern.default import default_pattern

    maps = procedural_material(3, 64, 64, kind="plastic")
    room, pattern = procedural_environment(0, 32), default_pattern(64)
    invrender.simulate(tmp_path / "new", maps, room, pattern, RIG, width=320, spp=4)
    capture = invrender.load_capture(tmp_path / "new")
    assert capture.truth.shape == (64, 64) and capture.name == "new"
    np.testing.assert_allclose(capture.truth.roughness, maps.roughness, atol=1e-3)


def test_render_is_linear_in_the_lights(lights):
    maps = invrender.Maps(
        *(np.full((8, 8, 3), v, np.float32) for v in (0.5, 0.04)),
        np.full((8, 8), 0.5, np.float32),
        np.broadcast_to(np.float32([0, 0, 1]), (8, 8, 3)),
    )
    image = invrender.render(maps, lights)
    twice = replace(lights, gain=4.0, environment=2 * lights.environment)
    np.testing.assert_allclose(invrender.render(maps, twice), 2 * image, rtol=1e-4)


def test_a_folder_without_a_whole_result_is_refused(result, tmp_path):
    with pytest.raises(invrender.InputError, match=r"report\.json"):
        invrender.Result.load(tmp_path)
    result.save(tmp_path / "out")
    (tmp_path / "out" / "report.json").write_text("{}")
    with pytest.raises(invrender.InputError, match="another version"):
        invrender.Result.load(tmp_path / "out")
