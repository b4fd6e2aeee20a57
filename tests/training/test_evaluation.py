"""Evaluation counts terminations, on the starts it was given."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from halgan_rl.training.evaluation import evaluate, record


class Corridor(EnvBase):
    """Starts at the seed; each step adds the action. Terminates at 3 or above, is truncated after 4 steps."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_spec = Composite(
            position=Unbounded((1,)), pixels=Bounded(0, 255, (2, 2, 3), dtype=torch.uint8)
        )
        self.action_spec = Bounded(-1.0, 1.0, (1,))
        self.reward_spec = Unbounded((1,))
        self.done_spec = Composite(
            {name: Binary(1, (1,), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        )
        self.start = 0

    def _set_seed(self, seed: int | None) -> None:
        self.start = seed or 0

    def _observe(self) -> dict[str, torch.Tensor]:
        return {
            "position": torch.tensor([self.position]),
            "pixels": torch.full((2, 2, 3), int(self.position), dtype=torch.uint8),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        self.position, self.time = float(self.start), 0
        return TensorDict(self._observe(), batch_size=[])

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.position += float(tensordict["action"])
        self.time += 1
        terminated = torch.tensor([self.position >= 3])
        truncated = torch.tensor([self.time >= 4]) & ~terminated
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**self._observe(), "reward": torch.tensor([0.5]), **flags}, batch_size=[])


def walk(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.full((1,), 0.5))


def test_success_is_termination_and_not_the_time_limit() -> None:
    # From 2 it takes 2 steps; from 1 it takes 4, the last of which terminates; from 0 the time runs out at 4.
    result = evaluate(Corridor(), walk, seeds=[2, 1, 0])
    assert result.success_rate == pytest.approx(2 / 3)
    assert result.episode_length == pytest.approx((2 + 4 + 4) / 3)
    assert result.episode_return == pytest.approx((1.0 + 2.0 + 2.0) / 3)
    assert result.metrics("eval")["eval/success_rate"] == result.success_rate


def test_no_start_is_an_error() -> None:
    with pytest.raises(ValueError, match="seeds is empty"):
        evaluate(Corridor(), walk, seeds=[])


def test_a_film_shows_both_views_from_the_first_to_the_last_frame() -> None:
    env = Corridor()
    frames = record(env, walk, lambda: np.full((4, 5, 3), 100 + env.time, dtype=np.uint8), seeds=[2, 1])
    assert [frame.shape for frame in frames] == [(4, 9, 3)] * (3 + 5)
    assert [int(frame[0, 0, 0]) for frame in frames] == [100, 101, 102, 100, 101, 102, 103, 104]
    assert [int(frame[3, 8, 0]) for frame in frames] == [2, 2, 3, 1, 1, 2, 2, 3]
