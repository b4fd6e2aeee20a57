"""Convolutions on blocks compute what plain ones do."""

import itertools
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from halgan_rl.agents.encoder import Downsample
from halgan_rl.agents.fast_cpu import block_convolutions
from halgan_rl.agents.fast_cpu.block_convolutions import PLAIN, Blocks, Layout, halve

DOWNSAMPLES = ("stride", "max_pool")
BLOCKS = ((1, 1), (1, 2), (2, 1), (2, 2))


def plain(images: Tensor, layers: list[nn.Conv2d]) -> Tensor:
    """Halves images ``[N, C, H, W]`` as the docstrings say, with nothing but PyTorch's functions."""
    for layer in layers:
        if layer.stride == (2, 2):
            images = F.conv2d(images, layer.weight, layer.bias, stride=2, padding=2)
        else:
            images = F.max_pool2d(F.conv2d(images, layer.weight, layer.bias, padding=2), 2)
        images = images.tanh()
    return images


def make_network(downsample: Downsample, *channels: int) -> list[nn.Conv2d]:
    stride = 2 if downsample == "stride" else 1
    layers = [nn.Conv2d(c, o, 5, stride=stride, padding=2) for c, o in itertools.pairwise(channels)]
    return [layer.to(torch.float64, memory_format=torch.channels_last) for layer in layers]


def make_images(channels: int, side: int = 16) -> Tensor:
    """Random images, the left half of one color: there, outputs are equal, and a maximum is not alone."""
    images = torch.randn(5, channels, side, side, dtype=torch.float64)
    images[..., : side // 2] = 0.5
    return images.to(memory_format=torch.channels_last).requires_grad_()


def check(images: Tensor, networks: list[list[nn.Conv2d]], layouts: list[Layout]) -> None:
    """Compares values and all gradients with those of the plain layers."""
    expected = torch.cat([plain(images, network) for network in networks], 1)
    got = halve(images, networks, layouts, torch.tanh)
    torch.testing.assert_close(got, expected)
    weights = torch.randn_like(expected)
    learned = [images, *(p for network in networks for layer in network for p in layer.parameters())]
    wanted = torch.autograd.grad((expected * weights).sum(), learned)
    for one, other in zip(torch.autograd.grad((got * weights).sum(), learned), wanted, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("networks", [1, 3])
@pytest.mark.parametrize("downsample", DOWNSAMPLES)
@pytest.mark.parametrize("last", [PLAIN, Layout(reads=(2, 2))])
@pytest.mark.parametrize("between", BLOCKS)
@pytest.mark.parametrize("first", [(1, 1), (2, 1), (1, 2)])
def test_blocks_change_neither_values_nor_gradients(
    downsample: Downsample, networks: int, first: Blocks, between: Blocks, last: Layout
) -> None:
    torch.manual_seed(0)
    made = [make_network(downsample, 3, 4, 2, 3) for _ in range(networks)]
    check(make_images(3), made, [Layout(first, between), Layout(reads=between), last])


@pytest.mark.parametrize("downsample", DOWNSAMPLES)
def test_blocks_grow_between_layers(downsample: Downsample) -> None:
    torch.manual_seed(0)
    made = [make_network(downsample, 3, 4, 2) for _ in range(2)]
    for lie, asked in itertools.product(BLOCKS, BLOCKS):
        if lie[0] <= asked[0] and lie[1] <= asked[1]:
            check(make_images(3), made, [Layout(writes=lie), Layout(reads=asked)])


@pytest.mark.parametrize(
    ("side", "layouts"),
    [
        (16, [Layout((4, 1), (2, 2)), Layout((2, 2))]),  # not within the padding
        (16, [Layout((1, 1), (2, 1)), Layout((1, 2))]),  # not multiples of those before
        (18, [Layout((1, 1), (2, 2)), Layout((2, 2))]),  # not within the image
        (17, [Layout((1, 1), (2, 2)), Layout((2, 2))]),
        (14, [PLAIN, Layout((2, 2))]),
    ],
)
def test_blocks_that_do_not_fit_are_refused(side: int, layouts: list[Layout]) -> None:
    with pytest.raises(ValueError, match=r"does not fit layer [01]"):
        halve(make_images(3, side), [make_network("stride", 3, 4, 2)], layouts)


def test_blocks_that_nothing_reads_are_refused() -> None:
    with pytest.raises(ValueError, match=r"the last layer writes blocks of \(2, 1\)"):
        halve(make_images(3), [make_network("stride", 3, 4)], [Layout(writes=(2, 1))])


@pytest.mark.parametrize("layout", [PLAIN, Layout(reads=(2, 1))])
def test_networks_that_differ_are_refused(layout: Layout) -> None:
    one = make_network("stride", 3, 4)
    for other in (make_network("max_pool", 3, 4), make_network("stride", 3, 5), make_network("stride", 3, 4, 4)):
        with pytest.raises(ValueError, match="need the same layers"):
            halve(make_images(3), [one, other], [layout])


def test_a_network_may_halve_in_both_ways() -> None:
    torch.manual_seed(0)
    made = [[*make_network("max_pool", 3, 4), *make_network("stride", 4, 2)] for _ in range(2)]
    check(make_images(3), made, [Layout(writes=(2, 1)), Layout(reads=(2, 1))])


@pytest.mark.parametrize("mode", [torch.inference_mode(), torch.device("meta")], ids=["inference", "meta"])
def test_where_kernels_are_first_laid_out_does_not_matter(mode: Any) -> None:
    network, layouts = make_network("stride", 3, 4), [Layout(reads=(2, 1))]
    block_convolutions._make_table.cache_clear()
    with mode:
        halve(make_images(3).detach(), [network], layouts)
    images = make_images(3)
    halve(images, [network], layouts).sum().backward()
    assert images.grad is not None
