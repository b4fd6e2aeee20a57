"""Where a goal is seen to be, by a network that knows real frames only: the judge of hallucinated ones."""

import torch
from torch import Tensor, nn

from halgan_rl.agents.encoder import Encoder
from halgan_rl.poses import relative_pose


class PoseProbe(nn.Module):
    """Tells bearing and distance of the goal from an image.

    Args:
        width: size of the hidden layer.
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.head = nn.Sequential(nn.LazyLinear(width), nn.LeakyReLU(0.1), nn.Linear(width, 2))
        self(torch.zeros(1, 64, 64, 3, dtype=torch.uint8))  # settles the lazy layer

    def forward(self, pixels: Tensor) -> Tensor:
        """Return bearing [rad, positive is left] and distance [m], ``[N, 2]``, for uint8 ``[N, 64, 64, 3]``."""
        bearing, log_distance = self.head(self.encoder(pixels)).unbind(-1)
        return torch.stack([bearing, log_distance.exp()], -1)


def polar_goal(pose: Tensor, goal_pose: Tensor, *, goal_offset: float | Tensor) -> Tensor:
    """Return bearing [rad] and distance [m] of goals as seen from poses, ``[..., 2]``.

    Args:
        pose: ``[..., P]``.
        goal_pose: ``[..., P]``, from where the goal is reached.
        goal_offset: the goals stand this far ahead of their goal poses [m], broadcasts against ``[...]``.
    """
    x, y, yaw = relative_pose(pose, goal_pose).unbind(-1)
    x, y = x + goal_offset * yaw.cos(), y + goal_offset * yaw.sin()
    return torch.stack([torch.atan2(y, x), torch.hypot(x, y)], -1)


def train_probe(
    pixels: Tensor,
    polar: Tensor,
    *,
    rng: torch.Generator,
    steps: int = 3_000,
    batch_size: int = 64,
    learning_rate: float = 2e-3,
) -> PoseProbe:
    """Fit a probe to real frames; half of them are mirrored left to right.

    Args:
        pixels: uint8 ``[N, 64, 64, 3]``, the goal in view.
        polar: bearing [rad] and distance [m], ``[N, 2]``.
        rng: draws the batches; the first weights come from PyTorch's global generator.
        steps: how many.
        batch_size: frames of a step.
        learning_rate: at first; it falls to a hundredth along a cosine.
    """
    probe = PoseProbe()
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
