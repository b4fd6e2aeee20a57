"""The paper's generator (Sahni et al., NeurIPS 2019, appendix)."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.base import LEAK, HallucinationGenerator
from halgan_rl.hallucination.generators.goal_encoding import Configuration

Composition = Literal["dimming", "difference"]


class PaperGenerator(HallucinationGenerator):
    """The paper's generator: six doublings, each an upsampling, a 4x4 convolution, BatchNorm and LeakyReLU.

    The latent, drawn from N(1, 0.1), *multiplies* the embedded configuration. 323,707 numbers in the 2-dimensional
    configuration, counting BatchNorm's running statistics. Images of another size than 64x64 come out of the last
    upsampling, from 32x32.

    Args:
        configuration: how the relative pose is described to the network.
        pose_size: P, entries of a pose.
        latent_size: Z.
        composition: ``"dimming"`` is the paper's tanh(s + H), which shrinks the contrast of the whole image even where
            H = 0; ``"difference"`` is s + tanh(s + H) - tanh(s), the identity there.

    Keyword Args:
        image_shape: height H, width W and channels C of the images.
        frame_stack: how many frames are stacked along the channels, each with 1 or 3 of them.

    Raises:
        ValueError: if a value has another type or is out of range.
    """

    def __init__(
        self,
        configuration: Configuration = "polar",
        pose_size: int = 3,
        latent_size: int = 128,
        composition: Composition = "dimming",
        *,
        image_shape: Sequence[int] = (64, 64, 3),
        frame_stack: int = 1,
    ) -> None:
        if composition not in ("dimming", "difference"):
            raise ValueError(f"composition={composition!r} is unknown: choose 'dimming' or 'difference'.")
        super().__init__(configuration, pose_size, latent_size, image_shape=image_shape, frame_stack=frame_stack)
        self.arguments["composition"] = composition
        self.composition = composition
        self.embedding = nn.Linear(self.encoding.size, latent_size)
        layers: list[nn.Module] = []
        sizes = [(2, 2), (4, 4), (8, 8), (16, 16), (32, 32), self.image_shape[:2]]
        widths = [latent_size, 64, 64, 64, 32, 32, 16]
        for size, (inputs, outputs) in zip(sizes, pairwise(widths), strict=True):
            layers += [nn.Upsample(size), *same_convolution(inputs, outputs)]
            layers += [nn.BatchNorm2d(outputs), nn.LeakyReLU(LEAK)]
        layers += [*same_convolution(16, 8), nn.BatchNorm2d(8), nn.LeakyReLU(LEAK)]
        layers += [*same_convolution(8, self.image_shape[2]), nn.Tanh()]
        self.layers = nn.Sequential(*layers)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, features: Tensor, latent: Tensor, *, size: Sequence[int] | None = None) -> Tensor:
        """Returns H ``[N, C, h, w]`` in [-1, 1] for features ``[N, K]`` and latents ``[N, Z]``, averaged if smaller."""
        change: Tensor = self.layers((self.embedding(features) * latent)[:, :, None, None])
        return change if size is None else nn.functional.adaptive_avg_pool2d(change, (size[0], size[1]))

    def sample_latent(self, count: int, rng: torch.Generator) -> Tensor:
        """Draws latents ``[count, Z]`` from N(1, 0.1)."""
        return 1 + 0.1 * torch.randn(count, self.latent_size, generator=rng)

    def extent(self, change: Tensor) -> Tensor:
        """Returns the mean absolute H of each image, ``[N]``."""
        return change.abs().mean((1, 2, 3))

    def compose(self, images: Tensor, change: Tensor) -> Tensor:
        """Returns images with H added, see ``composition``."""
        if self.composition == "dimming":
            return torch.tanh(images + change)
        return images + (torch.tanh(images + change) - torch.tanh(images))


def same_convolution(inputs: int, outputs: int, stride: int = 1) -> list[nn.Module]:
    """Returns a 4x4 convolution that keeps the size (stride 1) or halves it (stride 2); Keras' "same" padding."""
    if stride == 2:
        return [nn.Conv2d(inputs, outputs, 4, stride=2, padding=1)]
    return [nn.ZeroPad2d((1, 2, 1, 2)), nn.Conv2d(inputs, outputs, 4)]
