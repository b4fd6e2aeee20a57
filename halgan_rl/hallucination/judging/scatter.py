"""Whether a goal stays in its place while the robot moves."""

from collections.abc import Iterable

import torch
from torch import Tensor

from halgan_rl.hallucination.judging.pose_probe import PoseProbe
from halgan_rl.hallucination.training.data import Frames


def cut_stretches(data: Frames, fits: Tensor, *, length: int = 12) -> list[Frames]:
    """Cuts rollouts into stretches of consecutive frames.

    Args:
        data: consecutive frames, rows of equal ``goal_pose`` being of one rollout.
        fits: which frames may be used, bool ``[N]``.

    Keyword Args:
        length: frames of a stretch.
    """
    found = []
    for first in range(0, len(fits) - length + 1, length):
        rows = slice(first, first + length)
        if fits[rows].all() and (data["goal_pose"][rows] == data["goal_pose"][first]).all():
            found.append({name: entry[rows] for name, entry in data.items()})
    return found


def scatter(probe: PoseProbe, stretches: Iterable[tuple[Tensor, Tensor]]) -> float:
    """Returns how far the goal seems to wander in the room while the robot moves [m], the root mean square.

    Args:
        probe: reads off images where the goal is.
        stretches: poses ``[N, P]`` and images uint8 ``[N, H, W, C]`` of each stretch, with one and the same goal.

    Returns:
        NaN if there are no stretches.
    """
    squares = []
    for pose, pixels in stretches:
        seen = positions(pose, probe.read(pixels))
        squares.append((seen - seen.mean(0)).square().sum(-1).mean())
    return float(torch.tensor(squares).mean().sqrt())


def positions(pose: Tensor, polar: Tensor) -> Tensor:
    """Returns where in the room things are, ``[N, 2]`` [m], that are seen at bearing and distance ``[N, 2]``."""
    bearing, distance = polar.unbind(-1)
    heading = pose[:, 2] + bearing
    return pose[:, :2] + distance[:, None] * torch.stack([heading.cos(), heading.sin()], -1)
