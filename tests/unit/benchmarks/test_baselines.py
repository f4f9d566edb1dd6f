"""The methods that the paper is compared with, and the flash photos that some of them need."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benchmarks.baselines import deepbasis, matfusion, methods, train  # noqa: E402
from benchmarks.baselines.flash import (  # noqa: E402
    ABOVE,
    add_flash,
    flash_render,
    maps_of,
    room_of,
    shrunk,
)
from invrender.maps import map_errors  # noqa: E402
from invrender.refine.theta import to_theta  # noqa: E402
from invrender.render.point_lights import relight  # noqa: E402
from invrender.sphere import directions  # noqa: E402
from nets.batch import positions  # noqa: E402
from nets.clues import ball_image  # noqa: E402
from nets.training.dataset import write_shard  # noqa: E402
from nets.training.draw import Options  # noqa: E402
from nets.training.loader import load_shards, read_batch  # noqa: E402

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def shard(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flash")
    source = write_shard(tmp_path_factory.mktemp("plain"), 0, Options(size=16, samples=4), 2)
    add_flash(source, folder / source.name)
    return folder / source.name


@pytest.fixture
def batch(shard):
    return next(read_batch(shard, 2))


def test_flash_in_torch_is_the_programs_brdf(shard):
    maps = maps_of(load_shards([shard], torch.device("cpu"))["maps"][0].numpy())
    maps.roughness[...] = np.maximum(maps.roughness, 0.1)
    expected = relight(maps, ABOVE, np.array([ABOVE.camera]))[0]
    theta = torch.from_numpy(to_theta(maps)).permute(2, 0, 1)[None].double()
    found = flash_render(theta, positions(16, 16)[None].double())[0].permute(1, 2, 0).numpy()
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-5)


def test_room_is_what_the_ball_shows():
    """A bright quarter of the sky comes back from its ball's image where it was."""
    sky = np.zeros((64, 128, 3), np.float32)
    sky[:32, 20:40] = 1, 2, 3
    room = room_of(np.moveaxis(ball_image(sky, 64), -1, 0))
    mean = lambda x: (x.mean(-1, keepdims=True) * directions(*x.shape[:2])).sum((0, 1))  # noqa: E731
    a, b = mean(sky), mean(room)
    cos = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
    assert cos > 0.995 and not room[16:].any()


def test_flash_photos_are_brighter_than_the_room(batch):
    assert batch["flash"].shape == batch["room"].shape == batch["photo"].shape
    assert (batch["flash"].mean((1, 2, 3)) > batch["room"].mean((1, 2, 3))).all()


def test_shrinking_averages():
    x = np.arange(128 * 128, dtype=np.float32).reshape(1, 128, 128)
    assert shrunk(x).shape == (1, 64, 64) and shrunk(x)[0, 0, 0] == x[0, :2, :2].mean()
    assert shrunk(x[:, :48, :48]).shape == (1, 48, 48)


@pytest.mark.parametrize("name", methods.METHODS)
def test_every_method_trains(batch, name):
    """One step lowers the loss of its own batch; all weights get a gradient, but those behind
    blocks that begin as the identity."""
    torch.manual_seed(0)
    network, loss = methods.fresh(name), methods.METHODS[name][1]
    optimiser = torch.optim.SGD(network.parameters(), 1e-4)
    network.train()
    torch.manual_seed(1)
    before, _ = loss(network(batch), batch)
    before.backward()
    assert all(torch.isfinite(p.grad).all() for p in network.parameters() if p.grad is not None)
    optimiser.step()
    torch.manual_seed(1)
    assert loss(network(batch), batch)[0] < before
    network.eval()
    with torch.no_grad():
        out = network(batch)
    assert out["diffuse"].shape == batch["photo"].shape
    torch.testing.assert_close(out["normal"].norm(dim=1), torch.ones(2, 16, 16))


def test_basis_refinement_explains_the_photo(batch):
    """The photo of the network's own maps, brighter: its bases alone explain it again."""
    torch.manual_seed(0)
    network = methods.fresh("deepbasis+").eval()
    theta = deepbasis.mixed(*[x.detach() for x in network.decompose(batch)])
    brighter = torch.cat([theta[:, :3] * 1.05, theta[:, 3:]], 1)
    batch = {**batch, "flash": flash_render(brighter, batch["position"])}

    def misfit(out):
        parts = [out["diffuse"], out["specular"], out["roughness"]]
        slopes = out["normal"][:, :2] / out["normal"][:, 2:]
        shown = flash_render(torch.cat([*parts, slopes], 1), batch["position"])
        return float((shown - batch["flash"]).abs().mean())

    with torch.no_grad():
        first = misfit(network(batch))
    assert misfit(deepbasis.refine(network, batch, 150)) < 0.7 * first


def test_diffusion_finds_the_maps_that_its_velocity_knows(batch):
    """With the exact velocity towards known maps a draw ends at them, whatever the seed."""
    network = methods.fresh("matfusion").eval()
    goal = matfusion.packed(batch)

    def exact(x, time, _):
        signal, spread = matfusion.schedule(time)
        noise = (x - signal * goal) / spread.clamp(min=1e-6)
        return signal * noise - spread * goal

    network.velocity = exact
    expected = maps_of(batch["maps"][0].numpy())
    for seed in (0, 1):
        out = network.draw(batch, seed)
        shown = {k: v[0].permute(1, 2, 0).numpy() for k, v in out.items()}
        shown["roughness"] = shown["roughness"][..., 0]
        found = type(expected)(**{k: shown[k] for k in vars(expected)})
        errors = map_errors(found, expected)
        assert max(errors.values()) < 0.01


def test_training_goes_on_where_it_stopped(shard, tmp_path):
    arguments = ["lpl+", "--data", str(shard.parent), "--out", str(tmp_path), "--batch", "2"]
    first = train.train(train.parser().parse_args([*arguments, "--minutes", "0.003"]))
    more = str(first.seconds / 60 + 0.003)  # a step may have taken longer than its budget
    again = train.train(train.parser().parse_args([*arguments, "--minutes", more]))
    assert again.step > first.step >= 1 and again.seconds > first.seconds


def test_missing_weights_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(methods, "WEIGHTS", tmp_path)
    with pytest.raises(methods.InputError, match=r"benchmarks\.baselines\.train ours"):
        methods.weights_of("ours")
    with pytest.raises(methods.InputError, match="no method"):
        methods.fresh("theirs")
