"""The first step of the sample path: which rows are relabelled, and to which goal."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from halgan_rl.poses import PoseTolerance
from halgan_rl.transforms.base import ReplayTransform


class DrawHindsightGoal(ReplayTransform):
    """Draws, for each sampled row, whether it is relabelled and which later pose of its episode becomes its goal.

    **Core rule.** A row is relabelled with the given probability, towards the pose d steps later, d uniform in
    1 ... horizon (or nearer, see ``nearness``). It never is if its horizon is 0, or if it already stands at the goal
    drawn.

    The probability is annealed linearly, as in :class:`torchrl.modules.EGreedyModule`: call :meth:`step` with the
    number of frames collected. It and the generator's state are part of ``state_dict()``.

    Args:
        probability: Share of rows to relabel at first, in [0, 1].
        final_probability: That share after ``annealing_steps`` frames, in [0, 1].
        annealing_steps: Frames, as counted by :meth:`step`, from the one to the other.

    Keyword Args:
        generator: The source of all randomness here. With ``prefetch`` its draws are not reproducible; to
            ``torch.compile`` a generator is opaque, so compile the transforms after this one.
        nearness: Preference k >= 1 for near goals: d is 1 + floor(horizon * u^k), u uniform in [0, 1). 1 is uniform, as
            in the paper; with 2 and a horizon of 32, the next pose is the goal 6 times as often.
        tolerance: When a row already stands at its goal; None relabels such rows too.
        pose_key: Pose ``[P]`` of the row.
        hindsight_key: Where :class:`~halgan_rl.transforms.StampFuturePoses` wrote ``"pose"`` and ``"horizon"``.
        goal_key: Where ``"mask"`` ``[1]`` bool and ``"pose"`` ``[P]`` are written; the pose means nothing where the
            mask is False.

    Raises:
        ValueError: If a probability is outside [0, 1], or ``annealing_steps`` or ``nearness`` is less than 1.
        KeyError: On sampling, if a row lacks a key; names the key and the argument that set it.

    Examples:
        >>> from tensordict import TensorDict
        >>> futures = torch.arange(1.0, 4.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        >>> hindsight = {"pose": futures.expand(2, 3, 3), "horizon": torch.tensor([[3], [0]])}
        >>> rows = TensorDict({"pose": torch.zeros(2, 3), "hindsight": hindsight}, batch_size=[2])
        >>> rows = DrawHindsightGoal(1.0, generator=torch.Generator().manual_seed(0))(rows)
        >>> rows["goal", "mask"].tolist()
        [[True], [False]]
    """

    probability: Tensor
    frames: Tensor

    def __init__(
        self,
        probability: float = 0.3,
        final_probability: float = 0.0,
        annealing_steps: int = 60_000,
        *,
        generator: torch.Generator,
        nearness: float = 1.0,
        tolerance: PoseTolerance | None = PoseTolerance(),  # noqa: B008 (frozen)
        pose_key: NestedKey = "pose",
        hindsight_key: NestedKey = "hindsight",
        goal_key: NestedKey = "goal",
    ) -> None:
        super().__init__()
        for name, value in (("probability", probability), ("final_probability", final_probability)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], got {value}.")
        if annealing_steps < 1:
            raise ValueError(f"annealing_steps must be at least 1 frame, got {annealing_steps}.")
        self.initial_probability = probability
        self.final_probability = final_probability
        self.annealing_steps = annealing_steps
        self.generator = generator
        if not nearness >= 1.0:
            raise ValueError(f"nearness must be at least 1, got {nearness}.")
        self.nearness = nearness
        self.tolerance = tolerance
        self.pose_key = pose_key
        self.hindsight_key = hindsight_key
        self.goal_key = goal_key
        self.register_buffer("probability", torch.tensor(float(probability)))
        self.register_buffer("frames", torch.tensor(0))

    def step(self, frames: int = 1) -> None:
        """Anneals the probability.

        Args:
            frames: Frames collected since the last call.
        """
        self.frames += frames
        done = (self.frames / self.annealing_steps).clamp(max=1.0)
        self.probability.copy_(torch.lerp(*self._endpoints(), done))

    def _edit_rows(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds the goal's mask and pose to sampled rows ``[...]``."""
        pose = self._read(tensordict, self.pose_key, "pose_key")
        futures = self._read(tensordict, unravel_key((self.hindsight_key, "pose")), "hindsight_key")
        horizon = self._read(tensordict, unravel_key((self.hindsight_key, "horizon")), "hindsight_key")
        goal_pose = self._draw_pose(futures, horizon)
        mask = (self._uniform(horizon) < self.probability) & (horizon > 0)
        if self.tolerance is not None:
            mask = mask & ~self.tolerance(pose, goal_pose).unsqueeze(-1)
        tensordict.set(unravel_key((self.goal_key, "mask")), mask)
        tensordict.set(unravel_key((self.goal_key, "pose")), goal_pose)
        return tensordict

    def get_extra_state(self) -> dict[str, Any]:
        """Returns the generator's state."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`get_extra_state` returned."""
        self.generator.set_state(state["generator"].cpu())

    def _draw_pose(self, futures: Tensor, horizon: Tensor) -> Tensor:
        """Picks one of the first ``horizon`` poses ``[..., D, P]``: ``[..., P]``."""
        index = (self._uniform(horizon) ** self.nearness * horizon).long()
        index = torch.minimum(index, horizon - 1).clamp(min=0)  # against rounding up; horizon 0 is masked out later
        return torch.take_along_dim(futures, index.unsqueeze(-1), dim=-2).squeeze(-2)

    def _uniform(self, like: Tensor) -> Tensor:
        """Draws from [0, 1), one number for each entry of ``like``."""
        return torch.rand(like.shape, generator=self.generator, device=self.generator.device).to(like.device)

    def _endpoints(self) -> tuple[Tensor, Tensor]:
        new = self.probability.new_tensor
        return new(self.initial_probability), new(self.final_probability)
