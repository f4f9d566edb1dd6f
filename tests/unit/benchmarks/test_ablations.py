import math

import pytest

torch = pytest.importorskip("torch")

from benchmarks.baselines.ablations import VARIANTS, Paper, WithoutLobes  # noqa: E402
from invrender.types import InputError  # noqa: E402
from nets.batch import unpack_evidence  # noqa: E402
from nets.model import DIELECTRIC_F0  # noqa: E402
from nets.store import CONFIGS, build, load_weights, save_weights  # noqa: E402
from nets.training.dataset import write_shard  # noqa: E402
from nets.training.draw import Options  # noqa: E402
from nets.training.loader import read_batch  # noqa: E402
from nets.training.train import take_up  # noqa: E402

torch.set_num_threads(1)
TINY = CONFIGS["tiny"][1]


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    path = write_shard(tmp_path_factory.mktemp("shard"), 0, Options(size=16, samples=4), 2)
    return next(read_batch(path, 2))


@pytest.mark.parametrize("name", [*VARIANTS, "paper"])
def test_every_variant_trains(batch, name):
    """One step lowers the loss of its own batch; all weights that it has get a gradient."""
    torch.manual_seed(0)
    kind, loss = VARIANTS.get(name, (Paper, VARIANTS["ours with denoiser"][1]))
    network = kind(TINY)
    optimiser = torch.optim.SGD(network.parameters(), 1e-4)
    before, parts = loss(network(batch), batch)
    before.backward()
    grads = {k: p.grad for k, p in network.named_parameters()}
    assert all(g is not None and torch.isfinite(g).all() for g in grads.values())
    assert ("denoised" in parts) == (name in ("paper", "ours with denoiser"))
    optimiser.step()
    assert loss(network(batch), batch)[0] < before


def test_ablations_weights_are_not_the_programs(tmp_path):
    save_weights(tmp_path / "w.safetensors", WithoutLobes(TINY), {})
    with pytest.raises(InputError, match="ablation"):
        load_weights(tmp_path / "w.safetensors")


def test_a_network_grows_by_inputs_that_begin_at_nought(batch):
    """And by outputs that hardly count: what the photo says of dielectric and metal."""
    torch.manual_seed(1)
    known, grown = WithoutLobes(TINY).eval(), build("tiny").eval()
    take_up(grown, known)
    with torch.no_grad():
        grown.costs[-1].weight.zero_(), grown.costs[-1].bias.zero_()
    a, b = grown(batch), known(batch)
    torch.testing.assert_close(a["sigma"], b["sigma"])
    more = grown.encoder.intro.weight.shape[1] - known.encoder.intro.weight.shape[1]
    assert more == 7 + 16 and not grown.encoder.intro.weight[:, -more:].any()
    # Two readings of weight e^-4 each beside the network's own of weight one.
    own, metal = b["specular"].detach(), unpack_evidence(batch).metal_material_specular
    share = math.exp(-4) / (1 + 2 * math.exp(-4))
    most = share * ((DIELECTRIC_F0 - own).abs() + (metal - own).abs())
    off = (a["specular"] - b["specular"]).detach().abs()
    assert off.max() > 0 and (off <= most + 1e-6).all()
