"""Which wrappers of environments keep a terminal row's own last observation, and what happens with the others."""

from collections.abc import Callable
from functools import partial

import gymnasium
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import EnvBase, GymEnv, GymWrapper, ParallelEnv, SerialEnv, StepCounter, TransformedEnv

from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.transforms import StampFuturePoses
from tests.transforms import gymnasium_drift as drift

NAME = "tests.transforms.gymnasium_drift:Drift-v0"


def one() -> EnvBase:
    return GymWrapper(drift.Drift())


def vectorised(mode: gymnasium.vector.AutoresetMode) -> EnvBase:
    return GymWrapper(gymnasium.vector.SyncVectorEnv([drift.Drift] * 2, autoreset_mode=mode))


SAFE = {
    "GymEnv": lambda: GymEnv(NAME),
    "GymWrapper": one,
    "GymWrapper(Autoreset)": lambda: GymWrapper(gymnasium.wrappers.Autoreset(drift.Drift())),
    "SerialEnv": lambda: SerialEnv(2, one),
    "ParallelEnv": lambda: ParallelEnv(2, one),
    "TransformedEnv(SerialEnv)": lambda: TransformedEnv(SerialEnv(2, one), StepCounter()),
    "StepCounter(max_steps)": lambda: TransformedEnv(one(), StepCounter(max_steps=3)),
    "vectorised, DISABLED": partial(vectorised, gymnasium.vector.AutoresetMode.DISABLED),
}
SLOW = pytest.mark.slow  # it starts processes
UNSAFE = {
    "GymEnv(num_envs=2)": lambda: GymEnv(NAME, num_envs=2),
    "vectorised, SAME_STEP": partial(vectorised, gymnasium.vector.AutoresetMode.SAME_STEP),
}


def collect_into_buffer(make: Callable[[], EnvBase], stamp: StampFuturePoses) -> TensorDictReplayBuffer:
    buffer = TensorDictReplayBuffer(storage=FrameStorage(200), transform=stamp, batch_size=8)
    collector = Collector(make(), None, frames_per_batch=12, total_frames=48, replay_buffer=buffer)
    try:
        for _ in collector:
            pass
    finally:
        collector.shutdown()
    return buffer


@pytest.mark.parametrize("make", [pytest.param(SAFE[n], id=n, marks=SLOW if "Parallel" in n else ()) for n in SAFE])
def test_no_goal_leaves_its_episode(make: Callable[[], EnvBase]) -> None:
    rows = collect_into_buffer(make, StampFuturePoses(3, max_step=1.5 * drift.STEP))[:]
    goals = rows["hindsight", "pose"][..., 0]
    assert rows["next", "done"].sum() >= 6
    assert ((rows["pose"][:, :1] < goals) & (goals - rows["pose"][:, :1] < drift.START / 2)).all()


@pytest.mark.parametrize("make", UNSAFE.values(), ids=UNSAFE)
def test_a_row_that_leads_into_another_episode_is_refused(make: Callable[[], EnvBase]) -> None:
    with pytest.raises(ValueError, match=r"Row 4 of environment 0 leads from .* further than max_step=0\.375 m"):
        collect_into_buffer(make, StampFuturePoses(3, max_step=1.5 * drift.STEP))


@pytest.mark.parametrize("make", UNSAFE.values(), ids=UNSAFE)
def test_without_max_step_such_a_row_goes_unnoticed(make: Callable[[], EnvBase]) -> None:
    rows = collect_into_buffer(make, StampFuturePoses(3))[:]
    last = rows[rows["next", "done"].flatten()]
    assert (last["next", "pose"][:, 0] != last["pose"][:, 0] + drift.STEP).any()


def test_the_length_of_a_step_is_measured_in_the_plane() -> None:
    pose = torch.tensor([[1.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    assert StampFuturePoses(3).poses.travelled(pose, pose + torch.tensor([3.0, 4.0, 9.0])).tolist() == [5.0, 5.0]
