"""Convolutions that halve an image; those of few channels are computed on blocks of pixels.

A convolution from 3 channels to 4 leaves most of a CPU's vector unit idle. The same sums come out of one that has 2x2
neighbours as channels, as PyTorch's ``pixel_unshuffle`` makes them: of its outputs, of its inputs, or of both. Its
kernel holds the same weights, shifted for each neighbour, and zeros between them.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

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

    bias: Tensor

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
        pool = 2 if downsample == "max_pool" else 1
        super().__init__(in_channels, out_channels, kernel_size, stride=2 // pool, padding=padding)
        self.pool, self.blocks_in, self.blocks_out = pool, blocks_in, blocks_out
        with torch.inference_mode(False), torch.device("cpu"):
            self._blocks = _make_blocks(tuple(self.weight.shape), pool, blocks_in, blocks_out)

    def forward(self, images: Tensor) -> Tensor:
        """Return images ``[N, O, H / 2, W / 2]`` of images ``[N, C, H, W]``, float; both as blocks if so asked."""
        return halve(images, [self])

    def on_blocks(self) -> tuple[Tensor, Tensor]:
        """Return the weights and biases of the convolution that does the same on blocks."""
        weight = F.pad(self.weight.reshape(-1), (1, 0)).index_select(0, self._blocks.weights).view(self._blocks.shape)
        return weight, self.bias.index_select(0, self._blocks.biases)


def halve(images: Tensor, layers: Sequence[Halving], *, shared: bool = True) -> Tensor:
    """Return images halved by several layers of a kind in one convolution, the same as by each but for rounding.

    Args:
        images: float ``[N, C, H, W]`` if shared; ``[N, G * C, H, W]`` if not, G the number of layers.
        layers: all alike but for their parameters.
        shared: whether all see the same images, or each channels of its own.

    Returns:
        The layers' images one after another, float ``[N, G * O, H / 2, W / 2]``; all as blocks if the layers ask so.
    """
    kind, groups = layers[0], len(layers)
    blocks_in, blocks_out = (kind.blocks_in, kind.blocks_out) if images.is_cpu else (1, 1)
    plain = blocks_in == blocks_out == 1
    parameters = [(layer.weight, layer.bias) if plain else layer.on_blocks() for layer in layers]
    weight, bias = (torch.cat(parts) for parts in zip(*parameters, strict=True))
    stride = kind.stride[0] if plain else 2 * blocks_out // blocks_in
    padding = kind.kernel_size[0] // 2 // blocks_in
    halved = F.conv2d(images, weight, bias, stride, padding, groups=1 if shared else groups)
    if kind.pool == 1:
        return halved
    return F.max_pool2d(halved, 2) if plain else _largest_of_four(halved, groups)


class _Blocks(NamedTuple):
    """What the convolution on blocks takes from the plain one.

    Attributes:
        shape: of its weights. Its outputs are ``pool * blocks_out`` neighbours a side; those that will be pooled are
            the slowest of its channels.
        weights: where each of its weights stands in a zero and the plain weights, flat.
        biases: where each of its biases stands in the plain ones.
    """

    shape: tuple[int, ...]
    weights: Tensor
    biases: Tensor


def _make_blocks(shape: tuple[int, ...], pool: int, blocks_in: int, blocks_out: int) -> _Blocks:
    step, side = 2 // pool, pool * blocks_out
    size = shape[-1] + step * (side - 1)
    plain = F.pad(torch.arange(1, math.prod(shape) + 1).view(shape), 4 * [step * (side - 1)])
    kernels = plain.unfold(2, size, step).unfold(3, size, step).flip(2, 3)  # [O, C, side, side, size, size]
    kernels = kernels.unflatten(3, (blocks_out, pool)).unflatten(2, (blocks_out, pool))
    kernels = kernels.permute(3, 5, 0, 2, 4, 1, 6, 7).flatten(0, 4)  # [pool**2 * O * blocks_out**2, C, size, size]
    kernels = F.pixel_unshuffle(F.pad(kernels, 2 * [0, -size % blocks_in]), blocks_in)
    biases = torch.arange(shape[0]).repeat_interleave(blocks_out**2).repeat(pool**2)
    return _Blocks(tuple(kernels.shape), kernels.flatten(), biases)


def _largest_of_four(images: Tensor, groups: int) -> Tensor:
    """Return the largest of each four channels, ``[N, G * C, H, W]`` of images ``[N, G * 4 * C, H, W]``, G the groups.

    In an image wide enough, a pixel's four stand in a row: ``max_pool2d`` is fast, forward and backward.
    """
    wide = images.permute(0, 2, 3, 1).unflatten(3, (groups * 4, -1)).flatten(2, 3).permute(0, 3, 1, 2)
    largest = F.max_pool2d(wide, (1, 4))  # [N, C, H, W * G]
    return largest.permute(0, 2, 3, 1).unflatten(2, (-1, groups)).flatten(3).permute(0, 3, 1, 2)
