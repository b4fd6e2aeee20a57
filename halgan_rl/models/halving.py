"""Convolutions that halve images, and how those of several networks are computed in one pass.

Few channels leave most of a CPU's vector units idle. So pixels may lie in blocks: two neighbours, one above the other,
are one pixel of twice the channels in an image of half the height. A convolution that writes blocks has one kernel for
each pixel of a block: the plain kernel, moved, and zeros where it does not reach. One that reads blocks has its kernels
cut into blocks as well. The sums are the same, but for their order; the zeros cost less than what the channels gain.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Downsample = Literal["stride", "max_pool"]

Blocks = tuple[int, int]
"""Height and width of blocks."""


class Layout(NamedTuple):
    """In what blocks a layer reads images, and in what blocks it writes the halved ones."""

    reads: Blocks = (1, 1)
    writes: Blocks = (1, 1)


PLAIN = Layout()
"""Pixel by pixel."""


class Halving(nn.Conv2d):
    """A convolution that halves an image: by a stride of 2, or by max-pooling behind it.

    Args:
        in_channels: C.
        out_channels: O.
        kernel_size: odd.
        downsample: ``"stride"`` 2, or ``"max_pool"`` of 2x2.

    Raises:
        ValueError: if ``downsample`` is neither.

    Examples:
        >>> Halving(3, 4, 5)(torch.zeros(5, 3, 64, 64)).shape
        torch.Size([5, 4, 32, 32])
    """

    bias: Tensor

    def __init__(
        self, in_channels: int, out_channels: int, kernel_size: int, *, downsample: Downsample = "stride"
    ) -> None:
        if downsample not in ("stride", "max_pool"):
            raise ValueError(f"downsample={downsample!r} is unknown: choose 'stride' or 'max_pool'")
        pool = 2 if downsample == "max_pool" else 1
        super().__init__(in_channels, out_channels, kernel_size, stride=2 // pool, padding=kernel_size // 2)
        self.pool = pool

    def forward(self, images: Tensor) -> Tensor:
        """Return images ``[N, O, H / 2, W / 2]`` of images ``[N, C, H, W]``, float."""
        halved = super().forward(images)
        return F.max_pool2d(halved, 2) if self.pool == 2 else halved


def halve(
    images: Tensor,
    networks: Sequence[Sequence[Halving]],
    layouts: Sequence[Layout],
    activation: Callable[[Tensor], Tensor],
) -> Tensor:
    """Return images halved by the layers of several networks: the same as by each of them, but for rounding.

    A layer of all networks is one convolution.

    Args:
        images: float ``[N, C, H, W]``; all networks see them.
        networks: their layers, from the first to the last; alike but for their parameters.
        layouts: of each layer; they decide how long it takes.
        activation: of each element, behind each layer.

    Returns:
        The networks' images one after another, float ``[N, G * O, H', W']``, G the number of networks; in the blocks
        that the last layout writes.

    Raises:
        ValueError: if blocks do not fit together, or do not divide a layer's padding.
    """
    groups, lie = len(networks), PLAIN.writes
    kernels = _lay_out(networks, tuple(layouts))
    for depth, (layer, layout, (weight, bias)) in enumerate(zip(networks[0], layouts, kernels, strict=True)):
        images = _reblock(images, lie, layout.reads, groups)
        pool = layer.pool if layout == PLAIN else 1  # otherwise the neighbours in a pool are channels
        stride = [2 * write // (read * pool) for read, write in zip(layout.reads, layout.writes, strict=True)]
        padding = [layer.kernel_size[0] // 2 // read for read in layout.reads]
        images = F.conv2d(images, weight, bias, stride, padding, groups=groups if depth else 1)
        if layer.pool == 2:
            images = F.max_pool2d(images, 2) if layout == PLAIN else _largest_of_four(images, groups)
        images, lie = activation(images), layout.writes
    return images


def _reblock(images: Tensor, lie: Blocks, asked: Blocks, groups: int) -> Tensor:
    """Return images ``[N, G * C, H, W]`` in larger blocks than they lie in.

    The channels' order is: group, column of the block, row, channel.
    """
    if lie == asked:
        return images
    if any(new % old for old, new in zip(lie, asked, strict=True)):
        raise ValueError(f"images in blocks of {lie} cannot be read in blocks of {asked}: choose multiples of those")
    count, channels, height, width = images.shape
    rows, columns = asked[0] // lie[0], asked[1] // lie[1]
    shape = count, height // rows, rows, width // columns, columns, groups, lie[1], channels // (groups * lie[1])
    pixels = images.permute(0, 2, 3, 1).reshape(shape).permute(0, 1, 3, 5, 4, 6, 2, 7)
    return pixels.flatten(3).permute(0, 3, 1, 2)


def _largest_of_four(images: Tensor, groups: int) -> Tensor:
    """Return the largest of each four channels, ``[N, G * C, H, W]`` of images ``[N, G * 4 * C, H, W]``, G the groups.

    In an image wide enough, a pixel's four stand in a row: ``max_pool2d`` is fast, forward and backward.
    """
    wide = images.permute(0, 2, 3, 1).unflatten(3, (groups * 4, -1)).flatten(2, 3).permute(0, 3, 1, 2)
    largest = F.max_pool2d(wide, (1, 4))  # [N, C, H, W * G]
    return largest.permute(0, 2, 3, 1).unflatten(2, (-1, groups)).flatten(3).permute(0, 3, 1, 2)


def _lay_out(networks: Sequence[Sequence[Halving]], layouts: tuple[Layout, ...]) -> list[tuple[Tensor, Tensor]]:
    """Return the weights and biases of each layer's convolution for all networks; for blocks all gathered at once."""
    if all(layout == PLAIN for layout in layouts):
        depths = zip(*networks, strict=True)
        return [
            (torch.cat([one.weight for one in layers]), torch.cat([one.bias for one in layers])) for layers in depths
        ]
    layers = [layer for network in networks for layer in network]
    shapes = tuple(tuple(layer.weight.shape) for layer in networks[0])
    table = _make_table(shapes, layers[0].pool, len(networks), layouts)
    flat = [part for layer in layers for part in (layer.weight.permute(0, 2, 3, 1).reshape(-1), layer.bias)]
    parts = torch.cat([flat[0].new_zeros(1), *flat]).index_select(0, table.places).split(table.sizes)
    weights = [part.view(shape).permute(0, 3, 1, 2) for part, shape in zip(parts[::2], table.shapes, strict=True)]
    return list(zip(weights, parts[1::2], strict=True))


class _Table(NamedTuple):
    """Where the parameters of convolutions on blocks stand in a zero and those of plain layers, flat.

    Attributes:
        places: of each layer's weights ``[O, h, w, C]`` and biases ``[O]``, one after another.
        sizes: how many weights and how many biases, layer by layer.
        shapes: of the weights.
    """

    places: Tensor
    sizes: list[int]
    shapes: list[torch.Size]


@cache
def _make_table(shapes: tuple[tuple[int, ...], ...], pool: int, groups: int, layouts: tuple[Layout, ...]) -> _Table:
    with torch.inference_mode(False), torch.device("cpu"):
        sizes = [size for outputs, *others in shapes for size in (outputs * math.prod(others), outputs)]
        numbers = torch.arange(1, 1 + groups * sum(sizes)).view(groups, -1).split(sizes, 1)
        parts, kernels = [], []
        for shape, layout, weights, biases in zip(shapes, layouts, numbers[::2], numbers[1::2], strict=True):
            outputs, inputs, size, _ = shape
            weights = weights.reshape(groups, outputs, size, size, inputs)
            kernels.append(_spread(weights, 1 if layout == PLAIN else pool, layout))
            parts += [kernels[-1], biases.repeat(1, len(kernels[-1]) // biases.numel())]
        places = torch.cat([part.flatten() for part in parts])
    return _Table(places, [part.numel() for part in parts], [kernel.shape for kernel in kernels])


def _spread(weights: Tensor, pool: int, layout: Layout) -> Tensor:
    """Return the kernels on blocks ``[G * O', h, w, C']`` of plain ones ``[G, O, size, size, C]``.

    Outputs lie in the order: group, neighbour in the pool, column of the block, row, channel.
    """
    (rows, columns), (height, width) = layout
    groups, outputs, size, _, inputs = weights.shape
    step, padding = 2 // pool, size // 2
    if any(padding % read or 2 * write % read for read, write in zip(*layout, strict=True)):
        raise ValueError(
            f"{layout}: blocks that are read must divide the padding, {padding}, and twice the blocks that are written"
        )
    reach = [size + step * (pool * side - 1) for side in layout.writes]
    reach = [reached + -reached % read for reached, read in zip(reach, layout.reads, strict=True)]
    kernels = weights.new_zeros(groups, pool, pool, width, height, outputs, *reach, inputs)
    for row, column in itertools.product(range(pool * height), range(pool * width)):
        top, left, pixel = step * row, step * column, (row % pool, column % pool, column // pool, row // pool)
        kernels[:, *pixel, :, top : top + size, left : left + size] = weights
    kernels = kernels.flatten(0, 5).unflatten(2, (-1, columns)).unflatten(1, (-1, rows))
    return kernels.permute(0, 1, 3, 4, 2, 5).flatten(3)
