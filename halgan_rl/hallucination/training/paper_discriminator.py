"""The paper's discriminator (Sahni et al., NeurIPS 2019, appendix)."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.base import LEAK
from halgan_rl.hallucination.generators.paper import same_convolution

SMALLEST = 64
"""Height and width that six halvings bring down to 1 [pixels]."""


class Discriminator(nn.Module):
    """The paper's discriminator: seven 4x4 convolutions and two heads, realism and configuration. 330,019 parameters.

    Args:
        feature_size: K, entries of the configuration's features to regress.

    Keyword Args:
        image_shape: height H, width W and channels C of the images.
        first_stride: 1 as in the paper; 2 costs about a quarter of the arithmetic, with the same parameters.

    Raises:
        ValueError: if the images are smaller than 64x64.
    """

    def __init__(
        self, feature_size: int = 2, *, image_shape: Sequence[int] = (64, 64, 3), first_stride: Literal[1, 2] = 1
    ) -> None:
        height, width, channels = image_shape
        if min(height, width) < SMALLEST:
            raise ValueError(
                f"image_shape={tuple(image_shape)} is too small for the discriminator, which halves images six times: "
                f"height and width must be at least {SMALLEST} pixels. Enlarge the images, or train by matte "
                "regression alone."
            )
        super().__init__()
        strides = [first_stride, 2, 2, 2, 2, 2, 2 if first_stride == 1 else 1]
        widths = [channels, 32, 32, 32, 64, 64, 64, 128]
        layers: list[nn.Module] = []
        for inputs, outputs, stride in zip(widths[:-1], widths[1:], strides, strict=True):
            layers += [*same_convolution(inputs, outputs, stride), nn.LeakyReLU(LEAK)]
        hidden = widths[-1] * (height // SMALLEST) * (width // SMALLEST)  # each halving rounds down
        self.layers = nn.Sequential(*layers, nn.Flatten())
        self.realism = nn.Linear(hidden, 1)
        self.configuration = nn.Linear(hidden, feature_size)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Judges images ``[N, C, H, W]`` in [-1, 1].

        Returns:
            The critic's score ``[N]`` and the regressed features ``[N, K]``.
        """
        hidden = self.layers(images)
        return self.realism(hidden).squeeze(-1), self.configuration(hidden)
