"""What is done with a pose: its planar part, its flags, where a goal stands, when two poses are the same goal."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Poses(Protocol):
    """All that replay transforms do with poses. :class:`PlanarPoses` is the library's; write your own for others.

    Poses are float ``[..., P]``; what is in their entries is known here only.
    """

    def check(self, pose: Tensor, name: str) -> None:
        """Raises a ``ValueError`` that names ``name`` unless ``pose`` ``[..., P]`` holds poses."""

    def stage_changed(self, pose: Tensor, next_pose: Tensor) -> Tensor:
        """Returns bool ``[...]``: whether another goal is pursued at ``next_pose`` than at ``pose``."""

    def travelled(self, pose: Tensor, next_pose: Tensor) -> Tensor:
        """Returns ``[...]``: the distance [m] from ``pose`` to ``next_pose``; read only where a ``max_step`` is set."""

    def reached(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Returns bool ``[...]``: whether ``pose`` *is* the goal pose, within a tolerance. The two broadcast."""


@dataclass(frozen=True)
class PlanarPoses:
    """Poses in the plane: x [m], y [m], yaw [rad] in the world frame, then the task's flags, each 0 or 1.

    The flags of a pose select the goal that is pursued there: a task with n flags has up to 2^n goals, numbered by
    :meth:`setting`.

    Attributes:
        flags: names of the entries after yaw.
        distance: a pose is the goal pose if it is nearer than this [m] ...
        angle: ... and turned by less than this [rad]. The defaults are the paper's (Sahni et al. 2019, authors' code).
        goal_offsets: how far ahead of a goal pose its goal stands [m]: for each setting of the flags, or one for all.

    Raises:
        ValueError: if a tolerance is not positive, an offset negative, or there are offsets for other settings.

    Examples:
        >>> poses = PlanarPoses(flags=("held",), goal_offsets=(0.25, 0.5))
        >>> here, there = torch.tensor([0.0, 0.0, 0.0, 1.0]), torch.tensor([1.0, 1.0, math.pi / 2, 0.0])
        >>> poses.goal_position(here, there).round(decimals=3).tolist()  # 0.5 m ahead, for the robot holds the box
        [1.0, 1.5]
    """

    flags: tuple[str, ...] = ()
    distance: float = 0.01
    angle: float = 0.1
    goal_offsets: tuple[float, ...] = (0.0,)

    def __post_init__(self) -> None:
        """Refuses values that make no sense."""
        for name in ("distance", "angle"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")
        if min(self.goal_offsets, default=-1.0) < 0:
            raise ValueError(f"goal_offsets={self.goal_offsets} m must not be negative: the goal stands ahead.")
        if len(self.goal_offsets) not in (1, self.settings):
            raise ValueError(
                f"goal_offsets={self.goal_offsets} has {len(self.goal_offsets)} entries, but the flags {self.flags} "
                f"have {self.settings} settings: give one for each, or one for all."
            )

    @property
    def size(self) -> int:
        """Entries of a pose, P."""
        return 3 + len(self.flags)

    @property
    def settings(self) -> int:
        """Settings of the flags."""
        return 2 ** len(self.flags)

    def check(self, pose: Tensor, name: str) -> None:
        """Raises a ``ValueError`` that names ``name`` unless all of ``pose`` ``[..., P]`` are such poses."""
        if not pose.ndim or pose.shape[-1] != self.size or not pose.is_floating_point():
            names = ", ".join(("x [m]", "y [m]", "yaw [rad]", *self.flags))
            raise ValueError(
                f"{name} is {pose.dtype} {tuple(pose.shape)}; its last dimension must hold {self.size} floats: "
                f"{names}. Name flags that follow in PlanarPoses(flags=(...)); for other poses give an object of your "
                "own (halgan_rl.poses.Poses)."
            )
        if not torch.isfinite(pose).all():
            bad = pose.reshape(-1, self.size)[~torch.isfinite(pose).all(-1).flatten()][0]
            raise ValueError(f"{name} is not finite: {short(bad)}. Mend the pose observation.")
        if not self.flags:
            return
        flags = self.flag_part(pose)
        wrong = ((flags != 0) & (flags != 1)).any(-1)
        if wrong.any():
            bad = pose.reshape(-1, self.size)[wrong.flatten()][0]
            raise ValueError(
                f"{name} holds {short(bad)}, but its flags ({', '.join(self.flags)}) must be 0 or 1: pass numbers that "
                "are no flags under another key, or give a poses object of your own (halgan_rl.poses.Poses)."
            )

    def flag_part(self, pose: Tensor) -> Tensor:
        """Returns the flags ``[..., P - 3]`` of poses ``[..., P]``."""
        return pose[..., 3:]

    def setting(self, pose: Tensor) -> Tensor:
        """Numbers the setting of the flags of poses ``[..., P]``, int64 ``[...]``: the first flag is the lowest bit.

        Examples:
            >>> poses = PlanarPoses(flags=("held",))
            >>> poses.setting(torch.tensor([[0.5, 0.5, 0.0, 1.0], [0.5, 0.5, 0.0, 0.0]])).tolist()
            [1, 0]
        """
        return flag_number(pose)

    def flags_of(self, setting: Tensor) -> Tensor:
        """Returns the flags, float ``[..., P - 3]``, of numbered settings int64 ``[...]``: undoes :meth:`setting`."""
        bits = 2 ** torch.arange(len(self.flags), device=setting.device)
        return (setting.unsqueeze(-1) & bits).bool().float()

    def stage_changed(self, pose: Tensor, next_pose: Tensor) -> Tensor:
        """Returns bool ``[...]``: whether a flag differs, so that another goal is pursued."""
        return (self.flag_part(pose) != self.flag_part(next_pose)).any(-1)

    def travelled(self, pose: Tensor, next_pose: Tensor) -> Tensor:
        """Returns the distance in the plane from ``pose`` to ``next_pose`` ``[..., P]``: ``[...]`` [m]."""
        return (next_pose[..., :2] - pose[..., :2]).norm(dim=-1)

    def reached(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Returns bool ``[...]``: whether ``pose`` is within both tolerances of ``goal_pose``; flags do not count."""
        x, y, yaw = (goal_pose[..., :3] - pose[..., :3]).unbind(-1)
        return (torch.hypot(x, y) < self.distance) & (wrap_angle(yaw).abs() < self.angle)

    def goal_offset(self, pose: Tensor) -> Tensor:
        """Returns how far ahead of its goal pose the goal pursued at poses ``[..., P]`` stands, ``[...]`` [m]."""
        offsets = torch.tensor(self.goal_offsets, device=pose.device).expand(self.settings)
        return offsets[self.setting(pose)]

    def goal_position(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Returns where the goal stands that is pursued at ``pose`` and reached at ``goal_pose``, ``[..., 2]`` [m]."""
        return torch.stack(self._goal_xy(pose, goal_pose), -1)

    def goal_polar(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Returns bearing [rad, positive is left] and distance [m] of the goal as seen from ``pose``, ``[..., 2]``."""
        goal_x, goal_y = self._goal_xy(pose, goal_pose)
        x, y = goal_x - pose[..., 0], goal_y - pose[..., 1]
        return torch.stack([wrap_angle(torch.atan2(y, x) - pose[..., 2]), torch.hypot(x, y)], -1)

    def _goal_xy(self, pose: Tensor, goal_pose: Tensor) -> tuple[Tensor, Tensor]:
        offset = self.goal_offset(pose)
        x, y, yaw = goal_pose[..., :3].unbind(-1)
        return x + offset * yaw.cos(), y + offset * yaw.sin()


def relative_pose(pose: Tensor, goal_pose: Tensor) -> Tensor:
    """Expresses a goal pose in the frame of a pose (the paper's "configuration", Sahni et al. 2019, section 4).

    Args:
        pose: ``[..., P]``, its first three entries x [m], y [m], yaw [rad] in the world frame.
        goal_pose: ``[..., P]`` likewise; broadcasts against ``pose``. Entries after the third are ignored.

    Returns:
        ``[..., 3]``: metres ahead, metres to the left, and the yaw difference in radians, wrapped to (-pi, pi].

    Examples:
        >>> facing_north = torch.tensor([1.0, 0.0, math.pi / 2])
        >>> relative_pose(facing_north, torch.tensor([1.0, 2.0, math.pi / 2])).round(decimals=3).tolist()
        [2.0, -0.0, 0.0]
    """
    difference = goal_pose[..., :3] - pose[..., :3]
    x, y, yaw = difference.unbind(-1)
    cos, sin = pose[..., 2].cos(), pose[..., 2].sin()
    return torch.stack([cos * x + sin * y, cos * y - sin * x, wrap_angle(yaw)], dim=-1)


def wrap_angle(angle: Tensor) -> Tensor:
    """Wraps angles in radians to (-pi, pi]."""
    return math.pi - torch.remainder(math.pi - angle, 2 * math.pi)


def flag_number(pose: Tensor) -> Tensor:
    """Numbers the setting of the flags of planar poses ``[..., P]``, int64 ``[...]``: the first is the lowest bit."""
    return ((pose[..., 3:] > 0.5) * 2 ** torch.arange(pose.shape[-1] - 3, device=pose.device)).sum(-1)


def short(pose: Tensor) -> list[float]:
    """Writes a pose for people."""
    return [round(number, 4) for number in pose.tolist()]
