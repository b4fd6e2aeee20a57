"""What agents see with: the convolutions of the paper, in plain layers."""

from collections.abc import Iterable
from typing import Literal

import torch
from torch import Tensor, nn

from halgan_rl.transforms.pixels import to_float

Downsample = Literal["stride", "max_pool"]
ImageShape = tuple[int, int, int]
"""Height, width and channels."""

CHANNELS = (4, 8, 16, 32)
"""Channels of the convolutions (Sahni et al., NeurIPS 2019, appendix)."""
LEAK = 0.3
"""Slope of LeakyReLU below zero: that of Keras, which the paper's authors use."""
SMALLEST = 2 ** len(CHANNELS)
"""Height and width that all halvings need [pixels]."""
HIDDEN = 32
"""Units of the layer behind the features."""


class Encoder(nn.Module):
    """Four 5x5 convolutions of 4, 8, 16 and 32 channels, each of which halves the image.

    It has 17,160 parameters for three channels.

    Args:
        image_shape: Height, width and channels of the images, each side at least 16 pixels.
        downsample: How each convolution halves: ``"stride"`` 2, or ``"max_pool"`` of 2x2 behind it. The paper does not
            say which. The parameters are the same; strides take less than half of the time.

    Attributes:
        features: Size of the output, F.

    Raises:
        ValueError: If ``image_shape`` is no height, width and channels, or ``downsample`` is neither.

    Examples:
        >>> encoder = Encoder((84, 84, 12))  # four frames, stacked along the channels
        >>> encoder(torch.zeros(5, 84, 84, 12, dtype=torch.uint8)).shape, encoder.features
        (torch.Size([5, 1152]), 1152)
    """

    def __init__(self, image_shape: Iterable[int] = (64, 64, 3), downsample: Downsample = "stride") -> None:
        super().__init__()
        self.image_shape = height, width, channels = check_image_shape(image_shape)
        if downsample not in ("stride", "max_pool"):
            raise ValueError(f"downsample={downsample!r} is unknown: choose 'stride' or 'max_pool'.")
        self.downsample = downsample
        layers: list[nn.Module] = []
        for inputs, outputs in zip((channels, *CHANNELS), CHANNELS, strict=False):
            if downsample == "stride":
                layers += [nn.Conv2d(inputs, outputs, kernel_size=5, stride=2, padding=2)]
            else:
                layers += [nn.Conv2d(inputs, outputs, kernel_size=5, padding=2), nn.MaxPool2d(2)]
            layers += [nn.LeakyReLU(LEAK)]
            height, width = (-(-side // 2) if downsample == "stride" else side // 2 for side in (height, width))
        self.layers = nn.Sequential(*layers, nn.Flatten())
        self.features = height * width * CHANNELS[-1]

    @property
    def convolutions(self) -> list[nn.Conv2d]:
        """The convolutions, from the first to the last."""
        return [layer for layer in self.layers if isinstance(layer, nn.Conv2d)]

    def forward(self, pixels: Tensor) -> Tensor:
        """Returns features ``[N, F]`` of images uint8 ``[..., H, W, C]``, N the product of the leading dimensions.

        Raises:
            ValueError: If the images have another shape or type than the encoder was built for.
        """
        self.check(pixels)
        return self.layers(to_float(pixels))  # to_float: uint8 [..., H, W, C] -> float [N, C, H, W] in [-1, 1]

    def check(self, pixels: Tensor) -> None:
        """Raises a ValueError unless ``pixels`` are images for which the encoder was built."""
        if pixels.shape[-3:] != self.image_shape or pixels.dtype != torch.uint8:
            height, width, channels = self.image_shape
            raise ValueError(
                f"pixels must be uint8 [..., {height}, {width}, {channels}] (height, width, channels), got "
                f"{pixels.dtype} {list(pixels.shape)}. Move channels last, stack frames along the channels, and give "
                "their number in image_shape."
            )


def check_image_shape(image_shape: Iterable[int]) -> ImageShape:
    """Returns an image shape as a tuple of height, width and channels.

    Raises:
        ValueError: If it is none, or too small for an encoder.
    """
    shape = tuple(image_shape)
    if len(shape) != 3 or min(shape) < 1 or min(shape[:2]) < SMALLEST:
        raise ValueError(
            f"image_shape={shape} must be height, width and channels, height and width at least {SMALLEST} pixels. "
            "Move channels last, and stack frames along the channels."
        )
    height, width, channels = shape
    return height, width, channels


def make_head(inputs: int, outputs: int) -> nn.Sequential:
    """Returns what follows the features: a hidden layer of 32 units, and the outputs."""
    return nn.Sequential(nn.Linear(inputs, HIDDEN), nn.LeakyReLU(LEAK), nn.Linear(HIDDEN, outputs))
