"""Snapshots near the goal and away from it, for training a hallucinator.

The near-goal ones come from a scripted controller with *privileged* access: it reads the goal's position from the
simulator, which no agent may do. It replaces a person who drives the robot to the goal a few dozen times (Sahni et al.,
NeurIPS 2019, section 4). Every episode ends in a real success, and no image is picked by hand.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from .adapters.transition import random_action
from .environment import Environment
from .tasks.goal import Goal, in_robot_frame

_CALM_DISTANCE = 2.5
"""Farther from the goal than this, in units of the goal's offset, the driver wanders little."""
_FAR_NOISE = 0.2
"""Fraction of random actions there."""
_NOISE = (0.6, 1.0)
"""Lowest and highest fraction of random actions near the goal: the segments that hindsight relabels wander too."""
_HOLD = 8
"""Steps that a random action of a failed episode lasts."""


class NoisyDriver:
    """Steers to the goal, mixed with uniformly random actions; privileged.

    Each episode draws how noisy it is near the goal, so that its last steps look by turns like a drive and like the
    wandering of an untrained agent. One that came too close backs up; a robot without a reverse gear takes no random
    action that leads there, and if it is there, it drives on, over the goal or past it, and turns back.

    Args:
        environment: Where it drives.
        random_state: Source of all its noise.
        noise: Lowest and highest fraction of random actions near the goal.
    """

    def __init__(
        self, environment: Environment, random_state: np.random.RandomState, noise: tuple[float, float] = _NOISE
    ) -> None:
        self._environment = environment
        self._random_state = random_state
        self._range = noise
        self.start_episode()

    def start_episode(self) -> None:
        """Draws this episode's noise."""
        self._noise = self._random_state.uniform(*self._range)

    def act(self, pose: np.ndarray) -> Any:
        """Returns an action for a robot at pose [P]."""
        task = self._environment.task
        ahead, left = in_robot_frame(pose, task.goal_position(self._environment.physics))
        goal = task.goal(pose)
        noise = self._noise if np.hypot(ahead, left) < _CALM_DISTANCE * goal.offset else _FAR_NOISE
        if self._random_state.uniform() < noise:
            action = random_action(self._environment.action_spec(), self._random_state)
            step = task.robot.velocities(action)[0] * task.control_timestep
            if not self._is_stuck_at(ahead - step, left, goal):
                return action
        return self._steer(ahead, left, goal)

    def _is_stuck_at(self, ahead: float, left: float, goal: Goal) -> bool:
        # Too close, and unable to back up.
        return bool(np.hypot(ahead, left) < goal.nearest and not self._environment.task.robot.reverse_speed)

    def _steer(self, ahead: float, left: float, goal: Goal) -> Any:
        task = self._environment.task
        if self._is_stuck_at(ahead, left, goal):
            return task.robot.action_for(task.robot.max_speed, 0.0)
        bearing = np.arctan2(left, ahead)
        gap = np.hypot(ahead, left) - 0.9 * goal.distance
        speed = gap / task.control_timestep if abs(bearing) < 0.5 else 0.0
        return task.robot.action_for(speed, bearing / task.control_timestep)


def collect_near_goal(
    environment: Environment,
    count: int,
    random_state: np.random.RandomState,
    *,
    steps_before_goal: int = 32,
    noise: tuple[float, float] = _NOISE,
) -> dict[str, np.ndarray]:
    """Collects the last states before each goal of successful rollouts of the privileged driver.

    The flags of a pose select the goal that its image shows from near. Where flags change within a rollout, as at a
    pick-up, one goal is reached and the next is pursued: each goal gives about as many snapshots.

    Args:
        environment: Where to drive; ends up mid-episode.
        count: Number of snapshots N.
        random_state: Source of the driver's noise; the starts are the environment's own.
        steps_before_goal: States kept of the way to each goal besides its last one.
        noise: Lowest and highest fraction of random actions near the goal.

    Returns:
        ``pixels`` uint8 [N, H, W, 3], ``pose`` float32 [N, P], and ``goal_pose`` float32 [N, P]: where the robot stood
        when it reached the goal, with the flags of ``pose``. The state in which a rollout succeeds is its own goal pose
        and among the snapshots; one in which flags change is not, for its image shows the next goal.

    Raises:
        ValueError: if count or steps_before_goal is out of range.
        RuntimeError: if the driver hardly ever succeeds.
    """
    _check_count(count)
    if steps_before_goal < 0:
        raise ValueError(f"steps_before_goal must not be negative; got {steps_before_goal}.")
    driver = NoisyDriver(environment, random_state, noise)
    snapshots: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    failures = 0
    while len(snapshots) < count:
        ways, succeeded = _drive(environment, driver, steps_before_goal + 1)
        if succeeded:
            snapshots += ways
            failures = 0
        else:
            failures += 1
        if failures >= 100:
            raise RuntimeError("The scripted driver failed 100 times in a row: lower noise or extend the time limit.")
    kept = snapshots if len(snapshots) == count else [snapshots[i] for i in _subsample(snapshots, count, random_state)]
    return dict(zip(("pixels", "pose", "goal_pose"), map(np.stack, zip(*kept, strict=True)), strict=True))


def collect_failed(environment: Environment, count: int, random_state: np.random.RandomState) -> dict[str, np.ndarray]:
    """Collects snapshots of episodes with uniformly random actions that do not succeed.

    Each action is held for a while: turns that are drawn anew at each step average out, and all walks end at a wall.
    The goal may be in view; no image is left out for it. A task with several goals gives as many snapshots of walks
    that start with the one as of walks that start with the other, in this order.

    Args:
        environment: Where to wander; ends up mid-episode.
        count: Number of snapshots M.
        random_state: Source of the actions; the starts are the environment's own.

    Returns:
        ``pixels`` uint8 [M, H, W, 3], ``pose`` float32 [M, P], and ``episode`` int64 [M], the number of the walk that a
        snapshot is of; those of a walk are consecutive.

    Raises:
        ValueError: if count is out of range.
    """
    _check_count(count)
    stages = environment.task.stages
    snapshots: list[tuple[np.ndarray, np.ndarray, int]] = []
    walks = 0
    for number, stage in enumerate(stages, start=1):
        enough = count * number // len(stages)
        while len(snapshots) < enough:
            walk, succeeded = _wander(environment, stage, random_state)
            if not succeeded:
                snapshots += [(*snapshot, walks) for snapshot in walk[: enough - len(snapshots)]]
                walks += 1
    return dict(zip(("pixels", "pose", "episode"), map(np.stack, zip(*snapshots, strict=True)), strict=True))


def _drive(environment: Environment, driver: NoisyDriver, keep: int) -> tuple[list[Any], bool]:
    """Returns the last snapshots before each goal that a rollout reached, with goal poses, and whether it succeeded."""
    driver.start_episode()
    timestep = environment.reset()
    way = deque([_snapshot(timestep)], maxlen=keep)
    ways: list[Any] = []
    while not timestep.last():
        timestep = environment.step(driver.act(way[-1][1]))
        pixels, pose = _snapshot(timestep)
        if (pose[3:] != way[-1][1][3:]).any():
            ways += _with_goal(way, pose)
            way.clear()
        way.append((pixels, pose))
    return ways + _with_goal(way, pose), timestep.discount == 0.0


def _with_goal(way: Iterable[Any], goal_pose: np.ndarray) -> list[Any]:
    return [(pixels, pose, np.append(goal_pose[:3], pose[3:])) for pixels, pose in way]


def _wander(
    environment: Environment, stage: Mapping[str, Any], random_state: np.random.RandomState
) -> tuple[list[Any], bool]:
    timestep = environment.reset_to(stage)
    episode = [_snapshot(timestep)]
    while not timestep.last():
        if (len(episode) - 1) % _HOLD == 0:
            action = random_action(environment.action_spec(), random_state)
        timestep = environment.step(action)
        episode.append(_snapshot(timestep))
    return episode, timestep.discount == 0.0


def _snapshot(timestep: Any) -> tuple[np.ndarray, np.ndarray]:
    return timestep.observation["pixels"], timestep.observation["pose"]


def _subsample(snapshots: list[Any], count: int, random_state: np.random.RandomState) -> np.ndarray:
    return np.sort(random_state.choice(len(snapshots), size=count, replace=False))


def _check_count(count: int) -> None:
    if count <= 0:
        raise ValueError(f"count must be positive; got {count}.")
