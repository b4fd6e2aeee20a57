"""The first step of the sample path: which rows are relabelled, and to which goal."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.transforms.annealing import Annealing
from halgan_rl.transforms.base import ReplayTransform
from halgan_rl.transforms.slices import first_of_slice, refuse_slices

INIT_KEY = "is_init"
"""Where TorchRL's ``InitTracker`` and recurrent modules keep whether a sequence starts at a row."""


class DrawHindsightGoal(ReplayTransform):
    """Draws, for each sampled row, whether it is relabelled and which later pose of its episode becomes its goal.

    **Core rule.** A row is relabelled with the given probability, towards the pose d steps later, d uniform in
    1 ... horizon (or nearer, see ``nearness``). It never is if its horizon is 0, or if it already stands at the goal
    drawn.

    The probability is annealed linearly, as in :class:`torchrl.modules.EGreedyModule`: call :meth:`step` with the
    number of frames collected. The frames and the state of ``rng`` are part of ``state_dict()``.

    **Slices.** A sampler of slices gives consecutive rows, for learners of sequences. With ``per_slice=True``
    consecutive rows share one decision and one goal, those drawn for the first of them: so all frames show the same
    goal. A slice is relabelled up to the row that reaches its goal, which terminates there; the rows behind that one
    keep their own images and rewards. ``"is_init"``, if rows have it, becomes True in the first row of a slice and in
    the first row behind a goal, for a learner of sequences starts anew there. Slices may have any lengths: one begins
    where a row is not what follows the row before it. TorchRL's sampler writes flags of its own after the transforms
    ran, so it must be ``SliceSampler(..., truncated_key=None, init_key=None)``; reshape batches to ``[S, L]`` for
    returns that look along the time. Without ``per_slice``, slices are refused.

    Args:
        probability: Fraction of rows to relabel, in [0, 1], by the frames that :meth:`step` has counted.

    Keyword Args:
        rng: The source of all randomness here. With ``prefetch`` its draws are not reproducible; to ``torch.compile``
            a generator is opaque, so compile the transforms after this one.
        nearness: Preference k >= 1 for near goals: d is 1 + floor(horizon * u^k), u uniform in [0, 1). 1 is uniform, as
            in the paper; with 2 and a horizon of 32, the next pose is the goal 6 times as often.
        skip_reached: Whether rows that already are at their goal are left alone.
        per_slice: Whether consecutive rows share a goal.
        poses: When a pose is the goal pose.
        keys: Where rows keep what. The goal's pose means nothing where its mask is False.

    Raises:
        ValueError: If a probability is outside [0, 1], or ``nearness`` is less than 1; on sampling, if rows evidently
            are slices, by their ``"index"``, and ``per_slice`` is False.
        KeyError: On sampling, if a row lacks a key; names the key and the field of ``keys`` that set it.

    Examples:
        >>> from tensordict import TensorDict
        >>> futures = torch.arange(1.0, 4.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        >>> hindsight = {"pose": futures.expand(2, 3, 3), "horizon": torch.tensor([[3], [0]])}
        >>> rows = TensorDict({"pose": torch.zeros(2, 3), "hindsight": hindsight}, batch_size=[2])
        >>> rows = DrawHindsightGoal(Annealing(1.0, 1.0, 1), rng=torch.Generator().manual_seed(0))(rows)
        >>> rows["goal", "mask"].tolist()
        [[True], [False]]
    """

    frames: Tensor

    def __init__(
        self,
        probability: Annealing = Annealing(0.3, 0.0, 60_000),
        *,
        rng: torch.Generator,
        nearness: float = 1.0,
        skip_reached: bool = True,
        per_slice: bool = False,
        poses: Poses = PlanarPoses(),
        keys: Keys = Keys(),
    ) -> None:
        super().__init__(keys)
        for name in ("start", "end"):
            if not 0.0 <= getattr(probability, name) <= 1.0:
                raise ValueError(f"probability.{name} must lie in [0, 1], got {getattr(probability, name)}.")
        if not nearness >= 1.0:
            raise ValueError(f"nearness must be at least 1, got {nearness}.")
        if per_slice and not skip_reached:
            raise ValueError("per_slice=True needs skip_reached=True: a slice ends where its goal is reached.")
        self.annealing = probability
        self.rng = rng
        self.nearness = nearness
        self.skip_reached = skip_reached
        self.per_slice = per_slice
        self.poses = poses
        self.register_buffer("frames", torch.tensor(0))

    @property
    def probability(self) -> float:
        """The present fraction of rows to relabel."""
        return self.annealing.at(int(self.frames))

    def step(self, frames: int = 1) -> None:
        """Anneals the probability.

        Args:
            frames: Frames collected since the last call.
        """
        self.frames += frames

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds the goal's mask and pose to sampled rows ``[...]``."""
        pose = self._read(tensordict, "pose")
        futures = self._read(tensordict, "hindsight", self.keys.hindsight_pose)
        horizon = self._read(tensordict, "hindsight", self.keys.hindsight_horizon)
        goal_pose = self._draw_pose(futures, horizon)
        mask = (self._uniform(horizon) < self.probability) & (horizon > 0)
        if self.per_slice:
            mask, goal_pose = self._share(tensordict, mask, goal_pose)
        else:
            refuse_slices(tensordict)
            if self.skip_reached:
                mask = mask & ~self.poses.reached(pose, goal_pose).unsqueeze(-1)
        tensordict.set(self.keys.goal_mask, mask)
        tensordict.set(self.keys.goal_pose, goal_pose)
        return tensordict

    def _share(self, tensordict: TensorDictBase, mask: Tensor, goal_pose: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mask and goal of each row's slice: those of its first row, up to the row that reaches the goal."""
        futures = tensordict.get(self.keys.hindsight_pose)
        futures = futures.reshape(-1, *futures.shape[-2:])
        pose = tensordict.get(self.keys.pose).reshape(len(futures), -1)
        first = first_of_slice(pose, futures)
        goals = goal_pose.reshape(pose.shape)[first]
        there = self.poses.reached(pose, goals).long()
        met = there.cumsum(0)
        passed = met - (met - there)[first] > 0  # at its goal here, or before in its slice
        masks = mask.flatten()[first] & ~passed
        if INIT_KEY in tensordict:
            starts = first == torch.arange(len(first), device=first.device)
            starts[1:] |= masks[:-1] & ~masks[1:]
            init = tensordict.get(INIT_KEY)
            tensordict.set(INIT_KEY, init | starts.reshape(init.shape))
        return masks.reshape(mask.shape), goals.reshape(goal_pose.shape)

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the generator's state."""
        return {"rng": self.rng.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`get_extra_state` returned."""
        self.rng.set_state(state["rng"].cpu())

    def _draw_pose(self, futures: Tensor, horizon: Tensor) -> Tensor:
        """Picks one of the first ``horizon`` poses ``[..., D, P]``: ``[..., P]``."""
        index = (self._uniform(horizon) ** self.nearness * horizon).long()
        index = torch.minimum(index, horizon - 1).clamp(min=0)  # against rounding up; horizon 0 is masked out later
        return torch.take_along_dim(futures, index.unsqueeze(-1), dim=-2).squeeze(-2)

    def _uniform(self, like: Tensor) -> Tensor:
        """Draws from [0, 1), one number for each entry of ``like``."""
        return torch.rand(like.shape, generator=self.rng, device=self.rng.device).to(like.device)
