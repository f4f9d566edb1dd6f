import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from invrender.capture.lights import find_lights  # noqa: E402
from invrender.capture.sample import Sample  # noqa: E402
from invrender.data import EXAMPLE  # noqa: E402
from invrender.files.capture import load_capture  # noqa: E402
from invrender.maps import constant_maps, resize_maps  # noqa: E402
from invrender.pattern.default import block_pattern  # noqa: E402
from invrender.pipeline import Stages, estimate_maps, refine_capture  # noqa: E402
from invrender.refine.lobes import fit_lobes  # noqa: E402
from invrender.render import Fast, Material  # noqa: E402
from invrender.render.scene import make_scene, make_view  # noqa: E402
from invrender.rig import Rig  # noqa: E402
from invrender.sampling import resize  # noqa: E402
from nets.batch import positions  # noqa: E402
from nets.correction import (  # noqa: E402
    ALBEDO_CORRELATION,
    INPUT_NOISE,
    INPUTS,
    Correction,
    features,
    gauss_newton,
)
from nets.predict import WEIGHTS, Corrector, linearised  # noqa: E402
from nets.scales import Prediction, enlarged  # noqa: E402
from nets.store import build, load_weights, save_weights  # noqa: E402

SIZE = 12
LOBES = constant_maps(SIZE, SIZE, 0.35, 0.04, 0.45)
torch.set_num_threads(1)


@pytest.fixture(scope="module")
def lit():
    """A prepared scene and the photo of a flat sample in it."""
    renderer = Fast(make_scene(Rig(), block_pattern(64), None, gain=2.0))
    maps = constant_maps(SIZE, SIZE, 0.4, 0.04, 0.4)
    view = make_view(renderer.scene, SIZE, SIZE)
    color = renderer.radiance(view, Material.from_maps(maps), 64)
    return renderer, np.asarray(color).T.reshape(SIZE, SIZE, 3)


def guess(diffuse=0.3, unit=0.7):
    sigma = {"normal": 0.05, "diffuse": 0.1, "roughness": 0.1, "specular": 0.05}
    grids = {k: np.full((SIZE, SIZE), v, np.float32) for k, v in sigma.items()}
    return Prediction(constant_maps(SIZE, SIZE, diffuse, 0.04, 0.5), grids, unit)


def random_batch(dtype=torch.float64):
    torch.manual_seed(1)
    shape = (2, 1, 5, 4)
    rand = lambda n: torch.rand(2, n, 5, 4, dtype=dtype)  # noqa: E731
    return {
        "photo": rand(3),
        "image": rand(3),
        "theta": rand(9),
        "sigma0": 0.02 + 0.2 * rand(4),
        "jacobian": torch.cat([rand(6), rand(9) - 0.5], 1),
        "clipped": torch.zeros(shape, dtype=dtype),
        "lobes": rand(7),
        "position": positions(5, 4)[None].repeat(2, 1, 1, 1).to(dtype),
    }


def test_gauss_newton_is_the_formula():
    b = random_batch()
    residual, step, surprise = gauss_newton(b)
    s = b["sigma0"][1, :, 2, 3].numpy()
    sigma = np.diag([s[1]] * 3 + [s[3]] * 3 + [s[2]] + [2 * s[0]] * 2)
    correlation = np.eye(9)
    for at, rho in zip((0, 3), ALBEDO_CORRELATION, strict=True):
        correlation[at : at + 3, at : at + 3] = rho + (1 - rho) * np.eye(3)
    j = b["jacobian"][1, :, 2, 3].numpy().reshape(5, 3)
    jacobian = np.concatenate([np.diag(j[0]), np.diag(j[1]), j[2:].T], 1)
    photo = b["photo"][1, :, 2, 3].numpy()
    noise = np.diag((INPUT_NOISE[0] * photo) ** 2 + INPUT_NOISE[1] ** 2)
    spread = jacobian @ sigma @ correlation @ sigma @ jacobian.T + noise
    r = photo - b["image"][1, :, 2, 3].numpy()
    white = np.linalg.solve(spread, r)
    expected = correlation @ sigma @ jacobian.T @ white
    np.testing.assert_allclose(residual[1, :, 2, 3].numpy(), r)
    np.testing.assert_allclose(step[1, :, 2, 3].numpy(), expected, rtol=1e-8)
    np.testing.assert_allclose(surprise[1, 0, 2, 3].numpy(), r @ white / 3, rtol=1e-8)


def test_saturated_pixels_say_nothing():
    b = random_batch()
    b["clipped"][:, :, :2] = 1
    residual, step, _ = gauss_newton(b)
    assert not residual[:, :, :2].any() and not step[:, :, :2].any()
    assert step[:, :, 2:].any()


def test_a_fresh_correction_changes_next_to_nothing(lit):
    renderer, photo = lit
    start = guess()
    corrector = Corrector.__new__(Corrector)
    corrector.network = build("correction").eval()
    after = corrector(photo, renderer, start)
    np.testing.assert_allclose(after.maps.diffuse, start.maps.diffuse, atol=0.02)
    np.testing.assert_allclose(after.maps.normal, start.maps.normal, atol=1e-6)
    np.testing.assert_allclose(after.sigma["roughness"], start.sigma["roughness"], rtol=1e-5)


def test_the_step_it_sees_points_at_the_truth(lit):
    """A sample darker than it should be: the proposed step brightens the diffuse albedo."""
    renderer, photo = lit
    inputs = linearised(photo, renderer, guess(0.3), LOBES, None, 64)
    batch = {k: torch.from_numpy(v)[None] for k, v in inputs.items()}
    _, step, _ = gauss_newton(batch)
    assert (step[:, :3] > 0).float().mean() > 0.95
    assert features(batch).shape == (1, INPUTS, SIZE, SIZE)


def test_unit_of_radiance_does_not_matter(lit):
    renderer, photo = lit
    brighter = Fast(make_scene(Rig(), block_pattern(64), None, gain=200.0))
    a = linearised(photo, renderer, guess(unit=0.7), LOBES, None, 64)
    b = linearised(100 * photo, brighter, guess(unit=70.0), LOBES, None, 64)
    for k, v in a.items():
        np.testing.assert_allclose(b[k], v, rtol=2e-3, atol=1e-4, err_msg=k)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, 1e30])
def test_nothing_but_numbers_leaves(value):
    network = build("correction").eval()
    with torch.no_grad():
        for p in network.parameters():
            p.normal_(0, 0.1)
    b = {k: v.float() for k, v in random_batch().items()}
    b["photo"][:, :, 1] = value
    b["image"][:, :, 2] = value
    with torch.inference_mode():
        out = network(b)
    for k, v in out.items():
        assert torch.isfinite(v).all(), k


@pytest.mark.parametrize(("settled", "passes"), [(1.0, 1), (0.0, 3)])
def test_passes_go_on_until_roughness_settles(lit, monkeypatch, settled, passes):
    renderer, photo = lit
    monkeypatch.setattr("nets.predict.SETTLED", settled)
    network = restless()
    corrector = Corrector.__new__(Corrector)
    corrector.network = network
    lobes = fit_lobes(photo, renderer, 64)
    expected = guess()
    for _ in range(passes):
        expected = corrector._step(photo, renderer, expected, lobes, None, 64)
    got = corrector(photo, renderer, guess())
    np.testing.assert_allclose(got.maps.roughness, expected.maps.roughness, atol=1e-6)
    assert np.abs(got.maps.roughness - guess().maps.roughness).mean() > 1e-3


def test_roughness_at_large_is_that_of_the_training_size(lit, monkeypatch):
    """Its large shades are those that a step at `COARSE` finds, its details the step's own."""
    renderer, photo = lit
    monkeypatch.setattr("nets.predict.PASSES", 1)
    corrector = Corrector.__new__(Corrector)
    corrector.network = restless()
    own = corrector(photo, renderer, guess()).maps
    monkeypatch.setattr("nets.predict.COARSE", SIZE // 2)
    both = corrector(photo, renderer, guess()).maps
    low = (SIZE // 2, SIZE // 2)
    lobes = resize_maps(fit_lobes(photo, renderer, 64), *low)
    start = guess()
    start = replace(
        start,
        maps=resize_maps(start.maps, *low),
        sigma={k: resize(v, *low) for k, v in start.sigma.items()},
    )
    coarse = corrector._step(resize(photo, *low), renderer, start, lobes, None, 64).maps.roughness
    shades = resize(coarse - resize(own.roughness, *low), SIZE, SIZE)
    np.testing.assert_allclose(both.roughness, own.roughness + shades, atol=1e-5)
    assert np.abs(shades).max() > 1e-3
    np.testing.assert_array_equal(both.diffuse, own.diffuse)


def test_two_sizes_are_pooled(lit, monkeypatch):
    """Large shades of albedos and roughness are the mean of both corrections; normals stay."""
    renderer, photo = lit
    monkeypatch.setattr("nets.predict.PASSES", 1)
    monkeypatch.setattr("nets.predict.COARSE", SIZE // 2)
    corrector = Corrector.__new__(Corrector)
    corrector.network = restless()
    low = (SIZE // 2, SIZE // 2)
    start = guess()
    small = replace(
        start,
        maps=resize_maps(constant_maps(*start.maps.shape, 0.2, 0.1, 0.3), *low),
        sigma={k: resize(v, *low) for k, v in start.sigma.items()},
    )
    fine = corrector(photo, renderer, start).maps
    coarse = corrector(resize(photo, *low), renderer, small).maps
    both = corrector(photo, renderer, replace(start, coarse=small)).maps
    for name in ("diffuse", "specular", "roughness"):
        own = getattr(fine, name)
        shades = resize(getattr(coarse, name) - resize(own, *low), SIZE, SIZE)
        assert np.abs(shades).max() > 0.05
        mean = np.clip(own + shades / 2, 0, 1)
        np.testing.assert_allclose(getattr(both, name), mean, atol=1e-5)
    np.testing.assert_allclose(both.normal, fine.normal, atol=1e-6)


def restless():
    """A correction that changes something at every pass."""
    torch.manual_seed(2)
    network = build("correction").eval()
    with torch.no_grad():
        network.decoder.ending.weight.normal_(0, 0.1)
    return network


def test_an_interrupted_correction_keeps_the_passes_done(lit, monkeypatch):
    renderer, photo = lit
    monkeypatch.setattr("nets.predict.SETTLED", 0.0)
    corrector = Corrector.__new__(Corrector)
    network, calls = restless(), []

    def stops(batch):
        if calls:
            raise KeyboardInterrupt
        calls.append(batch)
        return network(batch)

    corrector.network = network
    assert not corrector(photo, renderer, guess()).interrupted
    once = corrector._step(photo, renderer, guess(), fit_lobes(photo, renderer, 64), None, 64)
    corrector.network = stops
    best = corrector(photo, renderer, guess())
    assert best.interrupted
    np.testing.assert_allclose(best.maps.diffuse, once.maps.diffuse, atol=1e-6)


def test_of_a_large_photo_the_small_estimate_is_corrected(lit, monkeypatch):
    """What it is corrected to is enlarged to the photo's size."""
    renderer, photo = lit
    corrector = Corrector.__new__(Corrector)
    corrector.network = restless()
    low = (SIZE // 2, SIZE // 2)
    start = guess()
    small = Prediction(
        resize_maps(start.maps, *low), {k: resize(v, *low) for k, v in start.sigma.items()}, 0.7
    )
    whole = corrector(resize(photo, *low), renderer, small)
    monkeypatch.setattr("nets.predict.WHOLE", SIZE // 2)
    found = corrector(photo, renderer, enlarged(small, photo))
    expected = enlarged(whole, photo)
    for name in ("diffuse", "specular", "roughness", "normal"):
        got, new = (getattr(e.maps, name) for e in (found, expected))
        np.testing.assert_allclose(got, new, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(found.sigma["diffuse"], resize(whole.sigma["diffuse"], SIZE, SIZE))


def test_an_interrupted_run_leaves_the_best(tmp_path, monkeypatch):
    def stops(self, batch):
        raise KeyboardInterrupt

    monkeypatch.setattr(Correction, "forward", stops)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt, match="best maps so far"):
        refine_capture(EXAMPLE, out, size=24)
    report = json.loads((out / "report.json").read_text())
    assert report["status"] == "interrupted"
    assert "interrupted" in [w["code"] for w in report["warnings"]]
    assert report["map_error"]["initial"] == pytest.approx(report["map_error"]["refined"], rel=0.05)


def test_an_interrupt_ends_all_photos(monkeypatch):
    sample = Sample.of(find_lights(load_capture(EXAMPLE)), 16)
    calls = []

    def improve(photo, renderer, estimate, *_):
        calls.append(photo)
        return replace(estimate, interrupted=True)

    monkeypatch.setattr("nets.predict.Corrector", lambda: improve)
    maps, result, _ = estimate_maps([sample, sample], Stages())
    assert len(calls) == 1 and result.interrupted
    np.testing.assert_allclose(result.maps.diffuse, maps.diffuse, atol=0.02)


def test_the_border_gets_no_frame():
    """A uniform picture, from which the shipped correction moves far, moves alike everywhere."""
    network, _ = load_weights(WEIGHTS / "correction.safetensors")
    values = {
        "photo": [0.3] * 3,
        "image": [0.2] * 3,
        "theta": [0.2] * 3 + [0.04] * 3 + [0.7, 0, 0],
        "sigma0": [0.05, 0.05, 0.1, 0.02],
        "jacobian": [1.0] * 3 + [0.5] * 3 + [-0.05] * 3 + [0.0] * 6,
        "clipped": [0.0],
        "lobes": [0.2] * 3 + [0.04] * 3 + [0.3],
        "position": [0.0, 0.0],
    }
    batch = {k: torch.tensor(v)[:, None, None].expand(1, -1, 64, 48) for k, v in values.items()}
    with torch.inference_mode():
        out = network(batch)["roughness"][0, 0]
    assert float((out[32, 24] - 0.7).abs()) > 0.05
    assert float((out - out[32, 24]).abs().max()) < 0.02


def test_weights_come_back(tmp_path):
    network = build("correction")
    save_weights(tmp_path / "c.safetensors", network, {})
    again, _ = load_weights(tmp_path / "c.safetensors")
    assert type(again) is type(network)
    for k, v in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[k], v)


def test_lobes_are_followed_where_trusted(lit):
    """With its doubt taken away, the correction gives the lobes' albedo and roughness."""
    renderer, photo = lit
    network = build("correction").eval()
    with torch.no_grad():
        network.decoder.ending.bias[13:] = 50
    batch = linearised(photo, renderer, guess(), LOBES, None, 64)
    with torch.inference_mode():
        out = network({k: torch.from_numpy(v)[None] for k, v in batch.items()})
    np.testing.assert_allclose(out["roughness"][0, 0].numpy(), LOBES.roughness, atol=1e-5)
    np.testing.assert_allclose(out["diffuse"][0, 0].numpy(), LOBES.diffuse[..., 0], atol=1e-5)
