"""Convolutions on blocks compute what plain ones do."""

import itertools
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from halgan_rl.models.halving import Downsample, Halving, halve

DOWNSAMPLES = ("stride", "max_pool")


def plain(images: Tensor, layer: Halving) -> Tensor:
    """Halve images ``[N, C, H, W]`` as the layer's docstring says, with nothing but PyTorch's functions."""
    if layer.pool == 1:
        return F.conv2d(images, layer.weight, layer.bias, stride=2, padding=2)
    return F.max_pool2d(F.conv2d(images, layer.weight, layer.bias, padding=2), 2)


def make_layer(downsample: Downsample, blocks_in: int, blocks_out: int, channels: tuple[int, int] = (3, 4)) -> Halving:
    layer = Halving(*channels, 5, downsample=downsample, blocks_in=blocks_in, blocks_out=blocks_out)
    return layer.to(torch.float64, memory_format=torch.channels_last)


def make_images(channels: int, side: int = 16) -> Tensor:
    """Random images, the left half of one color: there, outputs are equal, and a maximum is not alone."""
    images = torch.randn(5, channels, side, side, dtype=torch.float64)
    images[..., : side // 2] = 0.5
    return images.to(memory_format=torch.channels_last)


@pytest.mark.parametrize("downsample", DOWNSAMPLES)
@pytest.mark.parametrize(("blocks_in", "blocks_out"), list(itertools.product((1, 2), (1, 2, 4))))
def test_blocks_change_neither_values_nor_gradients(downsample: Downsample, blocks_in: int, blocks_out: int) -> None:
    torch.manual_seed(0)
    layer, images = make_layer(downsample, blocks_in, blocks_out), make_images(3)
    expected = plain(images.requires_grad_(), layer)
    weights = torch.randn_like(expected)
    wanted = torch.autograd.grad((expected * weights).sum(), [images, *layer.parameters()])
    blocks = layer(F.pixel_unshuffle(images, blocks_in))
    got = F.pixel_shuffle(blocks, blocks_out)
    torch.testing.assert_close(got, expected)
    for one, other in zip(
        torch.autograd.grad((got * weights).sum(), [images, *layer.parameters()]), wanted, strict=True
    ):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("downsample", DOWNSAMPLES)
@pytest.mark.parametrize(("blocks_in", "blocks_out"), [(1, 1), (1, 2), (2, 1)])
def test_several_layers_at_once_give_what_each_gives(
    downsample: Downsample, blocks_in: int, blocks_out: int, shared: bool
) -> None:
    torch.manual_seed(0)
    layers = [make_layer(downsample, blocks_in, blocks_out) for _ in range(3)]
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    images = [make_images(3)] * 3 if shared else [make_images(3) for _ in layers]
    images = [F.pixel_unshuffle(image, blocks_in) for image in images]
    alone = torch.cat([layer(image) for layer, image in zip(layers, images, strict=True)], 1)
    together = halve(images[0] if shared else torch.cat(images, 1), layers, shared=shared)
    torch.testing.assert_close(together, alone)
    weights = torch.randn_like(alone)
    for one, other in zip(
        torch.autograd.grad((together * weights).sum(), parameters),
        torch.autograd.grad((alone * weights).sum(), parameters),
        strict=True,
    ):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("downsample", DOWNSAMPLES)
def test_off_the_cpu_images_come_as_they_are(downsample: Downsample) -> None:
    layers = nn.Sequential(make_layer(downsample, 1, 2), make_layer(downsample, 2, 1, (4, 8))).to("meta")
    images = torch.zeros(2, 3, 16, 16, dtype=torch.float64, device="meta")
    assert layers[0](images).shape == (2, 4, 8, 8)
    assert layers(images).shape == (2, 8, 4, 4)


def test_blocks_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"blocks_in=4 must divide the padding, 2, and 2 \* blocks_out, 4"):
        Halving(3, 4, 5, blocks_in=4, blocks_out=2)


@pytest.mark.parametrize("mode", [torch.inference_mode(), torch.device("meta")], ids=["inference", "meta"])
def test_where_a_layer_is_made_does_not_matter(mode: Any) -> None:
    with mode:
        made = Halving(3, 4, 5, blocks_out=2)
    layer = make_layer("stride", 1, 2)
    layer._blocks = made._blocks
    images = make_images(3)
    halved = layer(images)
    torch.testing.assert_close(F.pixel_shuffle(halved, 2), plain(images, layer))
    halved.sum().backward()
