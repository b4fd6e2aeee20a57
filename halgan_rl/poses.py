"""Planar poses: where a goal lies as seen from the robot, and whether it is reached."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


def relative_pose(pose: Tensor, goal_pose: Tensor) -> Tensor:
    """Expresses a goal pose in the frame of a pose (the paper's "configuration", Sahni et al. 2019, section 4).

    Args:
        pose: ``[..., P]``, its first three entries x [m], y [m], yaw [rad] in the world frame.
        goal_pose: ``[..., P]`` likewise; broadcasts against ``pose``. Entries after the third (task flags) are ignored.

    Returns:
        ``[..., 3]``: metres ahead, metres to the left, and the yaw difference in radians, wrapped to (-pi, pi].

    Raises:
        ValueError: If either pose has fewer than three entries.

    Examples:
        >>> facing_north = torch.tensor([1.0, 0.0, math.pi / 2])
        >>> relative_pose(facing_north, torch.tensor([1.0, 2.0, math.pi / 2])).round(decimals=3).tolist()
        [2.0, -0.0, 0.0]
    """
    check_pose_size(pose, "pose")
    check_pose_size(goal_pose, "goal_pose")
    difference = goal_pose[..., :3] - pose[..., :3]
    x, y, yaw = difference.unbind(-1)
    cos, sin = pose[..., 2].cos(), pose[..., 2].sin()
    return torch.stack([cos * x + sin * y, cos * y - sin * x, wrap_angle(yaw)], dim=-1)


def wrap_angle(angle: Tensor) -> Tensor:
    """Wraps angles in radians to (-pi, pi]."""
    return math.pi - torch.remainder(math.pi - angle, 2 * math.pi)


def flag_number(pose: Tensor) -> Tensor:
    """Numbers the setting of the task flags of poses ``[..., P]``, int64 ``[...]``: the first flag is the lowest bit.

    Examples:
        >>> flag_number(torch.tensor([[0.5, 0.5, 0.0, 1.0], [0.5, 0.5, 0.0, 0.0]])).tolist()
        [1, 0]
    """
    return ((pose[..., 3:] > 0.5) * 2 ** torch.arange(pose.shape[-1] - 3, device=pose.device)).sum(-1)


def check_pose_size(pose: Tensor, name: str) -> None:
    """Raises a ``ValueError`` that names ``name`` unless ``pose`` is ``[..., P]`` with P >= 3."""
    if pose.ndim < 1 or pose.shape[-1] < 3:
        raise ValueError(
            f"{name} has shape {tuple(pose.shape)}; its last dimension must hold at least x [m], y [m] and yaw [rad]."
        )


@dataclass(frozen=True)
class PoseTolerance:
    """Says whether a pose *is* the goal pose: nearer than a distance and turned by less than an angle.

    The defaults are the paper's thresholds for a goal reached in hindsight. Task flags are not compared.

    Attributes:
        distance: Largest distance, exclusive, in metres.
        angle: Largest yaw difference, exclusive, in radians.
    """

    distance: float = 0.01
    angle: float = 0.1

    def __post_init__(self) -> None:
        """Refuses tolerances that nothing can meet."""
        for name in ("distance", "angle"):
            value = getattr(self, name)
            if not value > 0:
                raise ValueError(f"{name} must be positive, got {value}.")

    def __call__(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Compares poses.

        Args:
            pose: ``[..., P]``, x [m], y [m], yaw [rad], flags.
            goal_pose: ``[..., P]`` likewise; broadcasts against ``pose``.

        Returns:
            Bool ``[...]``: whether ``pose`` is within both tolerances of ``goal_pose``.
        """
        check_pose_size(pose, "pose")
        check_pose_size(goal_pose, "goal_pose")
        x, y, yaw = (goal_pose[..., :3] - pose[..., :3]).unbind(-1)
        return (torch.hypot(x, y) < self.distance) & (wrap_angle(yaw).abs() < self.angle)
