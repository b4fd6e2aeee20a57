"""What agents see with: plain layers, for images of any size and number of channels."""

import pytest
import torch
from torch import Tensor, nn

from halgan_rl.agents.encoder import Downsample, Encoder
from tests.agents.rows import frames

SHAPES = [(64, 64, 3), (84, 84, 3), (64, 64, 1), (64, 64, 12), (84, 84, 4), (17, 130, 2), (16, 16, 3)]


@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
@pytest.mark.parametrize("image_shape", SHAPES)
def test_features_are_as_many_as_announced(image_shape: tuple[int, int, int], downsample: Downsample) -> None:
    encoder = Encoder(image_shape, downsample)
    assert encoder(frames(2, 3, image_shape=image_shape)).shape == (6, encoder.features)


@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_an_encoder_has_the_papers_parameters(downsample: Downsample) -> None:
    encoder = Encoder(downsample=downsample)
    assert (sum(p.numel() for p in encoder.parameters()), encoder.features) == (17_160, 512)


def test_the_layers_that_are_listed_are_those_that_run() -> None:
    encoder = Encoder()
    before = encoder(frames(2))
    encoder.layers[1] = nn.ReLU()
    assert not torch.allclose(encoder(frames(2)), before)


@pytest.mark.parametrize(
    "image_shape",
    [(3, 64, 64), (64, 64), (4, 64, 64, 3), (64, 15, 3), (64, 64, 0), ()],
    ids=["channels first", "no channels", "stack", "narrow", "empty", "scalar"],
)
def test_what_is_no_image_shape_is_refused_when_the_encoder_is_built(image_shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="must be height, width and channels, height and width at least 16 pixels"):
        Encoder(image_shape)


def test_an_unknown_downsampling_is_refused() -> None:
    with pytest.raises(ValueError, match="downsample='average' is unknown: choose 'stride' or 'max_pool'"):
        Encoder(downsample="average")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("pixels", "got"),
    [
        (torch.zeros(2, 3, 64, 64, dtype=torch.uint8), r"uint8 \[2, 3, 64, 64\]"),
        (torch.zeros(2, 64, 64, 3), r"float32 \[2, 64, 64, 3\]"),
        (torch.zeros(2, 64, 64, 12, dtype=torch.uint8), r"uint8 \[2, 64, 64, 12\]"),
        (torch.zeros(64, 64, dtype=torch.uint8), r"uint8 \[64, 64\]"),
    ],
    ids=["channels first", "float", "frames stacked", "no channels"],
)
def test_images_of_another_layout_or_type_are_refused(pixels: Tensor, got: str) -> None:
    with pytest.raises(ValueError, match=rf"pixels must be uint8 \[..., 64, 64, 3\] \(.*got torch.{got}. Move"):
        Encoder()(pixels)
