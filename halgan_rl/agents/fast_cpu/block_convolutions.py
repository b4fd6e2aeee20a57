"""Convolutions that halve images, those of several networks in one pass, on blocks of pixels.

Few channels leave most of a CPU's vector units idle. So pixels may lie in blocks: two neighbours, one above the other,
are one pixel of twice the channels in an image of half the height. A convolution that writes blocks has one kernel for
each pixel of a block: the plain kernel, moved, and zeros where it does not reach. One that reads blocks has its kernels
cut into blocks as well. The sums are the same, except for their order; the zeros cost less than the channels gain.

Shapes: N images, G networks, C and O channels in and out, H and W pixels, blocks of b = rows * columns pixels.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

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


def halve(
    images: Tensor,
    networks: Sequence[Sequence[nn.Conv2d]],
    layouts: Sequence[Layout],
    activation: Callable[[Tensor], Tensor] = nn.Identity(),  # noqa: B008 (has no state)
) -> Tensor:
    """Returns images halved by the layers of several networks: the same as by each of them, but for rounding.

    A layer of all networks is one convolution.

    Args:
        images: Float ``[N, C, H, W]`` on the CPU; all networks see them.
        networks: Their convolutions, from the first to the last; alike but for their parameters. Kernels are odd and
            padded by half their size. A stride of 2 halves; after a stride of 1 a max-pool of 2x2 does.
        layouts: Of each layer; they decide how long it takes. The last one writes no blocks.
        activation: Of each element, behind each layer.

    Returns:
        The networks' images one after another, float ``[N, G * O, H', W']``, G the number of networks.

    Raises:
        ValueError: If the networks differ, or if blocks do not fit together, the layers' padding or the images.
    """
    kinds = [tuple(kind_of(layer) for layer in network) for network in networks]
    if any(kind != kinds[0] for kind in kinds):
        raise ValueError(f"networks that share a pass need the same layers, got {kinds} (outputs, inputs, size, pool).")
    kernels = _lay_out(networks, kinds[0], tuple(layouts), tuple(images.shape[2:]))

    # The first layer is one convolution for all networks, [N, C, H, W] -> [N, G * O, ...]: they see the same images.
    # Those behind it have a group for each network, [N, G * C, ...] -> [N, G * O, ...]: each sees its own.
    groups, lie = 1, PLAIN.writes
    for (_, _, size, pool), layout, (weight, bias) in zip(kinds[0], layouts, kernels, strict=True):
        # Pixels into the blocks that are read, b of them: [N, G * C, H, W] -> [N, G * b * C, H / rows, W / columns].
        images = _reblock(images, lie, layout.reads, groups)

        # One step of the convolution is one block that is written, of pixels that are 2 apart in the image (with a
        # max-pool, 4 neighbours for each, which become channels: they are 1 apart). A plain layer pools as usual.
        pooled = pool if layout == PLAIN else 1
        stride = [2 * write // (read * pooled) for read, write in zip(layout.reads, layout.writes, strict=True)]
        padding = [size // 2 // read for read in layout.reads]
        images = F.conv2d(images, weight, bias, stride, padding, groups=groups)

        # The largest of four neighbours: [N, G * 4 * b * O, ...] -> [N, G * b * O, ...].
        groups, lie = len(networks), layout.writes
        if pool == 2:
            images = F.max_pool2d(images, 2) if layout == PLAIN else _largest_of_four(images, groups)
        images = activation(images)
    return images


def kind_of(layer: nn.Conv2d) -> Kind:
    """Returns what of a convolution matters here; after a stride of 1 there is a max-pool of 2x2."""
    return layer.out_channels, layer.in_channels, layer.kernel_size[0], 2 if layer.stride == (1, 1) else 1


def _reblock(images: Tensor, lie: Blocks, asked: Blocks, groups: int) -> Tensor:
    """Returns images ``[N, G * C, H, W]`` in larger blocks than they lie in.

    The channels' order is: group, column of the block, row, channel.
    """
    if lie == asked:
        return images
    count, channels, height, width = images.shape
    rows, columns = asked[0] // lie[0], asked[1] // lie[1]

    # [N, G * C, H, W] -> [N, H, W, G * C], as it lies in memory -> each dimension cut into its parts.
    shape = count, height // rows, rows, width // columns, columns, groups, lie[1], channels // (groups * lie[1])
    pixels = images.permute(0, 2, 3, 1).reshape(shape)

    # -> [N, H / rows, W / columns, group, new column, old column, new row, old row and channel]
    pixels = pixels.permute(0, 1, 3, 5, 4, 6, 2, 7)

    # -> [N, G * C * rows * columns, H / rows, W / columns]
    return pixels.flatten(3).permute(0, 3, 1, 2)


def _largest_of_four(images: Tensor, groups: int) -> Tensor:
    """Returns the largest of each four channels, ``[N, G * C, H, W]`` of images ``[N, G * 4 * C, H, W]``.

    In an image wide enough, a pixel's four stand in a row: ``max_pool2d`` is fast, forward and backward.
    """
    # [N, G * 4 * C, H, W] -> [N, H, W, G * 4, C] -> [N, H, W * G * 4, C] -> [N, C, H, W * G * 4]
    wide = images.permute(0, 2, 3, 1).unflatten(3, (groups * 4, -1)).flatten(2, 3).permute(0, 3, 1, 2)
    largest = F.max_pool2d(wide, (1, 4))  # [N, C, H, W * G]

    # [N, C, H, W * G] -> [N, H, W, G, C] -> [N, G * C, H, W]
    return largest.permute(0, 2, 3, 1).unflatten(2, (-1, groups)).flatten(3).permute(0, 3, 1, 2)


def _lay_out(
    networks: Sequence[Sequence[nn.Conv2d]], kinds: tuple[Kind, ...], layouts: tuple[Layout, ...], size: tuple[int, ...]
) -> Kernels:
    """Returns what the convolutions on blocks need, all of it gathered from the layers' parameters in one step."""
    table = _make_table(kinds, len(networks), layouts, size)
    layers = [layer for network in networks for layer in network]

    # All parameters in a row behind a zero, and from there to their places, of which a parameter has many.
    flat = [part for layer in layers for part in (layer.weight.flatten(), cast(Tensor, layer.bias))]
    parts = torch.cat([flat[0].new_zeros(1), *flat]).index_select(0, table.places).split(table.sizes)

    # Weights [O, h, w, C], which is how PyTorch's channels_last lays out [O, C, h, w].
    weights = [part.view(shape).permute(0, 3, 1, 2) for part, shape in zip(parts[::2], table.shapes, strict=True)]
    return list(zip(weights, parts[1::2], strict=True))


class _Table(NamedTuple):
    """Where the parameters of convolutions on blocks stand in a zero and those of plain layers, flat.

    Attributes:
        places: Of each layer's weights ``[O, h, w, C]`` and biases ``[O]``, one after another.
        sizes: How many weights and how many biases, layer by layer.
        shapes: Of the weights.
    """

    places: Tensor
    sizes: list[int]
    shapes: list[torch.Size]


@cache
def _make_table(kinds: tuple[Kind, ...], groups: int, layouts: tuple[Layout, ...], size: tuple[int, ...]) -> _Table:
    check_fit(kinds, layouts, size)
    counts = [count for outputs, inputs, side, _ in kinds for count in (outputs * inputs * side**2, outputs)]
    with torch.inference_mode(False), torch.device("cpu"):
        # The parameters' numbers from 1 on (0 is the zero), network by network, cut into weights and biases.
        numbers = torch.arange(1, 1 + groups * sum(counts)).view(groups, -1).split(counts, 1)
        parts, kernels = [], []
        for kind, layout, weights, biases in zip(kinds, layouts, numbers[::2], numbers[1::2], strict=True):
            outputs, inputs, side, pool = kind

            # [G, O * C * side * side] -> [G, O, side, side, C] -> [G * O', h, w, C'] on blocks
            weights = weights.reshape(groups, outputs, inputs, side, side).movedim(2, -1)
            kernels.append(_spread(weights, 1 if layout == PLAIN else pool, layout))

            # The biases [G, O], once for each pixel of a block and each neighbour in a pool.
            parts += [kernels[-1], biases.repeat(1, len(kernels[-1]) // biases.numel())]
        places = torch.cat([part.flatten() for part in parts])
    return _Table(places, [part.numel() for part in parts], [kernel.shape for kernel in kernels])


def check_fit(kinds: tuple[Kind, ...], layouts: tuple[Layout, ...], size: tuple[int, ...]) -> None:
    """Refuses blocks that do not fit together, nor the layers, nor images of some height and width.

    Raises:
        ValueError: If they do not fit.
    """
    lie = PLAIN.writes
    for depth, ((_, _, side, _), layout) in enumerate(zip(kinds, layouts, strict=True)):
        for pixels, before, read, write in zip(size, lie, *layout, strict=True):
            step = 2 * write
            if read % before or step % read or (side // 2) % read or (pixels >> depth) % step:
                raise ValueError(
                    f"{layout} does not fit layer {depth}: the blocks that are read must be multiples of those before, "
                    f"{lie}, and divide its padding, {side // 2}, and twice those that are written, which must divide "
                    f"the image's {size[0] >> depth}x{size[1] >> depth} pixels."
                )
        lie = layout.writes
    if lie != (1, 1):
        raise ValueError(f"the last layer writes blocks of {lie}, which nothing reads: let it write (1, 1).")


def _spread(weights: Tensor, pool: int, layout: Layout) -> Tensor:
    """Returns the kernels on blocks ``[G * O', h, w, C']`` of plain ones ``[G, O, size, size, C]``.

    Outputs lie in the order: group, neighbour in the pool, column of the block, row, channel.
    """
    (rows, columns), (height, width) = layout
    groups, outputs, size, _, inputs = weights.shape
    step = 2 // pool

    # All that the outputs of one block see together, rounded up to whole blocks that are read.
    reach = [size + step * (pool * side - 1) for side in layout.writes]
    reach = [reached + -reached % read for reached, read in zip(reach, layout.reads, strict=True)]

    # For each pixel of a block that is written, and each of its neighbours in the pool, the kernel, moved there.
    kernels = weights.new_zeros(groups, pool, pool, width, height, outputs, *reach, inputs)
    for row, column in itertools.product(range(pool * height), range(pool * width)):
        top, left, pixel = step * row, step * column, (row % pool, column % pool, column // pool, row // pool)
        kernels[:, *pixel, :, top : top + size, left : left + size] = weights

    # [G, pool, pool, width, height, O, reach, reach, C] -> [G * O', h, rows, w, columns, C] -> [G * O', h, w, C'],
    # the pixels of a block that is read in the channels, column by column.
    kernels = kernels.flatten(0, 5).unflatten(2, (-1, columns)).unflatten(1, (-1, rows))
    return kernels.permute(0, 1, 3, 4, 2, 5).flatten(3)
