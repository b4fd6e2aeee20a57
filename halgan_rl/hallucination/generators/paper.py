"""The networks of the paper (Sahni et al., NeurIPS 2019, appendix): generator and discriminator."""

from abc import ABC, abstractmethod
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.goal_encoding import Configuration, GoalEncoding

LEAK = 0.3  # the slope of Keras' LeakyReLU, which the authors use


class HallucinationGenerator(nn.Module, ABC):
    """Draws what has to change in an image so that it shows the goal.

    Its output depends on the relative pose and a latent alone, never on the image.

    Args:
        configuration: how the network is told the relative pose.
        pose_size: P, entries of a pose.
        latent_size: Z.

    Attributes:
        arguments: what rebuilds the network, ready for JSON; subclasses add their own.
        encoding: turns poses into the network's features.
    """

    def __init__(self, configuration: Configuration, pose_size: int, latent_size: int) -> None:
        super().__init__()
        self.arguments: dict[str, int | float | str] = {
            "configuration": configuration,
            "pose_size": pose_size,
            "latent_size": latent_size,
        }
        self.encoding = GoalEncoding(configuration, pose_size)
        self.latent_size = latent_size

    @abstractmethod
    def forward(self, features: Tensor, latent: Tensor) -> Tensor:
        """Return the change, float ``[N, C, 64, 64]``, for features ``[N, K]`` and a latent ``[N, Z]``."""

    @abstractmethod
    def sample_latent(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw latents ``[count, Z]`` from their prior."""

    @abstractmethod
    def compose(self, images: Tensor, change: Tensor) -> Tensor:
        """Apply a change to images float ``[N, 3, 64, 64]`` in [-1, 1]; same shape and range."""


class PaperGenerator(HallucinationGenerator):
    """The paper's generator: six doublings, each an upsampling, a 4x4 convolution, BatchNorm and LeakyReLU.

    The latent, drawn from N(1, 0.1), *multiplies* the embedded configuration. 323,707 numbers in the 2-dimensional
    configuration, counting BatchNorm's running statistics.

    Args:
        configuration: how the network is told the relative pose.
        pose_size: P, entries of a pose.
        latent_size: Z.
        composition: ``"dimming"`` is the paper's tanh(s + H), which shrinks the contrast of the whole image even where
            H = 0; ``"difference"`` is s + tanh(s + H) - tanh(s), the identity there.
    """

    def __init__(
        self,
        configuration: Configuration = "polar",
        pose_size: int = 3,
        latent_size: int = 128,
        composition: Literal["dimming", "difference"] = "dimming",
    ) -> None:
        super().__init__(configuration, pose_size, latent_size)
        self.arguments["composition"] = composition
        self.composition = composition
        self.embedding = nn.Linear(self.encoding.size, latent_size)
        layers: list[nn.Module] = []
        widths = [latent_size, 64, 64, 64, 32, 32, 16]
        for inputs, outputs in pairwise(widths):
            layers += [nn.Upsample(scale_factor=2), *_same_convolution(inputs, outputs)]
            layers += [nn.BatchNorm2d(outputs), nn.LeakyReLU(LEAK)]
        layers += [*_same_convolution(16, 8), nn.BatchNorm2d(8), nn.LeakyReLU(LEAK)]
        layers += [*_same_convolution(8, 3), nn.Tanh()]
        self.layers = nn.Sequential(*layers)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, features: Tensor, latent: Tensor) -> Tensor:
        """Return H ``[N, 3, 64, 64]`` in [-1, 1]."""
        return self.layers((self.embedding(features) * latent)[:, :, None, None])

    def sample_latent(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw latents ``[count, Z]`` from N(1, 0.1)."""
        return 1 + 0.1 * torch.randn(count, self.latent_size, generator=rng)

    def compose(self, images: Tensor, change: Tensor) -> Tensor:
        """Add H to images, see ``composition``."""
        if self.composition == "dimming":
            return torch.tanh(images + change)
        return images + (torch.tanh(images + change) - torch.tanh(images))


class Discriminator(nn.Module):
    """The paper's discriminator: seven 4x4 convolutions and two heads, realism and configuration. 330,019 parameters.

    Args:
        feature_size: K, entries of the configuration's features to regress.
        first_stride: 1 as in the paper; 2 costs about a quarter of the arithmetic, with the same parameters.
    """

    def __init__(self, feature_size: int = 2, first_stride: Literal[1, 2] = 1) -> None:
        super().__init__()
        strides = [first_stride, 2, 2, 2, 2, 2, 2 if first_stride == 1 else 1]
        widths = [3, 32, 32, 32, 64, 64, 64, 128]
        layers: list[nn.Module] = []
        for inputs, outputs, stride in zip(widths[:-1], widths[1:], strides, strict=True):
            layers += [*_same_convolution(inputs, outputs, stride), nn.LeakyReLU(LEAK)]
        self.layers = nn.Sequential(*layers, nn.Flatten())
        self.realism = nn.Linear(128, 1)
        self.configuration = nn.Linear(128, feature_size)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Judge images ``[N, 3, 64, 64]`` in [-1, 1].

        Returns:
            The critic's score ``[N]`` and the regressed features ``[N, K]``.
        """
        hidden = self.layers(images)
        return self.realism(hidden).squeeze(-1), self.configuration(hidden)


def _same_convolution(inputs: int, outputs: int, stride: int = 1) -> list[nn.Module]:
    """Build a 4x4 convolution that keeps the size (stride 1) or halves it (stride 2); Keras' "same" padding."""
    if stride == 2:
        return [nn.Conv2d(inputs, outputs, 4, stride=2, padding=1)]
    return [nn.ZeroPad2d((1, 2, 1, 2)), nn.Conv2d(inputs, outputs, 4)]
