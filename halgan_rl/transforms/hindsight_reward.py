"""The last step of the sample path: the reward of having reached the goal."""

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key

from halgan_rl.poses import PoseTolerance
from halgan_rl.transforms.base import ReplayTransform, next_key


class HindsightReward(ReplayTransform):
    """Rewards and ends relabelled rows whose next pose is their goal.

    **Core rule.** Where ``(goal, "mask")`` is True and the pose at t+1 (never the one at t) is within tolerance of
    ``(goal, "pose")``, the reward grows by ``success_reward``, ``terminated`` and ``done`` become True and
    ``truncated`` False, all together. Every other row stays as it is, bit for bit: one relabelled but not there yet
    keeps its reward.

    A ``SliceSampler`` writes its own flags over these after the transforms ran: give it ``truncated_key=None``.

    Keyword Args:
        success_reward: Added to the row's own reward, which may hold an energy cost.
        tolerance: When a pose is the goal pose.
        pose_key: Pose ``[P]``, read under ``"next"``.
        goal_key: Where :class:`~halgan_rl.transforms.DrawHindsightGoal` wrote ``"mask"`` and ``"pose"``.
        reward_key: Reward ``[1]``, under ``"next"``.
        done_key: End-of-episode flag ``[1]``, under ``"next"``.
        terminated_key: Termination flag ``[1]``, under ``"next"``.
        truncated_key: Time-limit flag ``[1]``, under ``"next"``.

    Raises:
        KeyError: On sampling, if a row lacks a key; names the key and the argument that set it.

    Examples:
        >>> from tensordict import TensorDict
        >>> flags = {name: torch.zeros(2, 1, dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        >>> following = {"pose": torch.tensor([[1.0, 0, 0], [2.0, 0, 0]]), "reward": torch.zeros(2, 1), **flags}
        >>> goal = {"mask": torch.ones(2, 1, dtype=torch.bool), "pose": torch.tensor([[2.0, 0, 0], [2.0, 0, 0]])}
        >>> rows = HindsightReward()(TensorDict({"next": following, "goal": goal}, batch_size=[2]))
        >>> rows["next", "reward"].tolist(), rows["next", "terminated"].tolist()
        ([[0.0], [1.0]], [[False], [True]])
    """

    def __init__(
        self,
        *,
        success_reward: float = 1.0,
        tolerance: PoseTolerance = PoseTolerance(),  # noqa: B008 (frozen)
        pose_key: NestedKey = "pose",
        goal_key: NestedKey = "goal",
        reward_key: NestedKey = "reward",
        done_key: NestedKey = "done",
        terminated_key: NestedKey = "terminated",
        truncated_key: NestedKey = "truncated",
    ) -> None:
        super().__init__()
        self.success_reward = success_reward
        self.tolerance = tolerance
        self.pose_key = pose_key
        self.goal_key = goal_key
        self.reward_key = reward_key
        self.done_key = done_key
        self.terminated_key = terminated_key
        self.truncated_key = truncated_key

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rewrites reward and flags of sampled rows ``[...]``."""
        mask = self._read(tensordict, unravel_key((self.goal_key, "mask")), "goal_key")
        goal_pose = self._read(tensordict, unravel_key((self.goal_key, "pose")), "goal_key")
        next_pose = self._read(tensordict, next_key(self.pose_key), "pose_key")
        reward = self._read(tensordict, next_key(self.reward_key), "reward_key")
        done = self._read(tensordict, next_key(self.done_key), "done_key")
        terminated = self._read(tensordict, next_key(self.terminated_key), "terminated_key")
        truncated = self._read(tensordict, next_key(self.truncated_key), "truncated_key")

        reached = (mask & self.tolerance(next_pose, goal_pose).unsqueeze(-1)).reshape(reward.shape)
        tensordict.set(next_key(self.reward_key), torch.where(reached, reward + self.success_reward, reward))
        tensordict.set(next_key(self.done_key), done | reached)
        tensordict.set(next_key(self.terminated_key), terminated | reached)
        tensordict.set(next_key(self.truncated_key), truncated & ~reached)
        return tensordict
