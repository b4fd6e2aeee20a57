"""Convolutions that halve an image; those of few channels are computed on blocks of pixels.

A convolution from 3 channels to 4 leaves most of a CPU's vector unit idle. The same sums come out of one that has 2x2
neighbours as channels, as PyTorch's ``pixel_unshuffle`` makes them: of its outputs, of its inputs, or of both. Its
kernel holds the same weights, shifted for each neighbour, and zeros between them.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Downsample = Literal["stride", "max_pool"]


class Halving(nn.Conv2d):
    """A convolution that halves an image: by a stride of 2, or by max-pooling behind it.

    On a CPU it may read and write images as blocks: ``pixel_unshuffle(images, b)`` instead of ``images``. Whatever the
    blocks, it has the parameters of the plain convolution and computes the same, but for rounding. On other devices,
    which are not short of channels, there are no blocks: images come and go as they are.

    Args:
        in_channels: C.
        out_channels: O.
        kernel_size: odd.
        downsample: ``"stride"`` 2, or ``"max_pool"`` of 2x2.
        blocks_in: side b of the blocks that come in.
        blocks_out: side of the blocks that go out.

    Raises:
        ValueError: if ``downsample`` is neither, or if blocks of these sizes do not fit together.

    Examples:
        >>> images = torch.zeros(5, 3, 64, 64)
        >>> Halving(3, 4, 5)(images).shape
        torch.Size([5, 4, 32, 32])
        >>> Halving(3, 4, 5, blocks_out=2)(images).shape
        torch.Size([5, 16, 16, 16])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int,
        *,
        downsample: Downsample = "stride",
        blocks_in: int = 1,
        blocks_out: int = 1,
    ) -> None:
        if downsample not in ("stride", "max_pool"):
            raise ValueError(f"downsample={downsample!r} is unknown: choose 'stride' or 'max_pool'")
        padding = kernel_size // 2
        if padding % blocks_in or 2 * blocks_out % blocks_in:
            raise ValueError(
                f"blocks_in={blocks_in} must divide the padding, {padding}, and 2 * blocks_out, {2 * blocks_out}"
            )
        self.pool = 2 if downsample == "max_pool" else 1
        super().__init__(in_channels, out_channels, kernel_size, stride=2 // self.pool, padding=padding)
        self.blocks_in, self.blocks_out = blocks_in, blocks_out

    def forward(self, images: Tensor) -> Tensor:
        """Return images ``[N, O, H / 2, W / 2]`` of images ``[N, C, H, W]``, float; both as blocks if so asked."""
        return halve(images, [self])

    def kernel(self) -> Tensor:
        """Return the convolution's weights as they meet blocks."""
        places, shape = _rearrangement(tuple(self.weight.shape), self.pool, self.blocks_in, self.blocks_out)
        return F.pad(self.weight.reshape(-1), (1, 0)).index_select(0, places).view(shape)


def halve(images: Tensor, layers: Sequence[Halving], *, shared: bool = True) -> Tensor:
    """Return images halved by several layers of the same kind in one convolution: faster, and the same but for rounding.

    Args:
        images: float ``[N, C, H, W]`` if shared; ``[N, G * C, H, W]`` if not, G the number of layers.
        layers: all alike but for their parameters.
        shared: whether all see the same images, or each channels of its own.

    Returns:
        The layers' images one after another, float ``[N, G * O, H / 2, W / 2]``; all as blocks if the layers ask so.
    """
    kind, count = layers[0], len(layers)
    groups = 1 if shared else count
    biases = torch.cat([layer.bias for layer in layers])
    if not images.is_cpu or kind.blocks_in == kind.blocks_out == 1:
        weights = torch.cat([layer.weight for layer in layers])
        halved = F.conv2d(images, weights, biases, kind.stride, kind.padding, groups=groups)
        return halved if kind.pool == 1 else F.max_pool2d(halved, kind.pool)
    weights = torch.cat([layer.kernel() for layer in layers])
    biases = biases.repeat_interleave(kind.blocks_out**2).view(count, 1, -1).expand(-1, kind.pool**2, -1).flatten()
    stride, padding = 2 * kind.blocks_out // kind.blocks_in, kind.padding[0] // kind.blocks_in
    halved = F.conv2d(images, weights, biases, stride, padding, groups=groups)
    return halved if kind.pool == 1 else _largest_of_four(halved, count)


@cache
def _rearrangement(
    shape: tuple[int, ...], pool: int, blocks_in: int, blocks_out: int
) -> tuple[Tensor, tuple[int, ...]]:
    """Return where each entry of a kernel for blocks stands in the plain weights behind a zero; and that kernel's shape.

    The kernel's outputs are ``pool * blocks_out`` neighbours a side. Those to be pooled are its slowest channels.
    """
    step, side = 2 // pool, pool * blocks_out
    size = shape[-1] + step * (side - 1)
    plain = F.pad(torch.arange(1, math.prod(shape) + 1).view(shape), 4 * [step * (side - 1)])
    kernels = plain.unfold(2, size, step).unfold(3, size, step).flip(2, 3)  # [O, C, side, side, size, size]
    kernels = kernels.unflatten(3, (blocks_out, pool)).unflatten(2, (blocks_out, pool))
    kernels = kernels.permute(3, 5, 0, 2, 4, 1, 6, 7).flatten(0, 4)  # [pool**2 * O * blocks_out**2, C, size, size]
    kernels = F.pixel_unshuffle(F.pad(kernels, 2 * [0, -size % blocks_in]), blocks_in)
    return kernels.flatten(), tuple(kernels.shape)


def _largest_of_four(images: Tensor, groups: int) -> Tensor:
    """Return the largest of each four channels, ``[N, G * C, H, W]`` of images ``[N, G * 4 * C, H, W]``, G the groups.

    In an image wide enough, a pixel's four stand in a row: ``max_pool2d`` is fast, forward and backward.
    """
    wide = images.permute(0, 2, 3, 1).unflatten(3, (groups * 4, -1)).flatten(2, 3).permute(0, 3, 1, 2)
    largest = F.max_pool2d(wide, (1, 4))  # [N, C, H, W * G]
    return largest.permute(0, 2, 3, 1).unflatten(2, (-1, groups)).flatten(3).permute(0, 3, 1, 2)
