"""Where a goal is seen to be, by a network that knows real frames only: the judge of hallucinated ones."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from halgan_rl.transforms.pixels import to_float


class PoseProbe(nn.Module):
    """Reads bearing and distance of the goal off an image.

    Four 5x5 convolutions, each of which halves the image, and two linear layers.

    Args:
        image_shape: height H, width W and channels C.
        width: size of the hidden layer.
    """

    def __init__(self, image_shape: Sequence[int] = (64, 64, 3), *, width: int = 64) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise([image_shape[2], 4, 8, 16, 32]):
            layers += [nn.Conv2d(inputs, outputs, 5, stride=2, padding=2), nn.LeakyReLU(0.3)]
        self.convolutions = nn.Sequential(*layers, nn.Flatten())
        self.head = nn.Sequential(nn.LazyLinear(width), nn.LeakyReLU(0.1), nn.Linear(width, 2))
        self(torch.zeros(1, *image_shape, dtype=torch.uint8))  # settles the lazy layer

    def forward(self, pixels: Tensor) -> Tensor:
        """Returns bearing [rad, positive is left] and distance [m], ``[N, 2]``, for images uint8 ``[N, H, W, C]``."""
        bearing, log_distance = self.head(self.convolutions(to_float(pixels))).unbind(-1)
        return torch.stack([bearing, log_distance.exp()], -1)

    @torch.no_grad()
    def read(self, pixels: Tensor, *, chunk: int = 64) -> Tensor:
        """Returns what :meth:`forward` does, a few images at a time and without gradients."""
        return torch.cat([self(part) for part in pixels.split(chunk)])


def train_probe(
    pixels: Tensor,
    polar: Tensor,
    *,
    rng: torch.Generator,
    steps: int = 3_000,
    batch_size: int = 64,
    learning_rate: float = 2e-3,
) -> PoseProbe:
    """Fits a probe to real frames; half of them are mirrored left to right.

    Args:
        pixels: uint8 ``[N, H, W, C]``, the goal in view.
        polar: bearing [rad] and distance [m], ``[N, 2]``, see :meth:`halgan_rl.poses.PlanarPoses.goal_polar`.

    Keyword Args:
        rng: draws the batches; the first weights come from PyTorch's global generator.
        steps: how many.
        batch_size: frames of a step.
        learning_rate: at first; it falls to a hundredth along a cosine.

    Raises:
        ValueError: if there are no images, or not one bearing and distance for each.
    """
    if pixels.dtype != torch.uint8 or pixels.ndim != 4 or not len(pixels) or polar.shape != (len(pixels), 2):
        raise ValueError(
            f"pixels are {pixels.dtype} {list(pixels.shape)} and polar {list(polar.shape)}; they must be torch.uint8 "
            "[N, H, W, C] and [N, 2], N at least 1: collect frames with the goal in view."
        )
    probe = PoseProbe(pixels.shape[1:])
    optimizer = torch.optim.Adam(probe.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, 0.01 * learning_rate)
    targets = torch.stack([polar[:, 0], polar[:, 1].log()], -1)
    scale = targets.std(0)
    for _ in range(steps):
        rows = torch.randint(len(pixels), (batch_size,), generator=rng)
        flip = torch.rand(batch_size, generator=rng) < 0.5
        frames = torch.where(flip[:, None, None, None], pixels[rows].flip(2), pixels[rows])
        wanted = torch.stack([torch.where(flip, -targets[rows, 0], targets[rows, 0]), targets[rows, 1]], -1)
        bearing, distance = probe(frames).unbind(-1)
        error = (torch.stack([bearing, distance.log()], -1) - wanted) / scale
        optimizer.zero_grad()
        error.abs().mean().backward()
        optimizer.step()
        schedule.step()
    return probe.eval()


def probe_errors(probe: PoseProbe, polar: Tensor, images: Mapping[str, Tensor]) -> dict[str, Any]:
    """Compares where a probe sees the goal in several versions of the same frames.

    Args:
        probe: the judge.
        polar: the true bearing [rad] and distance [m], ``[N, 2]``.
        images: uint8 ``[N, H, W, C]`` by label, ``"real"`` and ``"hallucinated"`` among them.

    Returns:
        For each label ``bearing_degrees`` and ``distance_metres``, the mean absolute errors; ``ratio``, those of
        ``"hallucinated"`` to those of ``"real"``, as ``bearing`` and ``distance``; ``frames``, N.
    """
    errors = {label: (probe.read(frames) - polar).abs().mean(0) for label, frames in images.items()}
    table: dict[str, Any] = {
        label: {"bearing_degrees": float(error[0].rad2deg()), "distance_metres": float(error[1])}
        for label, error in errors.items()
    }
    bearing, distance = (errors["hallucinated"] / errors["real"]).tolist()
    return table | {"ratio": {"bearing": bearing, "distance": distance}, "frames": len(polar)}
