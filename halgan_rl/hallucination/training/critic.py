"""A critic that sees the pose: whether an image is real, *and* shows the goal where the configuration says."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from halgan_rl.hallucination.generators.coordinates import pixel_coordinates

LEAK = 0.2
"""Slope of its leaky rectifiers."""
SHARPNESS = 5.0
"""Factor on the slopes of the half-planes from which maps are painted."""
CONVOLUTIONS = ("first", "second", "third")
"""Each halves the image."""


class PoseCritic(nn.Module):
    """Scores images under a configuration, at two resolutions of the image.

    Convolutions halve the image. The score is the sum of

    - realism, from what is left of the image in the end,
    - the inner product of that with an embedding of the configuration (Miyato and Koyama, "cGANs with Projection
      Discriminator", ICLR 2018), and
    - the inner product of the first convolutions' maps with maps that are painted from the configuration, see
      :class:`PaintedMaps`. They say *where* in the image the goal must be seen.

    A coarse image, half as high and as wide, passes the same layers. Whole images reach them averaged, with the maps
    of a convolution of their own beside: at first these have no weight, so that training goes on where it was.

    Args:
        feature_size: K, entries of the configuration's features.

    Keyword Args:
        image_shape: height H, width W and channels C of whole images.
        width: maps of the first convolution; each next one has twice as many.
        fine_width: maps of the convolution that only whole images pass.
        painted_maps: whether to compare maps with painted ones, or the summary with the embedding alone.

    Raises:
        ValueError: if the images are smaller than 16x16.
    """

    def __init__(
        self,
        feature_size: int,
        *,
        image_shape: Sequence[int] = (64, 64, 3),
        width: int = 32,
        fine_width: int = 16,
        painted_maps: bool = True,
    ) -> None:
        *size, channels = image_shape
        smallest = 2 ** (len(CONVOLUTIONS) + 1)
        if min(size) < smallest:
            raise ValueError(
                f"image_shape={tuple(image_shape)} is too small for the critic, which halves images four times: height "
                f"and width must be at least {smallest} pixels."
            )
        super().__init__()
        widths = [width * 2**number for number in range(len(CONVOLUTIONS))]
        self.fine = nn.Conv2d(channels, fine_width, 4, stride=2, padding=1)
        self.from_fine = nn.Conv2d(fine_width, widths[0], 4, stride=2, padding=1, bias=False)
        nn.init.zeros_(self.from_fine.weight)
        self.convolutions = nn.ModuleDict(
            {
                name: nn.Conv2d(inputs, outputs, 4, stride=2, padding=1)
                for name, (inputs, outputs) in zip(CONVOLUTIONS, pairwise([channels, *widths]), strict=True)
            }
        )
        compared = {"fine": fine_width, "first": widths[0], "second": widths[1]} if painted_maps else {}
        self.maps = nn.ModuleDict(
            {name: PaintedMaps(feature_size, width, silent=name == "fine") for name, width in compared.items()}
        )
        rows, columns = (length // smallest for length in size)
        self.summary = nn.Linear(widths[-1] * rows * columns, 128)
        self.realism = nn.Linear(128, 1)
        self.embedding = nn.Sequential(nn.Linear(feature_size, 64), nn.LeakyReLU(LEAK), nn.Linear(64, 128))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def look(self, images: Tensor, *, coarse: bool) -> dict[str, Tensor]:
        """Returns what the score is made of: maps of the image by their names, and its ``summary``.

        Args:
            images: float ``[N, C, H, W]`` in [-1, 1], of half the height and width if ``coarse``.

        Keyword Args:
            coarse: whether the images are coarse.
        """
        seen: dict[str, Tensor] = {}
        hidden = images if coarse else functional.avg_pool2d(images, 2)
        if not coarse:
            seen["fine"] = functional.leaky_relu(self.fine(images), LEAK)  # [N, F, H/2, W/2]
        for name, convolution in self.convolutions.items():
            hidden = convolution(hidden)
            if name == "first" and not coarse:
                hidden = hidden + self.from_fine(seen["fine"])
            seen[name] = hidden = functional.leaky_relu(hidden, LEAK)
        return seen | {"summary": functional.leaky_relu(self.summary(hidden.flatten(1)), LEAK)}

    def score(self, seen: Mapping[str, Tensor], features: Tensor) -> Tensor:
        """Scores what was seen of images under configurations: ``[N]``.

        Args:
            seen: of N images, see :meth:`look`.
            features: of N configurations, ``[N, K]``.
        """
        summary = seen["summary"]
        score = self.realism(summary).squeeze(-1)
        score = score + (summary * self.embedding(features)).sum(-1) / summary.shape[-1] ** 0.5
        for name, painted in self.maps.items():
            if name not in seen:  # coarse images have no fine maps
                continue
            found = seen[name]
            wanted = painted(features, *found.shape[2:])
            score = score + (found * wanted).sum((1, 2, 3)) / found[0].numel() ** 0.5
        return score


class PaintedMaps(nn.Module):
    """Maps ``[N, width, h, w]`` painted by coordinates from a configuration, as our generator paints mattes.

    Args:
        feature_size: K.
        width: how many maps.
        hidden: half-planes, and channels of the pixel-wise layer.
        silent: whether the maps are 0 until training changes them.
    """

    def __init__(self, feature_size: int, width: int, *, hidden: int = 32, silent: bool = False) -> None:
        super().__init__()
        self.hidden = hidden
        last = nn.Linear(64, 3 * hidden)
        self.place = nn.Sequential(
            nn.Linear(feature_size, 64),
            nn.LeakyReLU(LEAK),
            nn.Linear(64, 64),
            nn.LeakyReLU(LEAK),
            last,
        )
        maps = nn.Linear(hidden, width)
        self.paint = nn.Sequential(nn.Linear(hidden, hidden), nn.LeakyReLU(LEAK), maps)
        with torch.no_grad():
            last.bias[: 2 * hidden].normal_(0, 1.5)  # half-planes of all directions
            if silent:
                maps.weight.zero_()
                maps.bias.zero_()

    def forward(self, features: Tensor, height: int, width: int) -> Tensor:
        """Returns the maps for features ``[N, K]`` at a resolution."""
        planes = SHARPNESS * self.place(features).unflatten(-1, (3, self.hidden))  # [N, 3, hidden]
        hidden = functional.leaky_relu(pixel_coordinates(height, width, planes.device) @ planes, LEAK)
        return self.paint(hidden).transpose(1, 2).unflatten(2, (height, width))
