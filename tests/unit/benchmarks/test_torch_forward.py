"""The baseline in plain PyTorch estimates the integral that the package does."""

import numpy as np
import torch

from benchmarks.baselines.torch_forward import TorchScene
from benchmarks.common.scenes import GAIN, RIG, make_environment, make_maps
from invrender.render import Mis
from invrender.render.scene import make_scene


def test_torch_baseline_agrees_with_mis_after_a_change_of_material():
    n = 8
    rng = np.random.default_rng(1)
    pattern = np.kron(rng.uniform(size=(4, 4, 3)), np.ones((8, 8, 1))).astype(np.float32)
    environment = np.minimum(make_environment("sun", 32), 3.0)
    first, maps = make_maps(n, 0.4, 0.6, 0.0, 0.1), make_maps(n, 0.3, 0.5, 0.5, 0.2)
    expected = Mis(make_scene(RIG, pattern, environment, GAIN)).render(maps, 512)
    scene = TorchScene(RIG, first, pattern, environment, GAIN)
    parts = (maps.diffuse, maps.specular, maps.roughness[..., None], 3 * maps.normal)
    scene.set_material(*(torch.from_numpy(p.reshape(n * n, -1).copy()) for p in parts))
    image = scene.radiance(512, torch.Generator().manual_seed(0)).numpy().reshape(n, n, 3)
    np.testing.assert_allclose(image.mean((0, 1)), expected.mean((0, 1)), rtol=0.02)
    assert np.sqrt(np.mean((image - expected) ** 2)) / expected.mean() < 0.05
