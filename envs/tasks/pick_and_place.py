"""PickAndPlace: fetch the red box and bring it to the green one."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from ..arenas.walled_room import WalledRoom
from ..props.goal_box import GoalBox
from .goal import Goal
from .goal_task import GoalTask

_HELD = 3
"""Index of the flag in a pose."""


class PickAndPlace(GoalTask):
    """Centre the red box close by and it is picked up; then centre the green box: reward 1 and the end.

    The pick-up pays nothing and ends nothing: it sets the flag ``held``, the fourth entry of ``pose``, already in the
    observation of the step that led to it. From then on the red box sits on the robot's front, in view of the camera at
    the lower edge, and collides with nothing. With ``held`` 0 the red box is the goal, with ``held`` 1 the green one
    (the "successive navigation" of Sahni et al., NeurIPS 2019).

    Close is, by default, the radius of the box's footprint plus the robot's plus 1.1 steps of 0.05 m.

    Args:
        robot: The robot.
        arena: The room; robot and boxes are attached to it.
        red_box: What is fetched; starts call it ``red_box``.
        green_box: Where it is brought; starts call it ``green_box``.
        min_start_distance: Between the robot and each box at the start of an episode [m].
        min_box_distance: Between the boxes at the start of an episode [m].
        pick_up_distance: At most this far from the red box it is picked up, between the centres [m].
        pick_up_tolerance: Most that its centre may then lie beside the optical axis [m].
        delivery_distance: At most this far from the green box the red one is delivered [m].
        delivery_tolerance: Most that its centre may then lie beside the optical axis [m].
        carry_height: Of the carried box's bottom above the floor [m].
        kwargs: Costs, rewards and timesteps, see :class:`GoalTask`.

    Raises:
        ValueError: if a length is out of range, or the room is too small for the start distances.
    """

    mission = "Fetch the red box, then find the green one"
    flags = ("held",)
    stages = ({"held": 0}, {"held": 1})

    def __init__(
        self,
        robot: Any,
        arena: WalledRoom,
        red_box: GoalBox,
        green_box: GoalBox,
        *,
        min_start_distance: float = 0.5,
        min_box_distance: float = 0.4,
        pick_up_distance: float = 0.13,
        pick_up_tolerance: float = 0.02,
        delivery_distance: float = 0.16,
        delivery_tolerance: float = 0.02,
        carry_height: float = 0.025,
        **kwargs: float,
    ) -> None:
        self._red = Goal(red_box, pick_up_distance, pick_up_tolerance)
        self._green = Goal(green_box, delivery_distance, delivery_tolerance)
        self._red.check(robot.radius, distance_name="pick_up_distance", tolerance_name="pick_up_tolerance")
        self._green.check(robot.radius, distance_name="delivery_distance", tolerance_name="delivery_tolerance")
        if not min_box_distance > pick_up_distance + delivery_distance:
            raise ValueError(
                f"min_box_distance={min_box_distance} m must exceed pick_up_distance + delivery_distance = "
                f"{pick_up_distance + delivery_distance:g} m, or the pick-up may deliver."
            )
        if not carry_height >= 0:
            raise ValueError(f"carry_height must not be negative; got {carry_height} m.")
        self._carry_height = carry_height
        self._carry_ahead = robot.radius - red_box.size / 2  # As far ahead as no wall hides it.
        self._held = False
        super().__init__(
            robot,
            arena,
            {"red_box": self._red, "green_box": self._green},
            min_start_distance=min_start_distance,
            min_box_distance=min_box_distance,
            **kwargs,
        )

    def pose(self, physics: Any) -> np.ndarray:
        """Returns the robot's x [m], y [m], yaw [rad], and ``held``, 0 or 1, float64 [4]."""
        return np.append(self.robot.pose(physics), self._held)

    def goal(self, pose: np.ndarray) -> Goal:
        """Returns the red box if ``held`` is 0 in pose [4], else the green box."""
        return self._green if pose[_HELD] else self._red

    def show(self, physics: Any, pose: np.ndarray, goal_position: np.ndarray | None) -> None:
        """Makes a picture, see :meth:`GoalTask.show`; a robot at a pose with ``held`` 1 carries the red box."""
        super().show(physics, pose, goal_position)
        if pose[_HELD]:
            self._carry(physics, pose)

    def _carry(self, physics: Any, pose: np.ndarray) -> None:
        x, y, yaw = pose[:3]
        ahead = self._carry_ahead * np.array([np.cos(yaw), np.sin(yaw)])
        self._red.prop.set_position(physics, np.array([x, y]) + ahead, yaw=yaw, height=self._carry_height)

    def _check_start(self, fixed: Mapping[str, np.ndarray]) -> None:
        super()._check_start(fixed)
        if "red_box" in fixed and fixed.get("held"):
            raise ValueError(
                f"red_box={fixed['red_box'].tolist()} cannot be fixed with held=1, the robot carries it: "
                "leave out one of the two."
            )

    def initialize_episode(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Places robot and boxes where :meth:`fix_start` says, else at random."""
        super().initialize_episode(physics, random_state)
        self._held = bool(self._fixed.get("held", False))
        self._red.prop.set_solid(physics, not self._held)
        if self._held:
            self._carry(physics, self.pose(physics))

    def after_step(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Notes whether the present goal is reached: picks up the red box, or succeeds at the green one."""
        del random_state
        pose = self.pose(physics)
        reached = self.is_success(pose, self.goal_position(physics))
        self._succeeded = reached and self._held
        if reached and not self._held:
            self._held = True
            self._red.prop.set_solid(physics, False)
        if self._held:
            self._carry(physics, pose)
            mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)  # Or the camera saw it a step behind.
