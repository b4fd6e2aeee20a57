"""Poses, and goals that the robot came by later on the same walk: what hindsight paints."""

import torch
from torch import Tensor


def draw_goals(
    pose: Tensor, episode: Tensor, count: int, *, rng: torch.Generator, most_steps: int = 96
) -> tuple[Tensor, Tensor]:
    """Draws poses of random walks and, for each, a later pose of the same walk; near ones more often.

    Args:
        pose: consecutive poses of several walks, ``[N, P]``.
        episode: the number of each pose's walk, int64 ``[N]``.
        count: how many to draw at most; fewer if walks are short.

    Keyword Args:
        rng: draws.
        most_steps: farthest goal.

    Returns:
        Poses and goal poses, both ``[count, P]``.
    """
    start = torch.randint(len(pose), (40 * count,), generator=rng)
    steps = 1 + (torch.rand(len(start), generator=rng).square() * most_steps).long()
    ahead = (start + steps).clamp(max=len(pose) - 1)
    good = (episode[start] == episode[ahead]) & (ahead > start)
    return pose[start[good]][:count], pose[ahead[good]][:count]
