"""NAFNet's block, and encoders and decoders of such blocks.

Chen et al. 2022, "Simple Baselines for Image Restoration". Tensors are (B, C, H, W); H and W must
be multiples of 2^levels, see `pad_to`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

GRID_WINDOW = 16  # pixels a side over which a grid is averaged; by hand
GRID_MOST = 0.02  # amplitude; of plain materials at most 0.0054, what is greater is a texture


class Pointwise(nn.Module):
    """1×1 convolution as a matrix product over channels-last memory, where torch's is slower."""

    def __init__(self, inputs: int, outputs: int, bias: bool = True) -> None:
        super().__init__()
        bound = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(outputs, inputs).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(outputs).uniform_(-bound, bound)) if bias else None

    def forward(self, x: Tensor) -> Tensor:
        return F.linear(x.permute(0, 2, 3, 1), self.weight, self.bias).permute(0, 3, 1, 2)

    def add_to(self, x: Tensor, u: Tensor, scale: Tensor, gain: Tensor | None = None) -> Tensor:
        """x + scale·(W(gain·u) + b) as one matrix product: ``scale`` (out,) of the outputs and
        ``gain`` (B, in, 1, 1) of the inputs multiply the weights."""
        assert self.bias is not None
        b, c, h, w = x.shape
        weight = (self.weight * scale[:, None]).T
        flat, inputs = (v.permute(0, 2, 3, 1).reshape(b, h * w, -1) for v in (x, u))
        if gain is None:
            y = torch.addmm(flat.flatten(0, 1), inputs.flatten(0, 1), weight)
        else:
            y = torch.baddbmm(flat, inputs, gain.flatten(1)[:, :, None] * weight)
        return (y.view(b, h, w, c) + scale * self.bias).permute(0, 3, 1, 2)


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
        # W₃(a·u) = (W₃·a)u: attention scales the weights of each image, not its pixels.
        attention = self.attention(u.mean((2, 3), keepdim=True))
        y = self.conv3.add_to(x, u, self.beta, attention)
        return self.conv5.add_to(y, simple_gate(self.conv4(self.norm2(y))), self.gamma)


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


class Upsample(nn.Sequential):
    """1×1 convolution to four times the channels and a pixel shuffle: twice the size, half of the
    channels. Both in channels-last memory, where torch's shuffle is slow."""

    def __init__(self, channels: int) -> None:
        super().__init__(Pointwise(2 * channels, 4 * channels, bias=False))
        self.channels = channels

    def forward(self, x: Tensor) -> Tensor:
        (b, _, h, w), c = x.shape, self.channels
        # The outputs' order is (channel, row, column) as in torch's shuffle; here the channel last.
        own: Tensor = self.get_parameter("0.weight")
        weight = own.view(c, 4, 2 * c).transpose(0, 1).reshape(4 * c, 2 * c)
        y = F.linear(x.permute(0, 2, 3, 1), weight).view(b, h, w, 2, 2 * c)
        return y.transpose(2, 3).reshape(b, 2 * h, 2 * w, c).permute(0, 3, 1, 2)


class Decoder(nn.Module):
    """The way back: `Upsample`, plus the encoder's skip, then blocks."""

    def __init__(self, outputs: int, width: int, counts: Sequence[int]) -> None:
        super().__init__()
        channels = [width << k for k in reversed(range(len(counts)))]
        self.up = nn.ModuleList(Upsample(c) for c in channels)
        self.levels = nn.ModuleList(blocks(c, n) for c, n in zip(channels, counts, strict=True))
        self.ending = nn.Conv2d(width, outputs, 3, padding=1)

    def forward(self, x: Tensor, skips: Sequence[Tensor]) -> Tensor:
        for up, level, skip in zip(self.up, self.levels, reversed(skips), strict=True):
            x = level(up(x) + skip)
        return self.ending(x)


def without_grid(images: Tensor) -> Tensor:
    """Images (B, C, H, W) without the grid of two pixels that `Upsample` leaves in them.

    Its four interleaved outputs have errors of their own (Odena et al. 2016, "Deconvolution and
    checkerboard artifacts"). What alternates along rows, along columns, and along both is averaged
    over `GRID_WINDOW` pixels and taken away; single lines and edges stay.
    """
    h, w = images.shape[2:]
    step = GRID_WINDOW // 2
    around = (step // 2 + 1, step // 2 + 1 + -w % step, step // 2 + 1, step // 2 + 1 + -h % step)
    # Reflected, what alternates goes on alternating. An image too small for that has no grid.
    if min(h, w) <= max(around):
        return images
    x = F.pad(images.reshape(-1, 1, h, w), around, mode="reflect")
    mean, change = (torch.tensor(k, dtype=x.dtype) / 4 for k in ([1, 2, 1], [-1, 2, -1]))
    kernels = [torch.outer(a, b) for a, b in ((change, mean), (mean, change), (change, change))]
    x = F.conv2d(x, torch.stack(kernels)[:, None]).clamp(-GRID_MOST, GRID_MOST)
    row, column = (1 - 2.0 * (torch.arange(n) % 2) for n in x.shape[2:])
    sign = torch.stack(
        [row[:, None].expand(x.shape[2:]), column.expand(x.shape[2:]), torch.outer(row, column)]
    )
    amplitude = F.avg_pool2d(x * sign, GRID_WINDOW, step)
    amplitude = F.interpolate(amplitude, scale_factor=step, mode="bilinear")
    start = step // 2
    grid = (amplitude[..., :h, :w] * sign[:, start : start + h, start : start + w]).sum(1)
    return images - grid.reshape(images.shape)


def channels_last_cat(parts: Sequence[Tensor]) -> Tensor:
    """Images (B, C, H, W) side by side, written once, into channels-last memory."""
    return torch.cat([x.permute(0, 2, 3, 1) for x in parts], -1).permute(0, 3, 1, 2)


def pad_to(x: Tensor, multiple: int) -> Tensor:
    """Repeat the border at the right and below until H and W are multiples of ``multiple``."""
    h, w = x.shape[-2:]
    if h % multiple == w % multiple == 0:
        return x
    return F.pad(x, (0, -w % multiple, 0, -h % multiple), mode="replicate")
