"""Does it learn? Relabelling finds the toy's sparse reward, and nothing else does: one seed, all else the same."""

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

from halgan_rl.transforms import Annealing, HindsightConfig
from halgan_rl.transforms.pipelines import halgan
from tests import toy
from tests.transforms.rows import random_source

FRAMES = 12_288
CARS = 8


class QNetwork(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        inputs = toy.SIZE * toy.SIZE * 3
        self.layers = nn.Sequential(
            nn.Linear(inputs, 128), nn.ReLU(), nn.Linear(128, 128), nn.ReLU(), nn.Linear(128, 3)
        )

    def forward(self, pixels: Tensor) -> Tensor:
        return self.layers(pixels.flatten(-3).float() / 255)


def train(probability: float, seed: int = 1, frames: int = FRAMES) -> tuple[float, int, list[Tensor]]:
    """Trains double DQN; returns evaluation success, the number of real successes seen, and the final parameters."""
    torch.manual_seed(seed)
    environment = toy.Parking(CARS, seed=seed)
    actor = QValueActor(QNetwork(), in_keys=["pixels"], spec=environment.action_spec_unbatched)
    explore = EGreedyModule(
        environment.action_spec_unbatched, eps_init=1.0, eps_end=0.2, annealing_num_steps=frames // 2
    )
    policy = TensorDictSequential(actor, explore)
    loss = DQNLoss(actor, action_space="categorical", double_dqn=True, delay_value=True)
    loss.make_value_estimator(gamma=0.95)
    target = SoftUpdate(loss, tau=0.02)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    pipeline = halgan(
        toy.hallucinate,
        rng=random_source(seed),
        config=HindsightConfig(Annealing(probability, probability / 2, frames), max_distance=16, nearness=1.0),
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames), transform=pipeline, batch_size=64, generator=random_source(seed)
    )
    collector = Collector(
        environment, policy, frames_per_batch=8 * CARS, total_frames=frames, auto_register_policy_transforms=False
    )
    successes = 0
    for batch in collector:
        buffer.extend(batch)
        explore.step(batch.numel())
        pipeline.step(batch.numel())
        successes += int(batch["next", "terminated"].sum())
        for _ in range(4 if len(buffer) > 500 else 0):
            optimizer.zero_grad()
            loss(buffer.sample())["loss"].backward()
            optimizer.step()
            target.step()
    collector.shutdown()
    return evaluate(policy), successes, [parameter.detach() for parameter in actor.parameters()]


@torch.no_grad()
def evaluate(policy: TensorDictSequential) -> float:
    """The greedy policy's share of successes over 200 starts that training has not seen."""
    environment = toy.Parking(200, seed=99)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = environment.rollout(environment.time_limit, policy, break_when_any_done=False)
    return rollout["next", "terminated"].any(1).float().mean().item()


@pytest.fixture(autouse=True)
def one_thread() -> object:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def test_with_relabelling_the_agent_learns_to_reach_its_goal() -> None:
    success, _, _ = train(probability=0.5)
    assert success >= 0.7


def test_without_relabelling_it_does_not_for_success_is_hardly_ever_seen() -> None:
    success, seen, _ = train(probability=0.0)
    assert success <= 0.05
    assert seen <= 6  # of some 550 episodes


def test_training_is_reproducible_and_reaches_updates() -> None:
    first, second, untrained = (train(0.5, frames=frames)[2] for frames in (1_024, 1_024, 64))
    assert all(map(torch.equal, first, second))
    assert not any(map(torch.equal, first, untrained))
