"""The last step of the sample path: the reward of having reached the goal."""

import torch
from tensordict import TensorDictBase

from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.transforms.base import ReplayTransform


class HindsightReward(ReplayTransform):
    """Rewards and ends relabelled rows whose next pose is their goal.

    **Core rule.** Where ``(goal, "mask")`` is True and the pose at t+1 (never the one at t) is within tolerance of
    ``(goal, "pose")``, the reward grows by ``success_reward``, ``terminated`` and ``done`` become True and
    ``truncated`` False, all together. Every other row stays as it is, bit for bit: one relabelled but not there yet
    keeps its reward.

    A ``SliceSampler`` writes its own flags over these after the transforms ran: give it ``truncated_key=None``.

    Keyword Args:
        success_reward: Added to the row's own reward, which may hold an energy cost.
        poses: When a pose is the goal pose.
        keys: Where rows keep what.

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
        poses: Poses = PlanarPoses(),  # noqa: B008 (frozen)
        keys: Keys = Keys(),  # noqa: B008 (frozen)
    ) -> None:
        super().__init__(keys)
        self.success_reward = success_reward
        self.poses = poses

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rewrites reward and flags of sampled rows ``[...]``."""
        keys = self.keys
        mask = self._read(tensordict, "goal", keys.goal_mask)
        goal_pose = self._read(tensordict, "goal", keys.goal_pose)
        next_pose = self._read_next(tensordict, "pose")
        reward = self._read_next(tensordict, "reward")
        done, terminated, truncated = (
            self._read_next(tensordict, name) for name in ("done", "terminated", "truncated")
        )

        reached = (mask & self.poses.reached(next_pose, goal_pose).unsqueeze(-1)).reshape(reward.shape)
        tensordict.set(keys.next("reward"), torch.where(reached, reward + self.success_reward, reward))
        tensordict.set(keys.next("done"), done | reached)
        tensordict.set(keys.next("terminated"), terminated | reached)
        tensordict.set(keys.next("truncated"), truncated & ~reached)
        return tensordict
