"""NAFNet's block, and encoders and decoders of such blocks.

Chen et al. 2022, "Simple Baselines for Image Restoration". Tensors are (B, C, H, W); H and W must
be multiples of 2^levels, see `pad_to`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Pointwise(nn.Module):
    """1×1 convolution as a matrix product over channels-last memory: torch's own is slower there.

    ``scale`` (out,) multiplies the outputs, at the cost of scaling the weights.
    """

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(outputs, inputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(outputs).uniform_(-bound, bound)) if bias else None

    def forward(self, x: Tensor, scale: Tensor | None = None) -> Tensor:
        x = x.permute(0, 2, 3, 1)
        if scale is None:
            y = F.linear(x, self.weight, self.bias)
        else:
            bias = None if self.bias is None else self.bias * scale
            y = F.linear(x, self.weight * scale[:, None], bias)
        return y.permute(0, 3, 1, 2)


class LayerNorm2d(nn.Module):
    """Normalises each pixel over its channels."""

    def __init__(self, channels: int, eps: float = 1e-6) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        # Channels last is the memory layout of all activations, so the permutations are free.
        x = x.permute(0, 2, 3, 1)
        y = F.layer_norm(x, self.weight.shape, self.weight, self.bias, self.eps)
        return y.permute(0, 3, 1, 2)


def simple_gate(x: Tensor) -> Tensor:
    """Product of the two halves of the channels."""
    a, b = x.chunk(2, dim=1)
    return a * b


class NAFBlock(nn.Module):
    """y = x + β·W₃(SCA(SG(DW(W₁(LN x))))),  z = y + γ·W₅(SG(W₄(LN y))).

    SG is `simple_gate`, SCA(u) = u·W₂(mean of u over the image). β and γ start at zero: a fresh
    block is the identity.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        c = channels
        self.norm1, self.norm2 = LayerNorm2d(c), LayerNorm2d(c)
        self.conv1 = Pointwise(c, 2 * c)
        self.depthwise = nn.Conv2d(2 * c, 2 * c, 3, padding=1, groups=2 * c)
        self.attention = Pointwise(c, c)
        self.conv3 = Pointwise(c, c)
        self.conv4 = Pointwise(c, 2 * c)
        self.conv5 = Pointwise(c, c)
        self.beta = nn.Parameter(torch.zeros(c))
        self.gamma = nn.Parameter(torch.zeros(c))

    def forward(self, x: Tensor) -> Tensor:
        u = simple_gate(self.depthwise(self.conv1(self.norm1(x))))
        u = u * self.attention(u.mean((2, 3), keepdim=True))
        y = x + self.conv3(u, self.beta)
        return y + self.conv5(simple_gate(self.conv4(self.norm2(y))), self.gamma)


def blocks(channels: int, count: int) -> nn.Sequential:
    """``count`` blocks of that many channels."""
    return nn.Sequential(*(NAFBlock(channels) for _ in range(count)))


class Encoder(nn.Module):
    """3×3 convolution to ``width`` channels, then per level blocks and a 2×2 convolution that
    halves the size and doubles the channels."""

    def __init__(self, inputs: int, width: int, counts: Sequence[int]) -> None:
        super().__init__()
        self.intro = nn.Conv2d(inputs, width, 3, padding=1)
        channels = [width << k for k in range(len(counts))]
        self.levels = nn.ModuleList(blocks(c, n) for c, n in zip(channels, counts, strict=True))
        self.down = nn.ModuleList(nn.Conv2d(c, 2 * c, 2, stride=2) for c in channels)

    def forward(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The bottleneck, (B, width·2^levels, H/2^levels, W/2^levels), and the levels' outputs."""
        x = self.intro(x)
        skips = []
        for level, down in zip(self.levels, self.down, strict=True):
            x = level(x)
            skips.append(x)
            x = down(x)
        return x, skips


class Decoder(nn.Module):
    """The way back: 1×1 convolution and pixel shuffle, plus the encoder's skip, then blocks."""

    def __init__(self, outputs: int, width: int, counts: Sequence[int]) -> None:
        super().__init__()
        channels = [width << k for k in reversed(range(len(counts)))]
        self.up = nn.ModuleList(
            nn.Sequential(Pointwise(2 * c, 4 * c, bias=False), nn.PixelShuffle(2)) for c in channels
        )
        self.levels = nn.ModuleList(blocks(c, n) for c, n in zip(channels, counts, strict=True))
        self.ending = nn.Conv2d(width, outputs, 3, padding=1)

    def forward(self, x: Tensor, skips: Sequence[Tensor]) -> Tensor:
        for up, level, skip in zip(self.up, self.levels, reversed(skips), strict=True):
            x = level(up(x) + skip)
        return self.ending(x)


def pad_to(x: Tensor, multiple: int) -> Tensor:
    """Repeat the border at the right and below until H and W are multiples of ``multiple``."""
    h, w = x.shape[-2:]
    return F.pad(x, (0, -w % multiple, 0, -h % multiple), mode="replicate")
