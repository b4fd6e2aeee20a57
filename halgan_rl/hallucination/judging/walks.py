"""Poses, and goals that the robot came by later on the same walk: what hindsight paints."""

import torch
from torch import Tensor


def draw_goals(
    pose: Tensor, count: int, *, max_step: float, rng: torch.Generator, most_steps: int = 96
) -> tuple[Tensor, Tensor]:
    """Draws poses of random walks and, for each, a later pose of the same walk; near ones more often.

    Args:
        pose: consecutive poses of several walks, ``[N, P]``.
        count: how many to draw at most; fewer if walks are short.

    Keyword Args:
        max_step: farthest that a robot gets in one step [m]; a longer one lies between two walks.
        rng: draws.
        most_steps: farthest goal.

    Returns:
        Poses and goal poses, both ``[count, P]``.
    """
    jumps = (pose[1:, :2] - pose[:-1, :2]).norm(dim=-1) > max_step
    walk = torch.cat([torch.zeros(1), jumps.cumsum(0)])
    start = torch.randint(len(pose), (40 * count,), generator=rng)
    steps = 1 + (torch.rand(len(start), generator=rng).square() * most_steps).long()
    ahead = (start + steps).clamp(max=len(pose) - 1)
    good = (walk[start] == walk[ahead]) & (ahead > start)
    return pose[start[good]][:count], pose[ahead[good]][:count]
