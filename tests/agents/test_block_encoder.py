"""Encoders on blocks of pixels, and several in one pass, are the plain ones."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from halgan_rl.agents.encoder import Downsample, Encoder
from halgan_rl.agents.fast_cpu import block_encoder
from halgan_rl.agents.fast_cpu.block_convolutions import halve
from halgan_rl.agents.fast_cpu.block_encoder import BlockEncoder, encode_together, fits
from tests.agents.rows import frames


def flat_frames(*leading: int, **options: Any) -> Tensor:
    """Returns images whose left half is of one color: there, pooled outputs are equal, and a maximum is not alone."""
    pixels = frames(*leading, **options)
    pixels[..., : pixels.shape[-2] // 2, :] = 200
    return pixels


@pytest.mark.parametrize("learn", [True, False])
@pytest.mark.parametrize("networks", [1, 2, 3])
@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
@pytest.mark.parametrize("image_shape", [(64, 64, 3), (64, 64, 12), (32, 48, 1)])
def test_encoders_see_together_what_each_sees_alone(
    image_shape: tuple[int, int, int], downsample: Downsample, networks: int, learn: bool
) -> None:
    torch.manual_seed(0)
    encoders = [Encoder(image_shape, downsample) for _ in range(networks)]
    assert all(fits(encoder) for encoder in encoders)
    pixels = flat_frames(2, 3, image_shape=image_shape)
    with torch.set_grad_enabled(learn):
        together = encode_together(pixels, encoders)
        for encoder, seen in zip(encoders, together, strict=True):
            torch.testing.assert_close(seen, encoder(pixels))


@pytest.mark.parametrize("networks", [1, 2])
@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_encoders_learn_together_what_each_learns_alone(downsample: Downsample, networks: int) -> None:
    torch.manual_seed(0)
    encoders, pixels = [Encoder(downsample=downsample) for _ in range(networks)], flat_frames(6)
    together = torch.cat(encode_together(pixels, encoders))
    alone = torch.cat([encoder(pixels) for encoder in encoders])
    parameters = [parameter for encoder in encoders for parameter in encoder.parameters()]
    weights = torch.randn_like(alone)
    got, wanted = (torch.autograd.grad((features * weights).sum(), parameters) for features in (together, alone))
    for one, other in zip(got, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("learn", [True, False])
@pytest.mark.parametrize("networks", [1, 3])
@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_activations_stay_channels_last(
    downsample: Downsample, networks: int, learn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, conv2d = [], F.conv2d

    def spy(images: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        halved = conv2d(images, *args, **kwargs)
        seen.extend([images, halved])
        return halved

    monkeypatch.setattr(F, "conv2d", spy)
    with torch.set_grad_enabled(learn):
        encode_together(frames(2), [Encoder(downsample=downsample) for _ in range(networks)])
    assert [images.is_contiguous(memory_format=torch.channels_last) for images in seen] == 8 * [True]


def test_layouts_are_chosen_for_what_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []

    def spy(images: Tensor, networks: Any, layouts: Any, activation: Any) -> Tensor:
        given.append(tuple(layouts))
        return halve(images, networks, layouts, activation)

    monkeypatch.setattr(block_encoder, "halve", spy)
    encoders = [BlockEncoder(), BlockEncoder()]
    for networks in (encoders[:1], encoders):
        encode_together(frames(2), networks)
        with torch.no_grad():
            encode_together(frames(2), networks)
    assert len(set(given)) == 4
    given.clear()
    torch.compile(encoders[0], fullgraph=True, backend="eager")(frames(2))
    encode_together(frames(2).to("meta"), [Encoder().to("meta")])
    assert given == []  # both are plain


def test_images_of_another_layout_are_refused() -> None:
    with pytest.raises(ValueError, match=r"pixels must be uint8 \[..., 64, 64, 3\]"):
        BlockEncoder()(torch.zeros(2, 3, 64, 64, dtype=torch.uint8))


def test_encoders_of_different_downsamplings_are_refused() -> None:
    with pytest.raises(ValueError, match=r"one down-sampling, got \['max_pool', 'stride'\]"):
        encode_together(frames(2), [Encoder(downsample="max_pool"), Encoder()])


@pytest.mark.parametrize("image_shape", [(84, 84, 3), (64, 72, 3)])
def test_images_that_blocks_do_not_divide_do_not_fit(image_shape: tuple[int, int, int]) -> None:
    assert not fits(Encoder(image_shape))
    assert not fits(Encoder(image_shape, "max_pool"))


CHANGES: dict[str, tuple[int, nn.Module]] = {
    "activation": (1, nn.ReLU()),
    "slope": (3, nn.LeakyReLU(0.1)),
    "kernel": (4, nn.Conv2d(8, 16, 3, stride=2, padding=1)),
    "no bias": (4, nn.Conv2d(8, 16, 5, stride=2, padding=2, bias=False)),
    "padding": (2, nn.Conv2d(4, 8, 5, stride=2, padding=2, padding_mode="reflect")),
    "normalised": (3, nn.Sequential(nn.BatchNorm2d(8), nn.LeakyReLU(0.3))),
}


@pytest.mark.parametrize("change", CHANGES)
def test_an_encoder_with_another_layer_does_not_fit(change: str) -> None:
    encoder, (place, layer) = Encoder(), CHANGES[change]
    assert fits(encoder)
    encoder.layers[place] = layer
    assert not fits(encoder)


def test_an_encoder_with_more_layers_or_of_another_class_does_not_fit() -> None:
    class Other(Encoder):
        pass

    longer = Encoder()
    longer.layers.insert(8, nn.Conv2d(32, 32, 3, padding=1))
    assert not fits(longer)
    assert not fits(Other())
