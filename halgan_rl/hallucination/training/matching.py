"""Failed frames that match near-goal frames: seen from about the same place, so that only the goal tells them apart.

Failed walks end at walls, and the ways to a goal do not. A critic that gets any failed frame as background of a fake
knows it by the wall in front of it, whatever is painted into it.
"""

import torch
from torch import Tensor

from halgan_rl.hallucination.training.data import Frames, matching_settings
from halgan_rl.poses import PlanarPoses

TURN = 0.3
"""How much a turn counts beside a distance [m a radian]."""
CHUNK = 512
"""Near-goal frames that are compared with all failed ones at a time."""


def nearest_backgrounds(near_goal: Frames, failed: Frames, poses: PlanarPoses, *, count: int) -> Tensor:
    """Returns the rows of the failed frames that are seen from nearest to each near-goal frame, with the same flags.

    Args:
        near_goal: ``pose`` ``[N, P]``.
        failed: ``pose`` ``[M, P]``.
        poses: which entries of a pose are flags.

    Keyword Args:
        count: K; where there are fewer failed frames with the flags, some of them repeat.

    Returns:
        int64 ``[N, K]``.

    Raises:
        ValueError: if there is a near-goal frame with flags that no failed frame has.
    """
    near_settings, failed_settings = matching_settings(near_goal, failed, poses)
    near, other = _place(near_goal["pose"]), _place(failed["pose"])
    rows = torch.empty(len(near), count, dtype=torch.int64)
    for setting in near_settings.unique():
        candidates = (failed_settings == setting).nonzero().squeeze(-1)
        for part in (near_settings == setting).nonzero().squeeze(-1).split(CHUNK):
            distances = torch.cdist(near[part], other[candidates])
            nearest = distances.topk(min(count, len(candidates)), largest=False).indices
            rows[part] = candidates[nearest[:, torch.arange(count) % nearest.shape[1]]]
    return rows


def _place(pose: Tensor) -> Tensor:
    """Returns where poses ``[N, P]`` are and look, ``[N, 4]`` [m], as points whose distances can be compared."""
    yaw = pose[:, 2]
    return torch.cat([pose[:, :2], TURN * torch.stack([yaw.cos(), yaw.sin()], -1)], -1)
