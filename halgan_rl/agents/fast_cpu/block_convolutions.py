"""Convolutions that halve images, and how those of several networks are computed in one pass.

Few channels leave most of a CPU's vector units idle. So pixels may lie in blocks: two neighbours, one above the other,
are one pixel of twice the channels in an image of half the height. A convolution that writes blocks has one kernel for
each pixel of a block: the plain kernel, moved, and zeros where it does not reach. One that reads blocks has its kernels
cut into blocks as well. The sums are the same, but for their order; the zeros cost less than what the channels gain.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import cache
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Downsample = Literal["stride", "max_pool"]

Blocks = tuple[int, int]
"""Height and width of blocks [pixels]."""
Kind = tuple[int, int, int, int]
"""A layer's outputs, inputs, kernel size, and side of its pools (1 with strides)."""
Kernels = list[tuple[Tensor, Tensor]]
"""Weights and biases of each layer of all networks."""


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
        ValueError: if ``downsample`` is neither, or ``kernel_size`` even.

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
        if kernel_size % 2 == 0:
            raise ValueError(f"kernel_size={kernel_size} must be odd, or the kernel has no middle")
        pool = 2 if downsample == "max_pool" else 1
        super().__init__(in_channels, out_channels, kernel_size, stride=2 // pool, padding=kernel_size // 2)
        self.kind: Kind = (out_channels, in_channels, kernel_size, pool)

    def forward(self, images: Tensor) -> Tensor:
        """Return images ``[N, O, H / 2, W / 2]`` of images ``[N, C, H, W]``, float."""
        return halve(images, [[self]], [PLAIN])


def halve(
    images: Tensor,
    networks: Sequence[Sequence[Halving]],
    layouts: Sequence[Layout],
    activation: Callable[[Tensor], Tensor] = nn.Identity(),  # noqa: B008 (has no state)
) -> Tensor:
    """Return images halved by the layers of several networks: the same as by each of them, but for rounding.

    A layer of all networks is one convolution.

    Args:
        images: float ``[N, C, H, W]``; all networks see them. On the CPU, unless all layouts are plain.
        networks: their layers, from the first to the last; alike but for their parameters.
        layouts: of each layer; they decide how long it takes. The last one writes no blocks.
        activation: of each element, behind each layer.

    Returns:
        The networks' images one after another, float ``[N, G * O, H', W']``, G the number of networks.

    Raises:
        ValueError: if the networks differ, or if blocks do not fit together, the layers' padding or the images.
    """
    kinds = [tuple(layer.kind for layer in network) for network in networks]
    if any(kind != kinds[0] for kind in kinds):
        raise ValueError(f"networks that share a pass need the same layers, got {kinds} (outputs, inputs, size, pool)")
    plain = all(layout == PLAIN for layout in layouts)
    kernels = _join(networks) if plain else _lay_out(networks, kinds[0], tuple(layouts), tuple(images.shape[2:]))
    groups, lie = 1, PLAIN.writes
    for (_, _, size, pool), layout, (weight, bias) in zip(kinds[0], layouts, kernels, strict=True):
        images = _reblock(images, lie, layout.reads, groups)
        pooled = pool if layout == PLAIN else 1  # otherwise the neighbours in a pool are channels
        stride = [2 * write // (read * pooled) for read, write in zip(layout.reads, layout.writes, strict=True)]
        images = F.conv2d(images, weight, bias, stride, [size // 2 // read for read in layout.reads], groups=groups)
        groups, lie = len(networks), layout.writes
        if pool == 2:
            images = F.max_pool2d(images, 2) if layout == PLAIN else _largest_of_four(images, groups)
        images = activation(images)
    return images


def _reblock(images: Tensor, lie: Blocks, asked: Blocks, groups: int) -> Tensor:
    """Return images ``[N, G * C, H, W]`` in larger blocks than they lie in.

    The channels' order is: group, column of the block, row, channel.
    """
    if lie == asked:
        return images
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


def _join(networks: Sequence[Sequence[Halving]]) -> Kernels:
    """Return the layers' own parameters, those of all networks one after another."""
    depths = list(zip(*networks, strict=True))
    weights = [torch.cat([layer.weight for layer in layers]) for layers in depths]
    return list(zip(weights, [torch.cat([layer.bias for layer in layers]) for layers in depths], strict=True))


def _lay_out(
    networks: Sequence[Sequence[Halving]], kinds: tuple[Kind, ...], layouts: tuple[Layout, ...], size: tuple[int, ...]
) -> Kernels:
    """Return what the convolutions on blocks need, all of it gathered from the layers' parameters in one step."""
    table = _make_table(kinds, len(networks), layouts, size)
    layers = [layer for network in networks for layer in network]
    flat = [part for layer in layers for part in (layer.weight.flatten(), layer.bias)]
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
def _make_table(kinds: tuple[Kind, ...], groups: int, layouts: tuple[Layout, ...], size: tuple[int, ...]) -> _Table:
    _check_fit(kinds, layouts, size)
    counts = [count for outputs, inputs, side, _ in kinds for count in (outputs * inputs * side**2, outputs)]
    with torch.inference_mode(False), torch.device("cpu"):
        numbers = torch.arange(1, 1 + groups * sum(counts)).view(groups, -1).split(counts, 1)
        parts, kernels = [], []
        for kind, layout, weights, biases in zip(kinds, layouts, numbers[::2], numbers[1::2], strict=True):
            outputs, inputs, side, pool = kind
            weights = weights.reshape(groups, outputs, inputs, side, side).movedim(2, -1)
            kernels.append(_spread(weights, 1 if layout == PLAIN else pool, layout))
            parts += [kernels[-1], biases.repeat(1, len(kernels[-1]) // biases.numel())]
        places = torch.cat([part.flatten() for part in parts])
    return _Table(places, [part.numel() for part in parts], [kernel.shape for kernel in kernels])


def _check_fit(kinds: tuple[Kind, ...], layouts: tuple[Layout, ...], size: tuple[int, ...]) -> None:
    """Refuse blocks that do not fit together, nor the layers, nor images of some height and width."""
    lie = PLAIN.writes
    for depth, ((_, _, side, _), layout) in enumerate(zip(kinds, layouts, strict=True)):
        for pixels, before, read, write in zip(size, lie, *layout, strict=True):
            step = 2 * write
            if read % before or step % read or (side // 2) % read or (pixels >> depth) % step:
                raise ValueError(
                    f"{layout} does not fit layer {depth}: the blocks that are read must be multiples of those before, "
                    f"{lie}, and divide its padding, {side // 2}, and twice those that are written, which must divide "
                    f"the image's {size[0] >> depth}x{size[1] >> depth} pixels"
                )
        lie = layout.writes
    if lie != (1, 1):
        raise ValueError(f"the last layer writes blocks of {lie}, which nothing reads: let it write (1, 1)")


def _spread(weights: Tensor, pool: int, layout: Layout) -> Tensor:
    """Return the kernels on blocks ``[G * O', h, w, C']`` of plain ones ``[G, O, size, size, C]``.

    Outputs lie in the order: group, neighbour in the pool, column of the block, row, channel.
    """
    (rows, columns), (height, width) = layout
    groups, outputs, size, _, inputs = weights.shape
    step = 2 // pool
    reach = [size + step * (pool * side - 1) for side in layout.writes]
    reach = [reached + -reached % read for reached, read in zip(reach, layout.reads, strict=True)]
    kernels = weights.new_zeros(groups, pool, pool, width, height, outputs, *reach, inputs)
    for row, column in itertools.product(range(pool * height), range(pool * width)):
        top, left, pixel = step * row, step * column, (row % pool, column % pool, column // pool, row // pool)
        kernels[:, *pixel, :, top : top + size, left : left + size] = weights
    kernels = kernels.flatten(0, 5).unflatten(2, (-1, columns)).unflatten(1, (-1, rows))
    return kernels.permute(0, 1, 3, 4, 2, 5).flatten(3)
