import numpy as np
import pytest

torch = pytest.importorskip("torch")

from forward_scenes import (  # noqa: E402
    ESTIMATORS,
    rendered,
    some_environment,
    some_maps,
    some_pattern,
)

from invrender.render.backend import Float, ad  # noqa: E402
from invrender.render.scene import make_scene, make_view  # noqa: E402
from invrender.render.torch import Renderer  # noqa: E402
from invrender.rig import Rig  # noqa: E402

N = 6


def setup(scalar, estimator="fast"):
    scene = make_scene(Rig(), some_pattern(), some_environment(), 2.0, scalar=scalar)
    maps = some_maps(N, "tilted")
    dtype = torch.float64 if scalar is ad.Float64 else torch.float32
    tensors = [
        torch.tensor(getattr(maps, k), dtype=dtype)
        for k in ("diffuse", "specular", "roughness", "normal")
    ]
    return Renderer(ESTIMATORS[estimator](scene)), make_view(scene, N, N), maps, tensors


def test_values_are_the_renderers():
    renderer, view, maps, tensors = setup(Float)
    expected = rendered(Rig(), maps, some_pattern(), some_environment(), 2.0, samples=16)
    color = renderer(*tensors, samples=16)
    assert color.shape == (N, N, 3) and not color.requires_grad
    assert np.allclose(color.numpy(), expected, rtol=1e-5)
    flat = [t.reshape(N * N, -1) for t in tensors]
    flat[0].requires_grad_()
    color = renderer(*flat, samples=16, view=view)
    assert color.shape == (N * N, 3) and color.requires_grad
    assert np.allclose(color.detach().numpy().reshape(N, N, 3), expected, rtol=1e-5)


@pytest.mark.parametrize("estimator", ["fast", "mis"])
def test_gradients_match_differences(estimator):
    """Along random directions of all four maps, as torch.autograd.gradcheck's fast mode does."""
    renderer, _, _, tensors = setup(ad.Float64, estimator)
    weights = torch.randn(N, N, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for k, name in enumerate(("diffuse", "specular", "roughness", "normal")):
        if estimator == "mis" and k > 1:
            continue  # its samples follow the roughness and the normal
        leaves = [t.clone().requires_grad_(i == k) for i, t in enumerate(tensors)]
        torch.sum(renderer(*leaves, samples=16) * weights).backward()
        direction = torch.randn_like(tensors[k])
        h = 1e-6

        def value(step, k=k, direction=direction, h=h):
            moved = [t + step * h * direction if i == k else t for i, t in enumerate(tensors)]
            return torch.sum(renderer(*moved, samples=16) * weights)

        difference = (value(1) - value(-1)) / (2 * h)
        found = torch.sum(leaves[k].grad * direction)
        assert found.item() == pytest.approx(difference.item(), rel=1e-5), name


def test_a_wrong_precision_is_refused():
    renderer, _, _, tensors = setup(Float)
    with pytest.raises(TypeError, match="float32"):
        renderer(*(t.double() for t in tensors), samples=16)
