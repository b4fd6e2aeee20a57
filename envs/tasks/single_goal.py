"""SingleGoalTask: what tasks share in which there is one thing to find."""

import math
from typing import Any

import numpy as np

from ..arenas.arena import Arena
from .goal import Goal
from .goal_task import GoalTask


class SingleGoalTask(GoalTask):
    """Reward 1 and the end when the only goal is reached.

    Args:
        robot: The robot.
        arena: The place; robot and goal are attached to it.
        name: Of the goal in :meth:`fix_start`.
        goal: The goal.
        min_start_distance: At least so far are robot and goal apart at the start of an episode [m].
        max_start_distance: At most so far [m].
        kwargs: Costs, rewards and timesteps, see :class:`GoalTask`.

    Raises:
        ValueError: if a length is not positive, start distances are out of order, or the arena is too small for them.
    """

    def __init__(
        self,
        robot: Any,
        arena: Arena,
        name: str,
        goal: Goal,
        *,
        min_start_distance: float,
        max_start_distance: float = math.inf,
        **kwargs: float,
    ) -> None:
        self._goal = goal
        goal.check(robot.radius, distance_name="success_distance", tolerance_name="centring_tolerance")
        super().__init__(
            robot,
            arena,
            {name: goal},
            min_start_distance=min_start_distance,
            max_start_distance=max_start_distance,
            **kwargs,
        )

    def goal(self, pose: np.ndarray) -> Goal:
        """Returns the only one, wherever the robot is."""
        del pose
        return self._goal

    def after_step(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Notes whether the goal is reached."""
        del random_state
        self._succeeded = self.is_success(self.pose(physics), self.goal_position(physics))
