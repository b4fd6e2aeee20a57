"""A batch is collected by one policy, the one of when the batch before was taken, and runs repeat themselves."""

import time

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import ExcludeTransform
from torchrl.modules import EGreedyModule

from halgan_rl.training.background_collector import BackgroundCollector
from tests.training.test_evaluation import Corridor
from tests.training.test_evaluation_process import make_policy

BATCH = 16


class Unhurried(Corridor):
    """Takes its time, so that the policy is changed while a batch is collected."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        time.sleep(0.005)
        return super()._step(tensordict)


def collect(epsilon: float, random_frames: int) -> list[Tensor]:
    """Return the actions of five batches, while the policy's action grows by 0.001 every 10 ms."""
    policy = make_policy(0.0)
    explorer = TensorDictSequential(policy, EGreedyModule(Bounded(-1.0, 1.0, (1,)), epsilon, epsilon))
    collector = BackgroundCollector(
        Unhurried,
        explorer,
        frames_per_batch=BATCH,
        total_frames=5 * BATCH,
        init_random_frames=random_frames,
        postproc=ExcludeTransform("collector"),
    )
    collector.set_seed(0)
    actions = []
    try:
        for batch in collector:
            actions.append(batch["action"].flatten().clone())
            for _ in range(10):
                time.sleep(0.01)
                with torch.no_grad():
                    policy.module.bias += 0.001
    finally:
        collector.shutdown()
    return actions


def test_a_batch_is_collected_by_the_policy_of_when_the_batch_before_was_taken() -> None:
    actions = collect(epsilon=0.0, random_frames=0)
    for number, batch in enumerate(actions):
        torch.testing.assert_close(batch, torch.full((BATCH,), 0.01 * max(number - 1, 0)))


def test_a_run_repeats_itself() -> None:
    one, other = collect(epsilon=0.5, random_frames=BATCH), collect(epsilon=0.5, random_frames=BATCH)
    assert all(torch.equal(first, second) for first, second in zip(one, other, strict=True))
    assert len(torch.cat(one).unique()) > 3 * BATCH  # there was something to repeat
