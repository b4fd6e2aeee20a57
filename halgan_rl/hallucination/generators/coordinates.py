"""A generator that paints by coordinates: cheap, and exact under shifts of the goal across the image."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.base import LEAK, HallucinationGenerator, check_count, check_number
from halgan_rl.hallucination.generators.goal_encoding import Configuration


class CoordinateGenerator(HallucinationGenerator):
    """Decides for each pixel, from its coordinates alone, whether the goal covers it and in which colour.

    A small network turns relative pose and latent into a set of half-planes of the image, the first layer of a
    pixel-wise network: affine maps of (u, v), which place, scale and turn whatever the shared layers behind them
    draw. Moving the goal is then a change of a few numbers and not, as in a stack of convolutions, a picture to be
    learned for each place; bearing comes out right from the start, and an image costs less than half of the paper's.

    The output is a matte for each of the S stacked frames, ``[N, C + S, H, W]``: the C colours in [-1, 1], in the order
    of the image's channels, then an opacity in [0, 1] for each frame.

    Args:
        configuration: how the relative pose is described to the network.
        pose_size: P, entries of a pose.
        latent_size: Z; the latent is drawn from N(0, 1). It has little to say: which way the goal is turned.

    Keyword Args:
        image_shape: height H, width W and channels C of the images.
        frame_stack: S, how many frames are stacked along the channels, each with 1 or 3 of them.
        width: channels of each pixel-wise layer.
        depth: pixel-wise layers behind the first.
        opacity: mean opacity before training; small, so that training starts near the identity.
        gain: factor on the half-planes' slopes; large, so that edges become sharp soon.

    Attributes:
        coordinates: u, v in (-1, 1) and 1 of each pixel, row by row, ``[H * W, 3]``.

    Raises:
        ValueError: if a value has another type or is out of range.
    """

    coordinates: Tensor

    def __init__(
        self,
        configuration: Configuration = "planar",
        pose_size: int = 3,
        latent_size: int = 2,
        *,
        image_shape: Sequence[int] = (64, 64, 3),
        frame_stack: int = 1,
        width: int = 32,
        depth: int = 2,
        opacity: float = 0.05,
        gain: float = 10.0,
    ) -> None:
        check_count("width", width, most=1024)
        check_count("depth", depth, least=0, most=16)
        check_number("opacity", opacity, 0, 1)
        check_number("gain", gain, 0, 1e6)
        super().__init__(configuration, pose_size, latent_size, image_shape=image_shape, frame_stack=frame_stack)
        self.arguments |= {"width": width, "depth": depth, "opacity": opacity, "gain": gain}
        self.gain = gain
        channels = self.image_shape[2]
        self._parts = [channels, frame_stack]
        last = nn.Linear(64, 3 * width)
        self.place = nn.Sequential(
            nn.Linear(self.encoding.size + latent_size, 64),
            nn.LeakyReLU(LEAK),
            nn.Linear(64, 64),
            nn.LeakyReLU(LEAK),
            last,
        )
        layers: list[nn.Module] = []
        for _ in range(depth):
            layers += [nn.Linear(width, width), nn.LeakyReLU(LEAK, inplace=True)]
        matte = nn.Linear(width, channels + frame_stack)
        self.paint = nn.Sequential(*layers, matte)
        with torch.no_grad():
            last.bias[: 2 * width].normal_(0, 1.5)
            matte.bias[channels:] = math.log(opacity / (1 - opacity))
        self.register_buffer("coordinates", pixel_coordinates(*self.image_shape[:2]), persistent=False)

    def forward(self, features: Tensor, latent: Tensor, *, size: Sequence[int] | None = None) -> Tensor:
        """Returns mattes ``[N, C + S, h, w]``, in channels_last, for features ``[N, K]`` and latents ``[N, Z]``."""
        height, width = size = tuple(size or self.image_shape[:2])
        whole = size == self.image_shape[:2]
        coordinates = self.coordinates if whole else pixel_coordinates(height, width, features.device)
        return self.matte_at(coordinates, features, latent).unflatten(1, size).permute(0, 3, 1, 2)

    def matte_at(self, coordinates: Tensor, features: Tensor, latent: Tensor) -> Tensor:
        """Returns mattes at some coordinates only, ``[N, M, C + S]``.

        Args:
            coordinates: rows of the attribute ``coordinates``, ``[M, 3]``.
            features: ``[N, K]``.
            latent: ``[N, Z]``.
        """
        planes = self.gain * self.place(torch.cat([features, latent], -1)).unflatten(-1, (3, -1))
        hidden = nn.functional.leaky_relu_(coordinates @ planes, LEAK)
        colour, opacity = self.paint(hidden).split(self._parts, -1)
        return torch.cat([colour.tanh(), opacity.sigmoid()], -1)

    def sample_latent(self, count: int, rng: torch.Generator) -> Tensor:
        """Draws latents ``[count, Z]`` from N(0, 1)."""
        return torch.randn(count, self.latent_size, generator=rng)

    def extent(self, change: Tensor) -> Tensor:
        """Returns the fraction of each image that a matte covers, ``[N]``."""
        return change[:, self._parts[0] :].mean((1, 2, 3))

    def compose(self, images: Tensor, change: Tensor) -> Tensor:
        """Returns images ``[N, C, H, W]`` under mattes; exactly the images where the opacity is 0."""
        colour, opacity = change.split(self._parts, 1)
        if self.frame_stack > 1:
            opacity = opacity.repeat_interleave(self.colours, 1)  # each frame's opacity on all of its colours
        return images + opacity * (colour - images)


def pixel_coordinates(height: int, width: int, device: torch.device | None = None) -> Tensor:
    """Returns u to the right and v downwards, in (-1, 1), and 1 of each pixel's centre, ``[height * width, 3]``."""
    v, u = torch.meshgrid(_centres(height), _centres(width), indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)], -1).reshape(-1, 3).to(device)


def _centres(count: int) -> Tensor:
    return (torch.arange(count) + 0.5) / (count / 2) - 1
