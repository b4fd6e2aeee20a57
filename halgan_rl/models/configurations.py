"""How a relative pose is told to the networks: the paper's "configuration"."""

from typing import Literal

import torch
from torch import Tensor

from halgan_rl.poses import relative_pose

Configuration = Literal["polar", "planar"]

LABEL_SIZE: dict[Configuration, int] = {"polar": 2, "planar": 3}
FEATURE_SIZE: dict[Configuration, int] = {"polar": 2, "planar": 4}


def goal_labels(kind: Configuration, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """Describe where the goal pose lies as seen from a pose.

    - ``"polar"``, the paper's (appendix): distance [m] and bearing [rad] to the goal position; where the positions
      coincide, the bearing is the difference of the yaws.
    - ``"planar"``: the whole relative pose: x ahead [m], y left [m], yaw difference [rad].

    Flags of the task, the entries of a pose after the third, follow unchanged.

    Args:
        kind: which description.
        pose: ``[..., P]`` world frame, P >= 3.
        goal_pose: ``[..., P]`` world frame, broadcast against ``pose``.

    Returns:
        ``[..., L + P - 3]``, L being ``LABEL_SIZE[kind]``.
    """
    relative = relative_pose(pose, goal_pose)
    if kind == "polar":
        x, y, yaw = relative.unbind(-1)
        distance = torch.hypot(x, y)
        relative = torch.stack([distance, torch.where(distance < 1e-4, yaw, torch.atan2(y, x))], -1)
    flags = pose[..., 3:].expand(*relative.shape[:-1], -1)
    return torch.cat([relative, flags], -1)


def label_features(kind: Configuration, labels: Tensor) -> Tensor:
    """Turn labels into the networks' inputs: a yaw becomes its sine and cosine.

    With them the object that the goal pose faces, a fixed distance ahead of it, lies at a *linear* function of the
    features in the frame of the pose.

    Args:
        kind: as in :func:`goal_labels`.
        labels: ``[..., L + flags]``.

    Returns:
        ``[..., FEATURE_SIZE[kind] + flags]``.
    """
    if kind == "polar":
        return labels
    yaw = labels[..., 2:3]
    return torch.cat([labels[..., :2], yaw.sin(), yaw.cos(), labels[..., 3:]], -1)


def mirrored(kind: Configuration, labels: Tensor) -> Tensor:
    """Return the labels of the left-right mirrored images: angles and the sideways offset change sign."""
    signs = torch.ones_like(labels)
    signs[..., 1 : LABEL_SIZE[kind]] = -1
    return labels * signs
