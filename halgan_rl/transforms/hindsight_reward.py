"""The last step of the sample path: the reward of having reached the goal."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from halgan_rl.keys import Keys, dotted
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.transforms.base import ReplayTransform
from halgan_rl.transforms.n_step_rows import STEPS_KEY

FLAGS = ("done", "terminated", "truncated")
REMEDIES = {"truncated": " StepCounter(max_steps=...), appended to the environment, writes truncated."}


class HindsightReward(ReplayTransform):
    """Rewards and ends relabelled rows whose next pose is their goal.

    **Core rule.** Where ``(goal, "mask")`` is True and the pose at t+1 (never the one at t) is within tolerance of
    ``(goal, "pose")``, the reward grows by ``success_reward``, ``terminated`` and ``done`` become True and
    ``truncated`` False, all together. Every other row stays as it is, bit for bit: one relabelled but not there yet
    keeps its reward.

    **n-step returns.** With ``n_steps=n`` the goal may be reached at any of a row's steps. With k the first step whose
    pose is the goal, 1 <= k <= n and within the row's horizon, the reward becomes r_1 + g r_2 + ... + g^(k-1) (r_k +
    ``success_reward``), g the discount; the flags change as above; and ``"steps_to_next_obs"`` becomes k.
    ``StampFuturePoses(n_steps=n)`` must have written the rows.

    A ``SliceSampler`` writes its own flags over these after the transforms ran: give it ``truncated_key=None``.

    Keyword Args:
        success_reward: Added to the row's own reward, which may hold an energy cost.
        n_steps: Steps that a row spans, as in ``StampFuturePoses``.
        discount: Discount of a step; needed for ``n_steps`` greater than 1, and then that of the loss.
        poses: When a pose is the goal pose.
        keys: Where rows keep what.

    Raises:
        ValueError: If ``n_steps`` or ``discount`` is out of range; on writing, if reward or flags are neither ``[...]``
            nor ``[..., 1]``, or flags are not bool; on sampling, if rows span other numbers of steps.
        KeyError: On writing and sampling, if a row lacks a key; names the key and the field of ``keys`` that set it.

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
        n_steps: int = 1,
        discount: float | None = None,
        poses: Poses = PlanarPoses(),
        keys: Keys = Keys(),
    ) -> None:
        super().__init__(keys)
        if n_steps < 1:
            raise ValueError(f"n_steps must be at least 1, got {n_steps}.")
        if n_steps > 1 and not (discount is not None and 0 <= discount <= 1):
            raise ValueError(f"n_steps={n_steps} needs the discount of the loss, between 0 and 1, got {discount}.")
        self.success_reward = success_reward
        self.n_steps = n_steps
        self.discount = 1.0 if discount is None else discount
        self.poses = poses

    def _check_written(self, rows: TensorDictBase) -> None:
        """Refuses rewards and flags that could not be rewritten."""
        self._read_next(rows, "pose")
        for name in ("reward", *FLAGS):
            entry = self._read(rows, name, self.keys.next(name), REMEDIES.get(name, ""))
            shapes = (rows.batch_size, (*rows.batch_size, 1))
            if entry.shape not in shapes or (name in FLAGS and entry.dtype != torch.bool):
                kind = "bool" if name in FLAGS else "a number"
                raise ValueError(
                    f"{type(self).__name__}: the entry {dotted(self.keys.next(name))} is {entry.dtype} "
                    f"{tuple(entry.shape)}; it must hold {kind} a row, {shapes[1]}."
                )

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Rewrites reward and flags of sampled rows ``[...]``."""
        keys = self.keys
        mask = self._read(tensordict, "goal", keys.goal_mask)
        goal_pose = self._read(tensordict, "goal", keys.goal_pose)
        reward = self._read_next(tensordict, "reward")
        done, terminated, truncated = (self._read_next(tensordict, name) for name in FLAGS)
        self._check_steps(tensordict)

        if self.n_steps == 1:
            reached = mask & self.poses.reached(self._read_next(tensordict, "pose"), goal_pose).unsqueeze(-1)
            rewarded = reward + self.success_reward
        else:
            steps = self._steps_to_goal(tensordict, goal_pose)
            reached = mask & (steps > 0)
            rewarded = self._discounted(tensordict, steps).to(reward.dtype).reshape(reward.shape)
            spanned = tensordict.get(STEPS_KEY)
            steps, there = steps.reshape(spanned.shape), reached.reshape(spanned.shape)
            tensordict.set(STEPS_KEY, torch.where(there, steps, spanned))

        reached = reached.reshape(reward.shape)
        tensordict.set(keys.next("reward"), torch.where(reached, rewarded, reward))
        tensordict.set(keys.next("done"), done | reached)
        tensordict.set(keys.next("terminated"), terminated | reached)
        tensordict.set(keys.next("truncated"), truncated & ~reached)
        return tensordict

    def _check_steps(self, rows: TensorDictBase) -> None:
        """Refuses rows that span other numbers of steps than ``n_steps``."""
        rewards, spanned = rows.get(self.keys.hindsight_reward, None), rows.get(STEPS_KEY, None)
        if spanned is None and rewards is None and self.n_steps == 1:
            return
        stamped = 0 if spanned is None or rewards is None else rewards.shape[-1]
        if stamped != self.n_steps:
            written = f"written by StampFuturePoses(n_steps={stamped})" if stamped else "not"
            raise ValueError(
                f"HindsightReward(n_steps={self.n_steps}) needs rows that StampFuturePoses wrote with the same "
                f"n_steps, but these are {written}. Give both the same n_steps and discount, as pipelines.halgan does, "
                "and use no MultiStepTransform."
            )

    def _steps_to_goal(self, rows: TensorDictBase, goal_pose: Tensor) -> Tensor:
        """Returns how many steps each row first takes to its goal, int64 ``[..., 1]``: 0 if more than ``n_steps``."""
        poses = self._read(rows, "hindsight", self.keys.hindsight_pose)[..., : self.n_steps, :]
        horizon = self._read(rows, "hindsight", self.keys.hindsight_horizon)
        number = torch.arange(1, self.n_steps + 1, device=horizon.device)
        there = self.poses.reached(poses, goal_pose.unsqueeze(-2)) & (number <= horizon)
        return torch.where(there.any(-1, keepdim=True), there.int().argmax(-1, keepdim=True) + 1, 0)

    def _discounted(self, rows: TensorDictBase, steps: Tensor) -> Tensor:
        """Returns the discounted rewards of the first ``steps`` steps ``[..., 1]`` of each row, and of its success."""
        rewards = self._read(rows, "hindsight", self.keys.hindsight_reward)
        before = torch.arange(self.n_steps, device=steps.device)
        rewards = torch.where(before < steps, rewards, 0.0) + self.success_reward * (before == steps - 1)
        return (rewards * self.discount**before).sum(-1, keepdim=True)
