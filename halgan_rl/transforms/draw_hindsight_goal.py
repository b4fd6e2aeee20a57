"""The first step of the sample path: which rows are relabelled, and to which goal."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.transforms.annealing import Annealing
from halgan_rl.transforms.base import ReplayTransform


class DrawHindsightGoal(ReplayTransform):
    """Draws, for each sampled row, whether it is relabelled and which later pose of its episode becomes its goal.

    **Core rule.** A row is relabelled with the given probability, towards the pose d steps later, d uniform in
    1 ... horizon (or nearer, see ``nearness``). It never is if its horizon is 0, or if it already stands at the goal
    drawn.

    The probability is annealed linearly, as in :class:`torchrl.modules.EGreedyModule`: call :meth:`step` with the
    number of frames collected. It and the generator's state are part of ``state_dict()``.

    Args:
        probability: Fraction of rows to relabel, in [0, 1], by the frames that :meth:`step` has counted.

    Keyword Args:
        rng: The source of all randomness here. With ``prefetch`` its draws are not reproducible; to ``torch.compile``
            a generator is opaque, so compile the transforms after this one.
        nearness: Preference k >= 1 for near goals: d is 1 + floor(horizon * u^k), u uniform in [0, 1). 1 is uniform, as
            in the paper; with 2 and a horizon of 32, the next pose is the goal 6 times as often.
        skip_reached: Whether rows that already are at their goal are left alone.
        poses: When a pose is the goal pose.
        keys: Where rows keep what. The goal's pose means nothing where its mask is False.

    Raises:
        ValueError: If a probability is outside [0, 1], or ``nearness`` is less than 1.
        KeyError: On sampling, if a row lacks a key; names the key and the argument that set it.

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
        probability: Annealing = Annealing(0.3, 0.0, 60_000),  # noqa: B008 (frozen)
        *,
        rng: torch.Generator,
        nearness: float = 1.0,
        skip_reached: bool = True,
        poses: Poses = PlanarPoses(),  # noqa: B008 (frozen)
        keys: Keys = Keys(),  # noqa: B008 (frozen)
    ) -> None:
        super().__init__(keys)
        for name in ("start", "end"):
            if not 0.0 <= getattr(probability, name) <= 1.0:
                raise ValueError(f"probability.{name} must lie in [0, 1], got {getattr(probability, name)}.")
        if not nearness >= 1.0:
            raise ValueError(f"nearness must be at least 1, got {nearness}.")
        self.annealing = probability
        self.rng = rng
        self.nearness = nearness
        self.skip_reached = skip_reached
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
        if self.skip_reached:
            mask = mask & ~self.poses.reached(pose, goal_pose).unsqueeze(-1)
        tensordict.set(self.keys.goal_mask, mask)
        tensordict.set(self.keys.goal_pose, goal_pose)
        return tensordict

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
