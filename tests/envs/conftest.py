"""What the tests of the environments have in common."""

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest

import halgan_envs


class Stage:
    """An environment in which a test puts robot and box where it wants them."""

    def __init__(self, environment: halgan_envs.Environment) -> None:
        self.environment = environment
        self.task = environment.task
        self.robot = environment.task.robot
        self.box = environment.task.goals["box"].prop

    @property
    def physics(self) -> Any:
        return self.environment.physics

    def place(self, pose: tuple[float, float, float], box: tuple[float, float] = (-0.6, -0.6)) -> None:
        self.environment.reset()
        self.robot.set_pose(self.physics, np.array(pose))
        self.box.set_position(self.physics, np.array(box))
        mujoco.mj_forward(self.physics.model.ptr, self.physics.data.ptr)

    def step(self, forward: float = 0.0, turn: float = 0.0) -> Any:
        """Steps at a fraction of the full speed and a fraction of the full turn rate."""
        return self.environment.step(np.array([2 * forward - 1, turn]))

    def pose(self) -> np.ndarray:
        return self.robot.pose(self.physics)


@pytest.fixture(scope="module")
def room_2m() -> Iterator[halgan_envs.Environment]:
    environment = halgan_envs.navigate_2m(random_state=0)
    yield environment
    environment.close()


@pytest.fixture
def stage(room_2m: halgan_envs.Environment) -> Stage:
    return Stage(room_2m)


@pytest.fixture(params=sorted(halgan_envs.NAMES))
def named_environment(request: pytest.FixtureRequest) -> Iterator[halgan_envs.Environment]:
    environment = halgan_envs.named(request.param)(random_state=3)
    yield environment
    environment.close()
