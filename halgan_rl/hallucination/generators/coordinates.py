"""A generator that paints by coordinates: cheap, and exact under shifts of the goal across the image."""

import math

import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.goal_encoding import Configuration
from halgan_rl.hallucination.generators.paper import LEAK, HallucinationGenerator

SIZE = 64


class CoordinateGenerator(HallucinationGenerator):
    """Decides for each pixel, from its coordinates alone, whether the goal covers it and in which colour.

    A small network turns relative pose and latent into a set of half-planes of the image, the first layer of a
    pixel-wise network: affine maps of (u, v), which place, scale and turn whatever the shared layers behind them
    draw. Moving the goal is then a change of a few numbers and not, as in a stack of convolutions, a picture to be
    learned for each place; bearing comes out right from the start, and an image costs less than half of the paper's.

    The output is a matte, ``[N, 4, 64, 64]``: three channels of colour in [-1, 1] and an opacity in [0, 1].

    Args:
        configuration: how the network is told the relative pose.
        pose_size: P, entries of a pose.
        latent_size: Z; the latent is drawn from N(0, 1). What it has to tell is little: which way the goal is turned.
        width: channels of each pixel-wise layer.
        depth: pixel-wise layers behind the first.
        opacity: mean opacity before training; small, so that training starts near the identity.
        gain: factor on the half-planes' slopes; large, so that edges become sharp soon.

    Attributes:
        coordinates: u, v in (-1, 1) and 1 of each pixel, row by row, ``[4096, 3]``.
    """

    coordinates: Tensor

    def __init__(
        self,
        configuration: Configuration = "planar",
        pose_size: int = 3,
        latent_size: int = 2,
        *,
        width: int = 32,
        depth: int = 2,
        opacity: float = 0.05,
        gain: float = 10.0,
    ) -> None:
        super().__init__(configuration, pose_size, latent_size)
        self.arguments |= {"width": width, "depth": depth, "opacity": opacity, "gain": gain}
        self.gain = gain
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
        matte = nn.Linear(width, 4)
        self.paint = nn.Sequential(*layers, matte)
        with torch.no_grad():
            last.bias[: 2 * width].normal_(0, 1.5)
            matte.bias[3] = math.log(opacity / (1 - opacity))
        axis = (torch.arange(SIZE) + 0.5) / (SIZE / 2) - 1
        v, u = torch.meshgrid(axis, axis, indexing="ij")
        coordinates = torch.stack([u, v, torch.ones_like(u)], -1).reshape(-1, 3)
        self.register_buffer("coordinates", coordinates, persistent=False)

    def forward(self, features: Tensor, latent: Tensor) -> Tensor:
        """Return the matte ``[N, 4, 64, 64]``, in channels_last."""
        return self.matte_at(self.coordinates, features, latent).unflatten(1, (SIZE, SIZE)).permute(0, 3, 1, 2)

    def matte_at(self, coordinates: Tensor, features: Tensor, latent: Tensor) -> Tensor:
        """Return the matte at some coordinates only, ``[N, M, 4]``.

        Args:
            coordinates: rows of the attribute ``coordinates``, ``[M, 3]``.
            features: ``[N, K]``.
            latent: ``[N, Z]``.
        """
        planes = self.gain * self.place(torch.cat([features, latent], -1)).unflatten(-1, (3, -1))
        hidden = nn.functional.leaky_relu_(coordinates @ planes, LEAK)
        colour, opacity = self.paint(hidden).split([3, 1], -1)
        return torch.cat([colour.tanh(), opacity.sigmoid()], -1)

    def sample_latent(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw latents ``[count, Z]`` from N(0, 1)."""
        return torch.randn(count, self.latent_size, generator=rng)

    def compose(self, images: Tensor, change: Tensor) -> Tensor:
        """Lay the matte over images; exactly the identity where the opacity is 0."""
        colour, opacity = change.split([3, 1], 1)
        return images + opacity * (colour - images)
