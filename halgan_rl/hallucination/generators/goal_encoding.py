"""How a relative pose is described to the networks: the paper's "configuration"."""

from typing import Literal

import torch
from torch import Tensor, nn

from halgan_rl.poses import PlanarPoses, relative_pose

Configuration = Literal["polar", "planar"]
MOST_FLAGS = 16
"""Flags select one of up to 2^n goals."""
_POSES = PlanarPoses()


class GoalEncoding(nn.Module):
    """Describes where the goal pose lies as seen from a pose: labels for people, features for networks.

    - ``"polar"``, the paper's (appendix): distance [m] and bearing [rad] to the goal position; where the positions
      coincide, the bearing is the difference of the yaws. The features are the labels.
    - ``"planar"``: the whole relative pose: x ahead [m], y left [m], yaw difference [rad]. The features have sine
      and cosine of the yaw: what the goal pose faces lies at a *linear* function of them in the frame of the pose.

    Flags of the task follow in both, see :class:`~halgan_rl.poses.PlanarPoses`.

    Args:
        kind: which description.
        pose_size: P, entries of a pose.

    Attributes:
        flags: how many entries of a pose are flags.
        size: K, entries of the features.

    Raises:
        ValueError: if the kind is unknown, or a pose has no planar part, or more flags than can be told apart.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, kind: Configuration = "planar", pose_size: int = 3) -> None:
        super().__init__()
        if kind not in ("polar", "planar"):
            raise ValueError(f"configuration={kind!r} is unknown: choose 'polar' or 'planar'.")
        if not isinstance(pose_size, int) or not _POSES.size <= pose_size <= _POSES.size + MOST_FLAGS:
            raise ValueError(
                f"pose_size={pose_size!r} must be {_POSES.size} for x, y and yaw, and 1 more for each of at most "
                f"{MOST_FLAGS} flags."
            )
        self.kind = kind
        self.flags = pose_size - _POSES.size
        self.lengths = 1 if kind == "polar" else 2
        self.size = self.lengths + (1 if kind == "polar" else 2) + self.flags
        self.register_buffer("mean", torch.zeros(self.size))
        self.register_buffer("scale", torch.ones(self.size))

    def labels(self, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Describes goal poses ``[..., P]`` as seen from poses ``[..., P]``, both in the world frame; broadcasts.

        Returns:
            ``[..., L]``: lengths, then one angle, then flags.
        """
        relative = relative_pose(pose, goal_pose)
        if self.kind == "polar":
            x, y, yaw = relative.unbind(-1)
            distance = torch.hypot(x, y)
            relative = torch.stack([distance, torch.where(distance < 1e-4, yaw, torch.atan2(y, x))], -1)
        return torch.cat([relative, _POSES.flag_part(pose).expand(*relative.shape[:-1], -1)], -1)

    def forward(self, labels: Tensor) -> Tensor:
        """Returns standardised features ``[..., K]`` of labels ``[..., L]``."""
        return (self._features(labels) - self.mean) / self.scale

    def standardise(self, labels: Tensor) -> None:
        """Sets mean and scale so that the features of these labels ``[N, L]`` have mean 0 and variance 1."""
        features = self._features(labels)
        self.mean.copy_(features.mean(0))
        self.scale.copy_(features.std(0).clamp_min(1e-3))

    def mirror(self, labels: Tensor) -> Tensor:
        """Returns the labels ``[..., L]`` of images that are mirrored left to right."""
        signs = torch.ones(labels.shape[-1], device=labels.device)
        signs[1 : self.lengths + 1] = -1
        return labels * signs

    def with_flags_of(self, labels: Tensor, others: Tensor) -> Tensor:
        """Returns labels ``[..., L]`` with the flags of other labels."""
        place = labels.shape[-1] - self.flags
        return torch.cat([labels[..., :place], others[..., place:]], -1)

    def noise(self, length: float, angle: float) -> Tensor:
        """Returns standard deviations ``[L]``: of lengths [m], of the angle [rad], and 0 for flags."""
        return torch.tensor([length] * self.lengths + [angle] + [0.0] * self.flags)

    def _features(self, labels: Tensor) -> Tensor:
        if self.kind == "polar":
            return labels
        yaw = labels[..., 2:3]
        return torch.cat([labels[..., :2], yaw.sin(), yaw.cos(), labels[..., 3:]], -1)
