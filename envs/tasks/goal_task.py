"""GoalTask: what all tasks share in which a robot in a room must find goals by sight."""

import math
from collections.abc import Mapping
from itertools import combinations, product
from typing import Any

import numpy as np
from dm_control import composer
from dm_env import specs

from ..arenas.arena import Arena
from ..observables import KnownSpec
from .fixed_start import read_start
from .goal import Goal

_OUT_OF_SIGHT = np.array([0.0, 100.0])
"""Position x, y [m] where a box is put when it must not be seen."""

_POSE = {"pose": ("x [m]", "y [m]", "yaw [rad]")}
_POSITION = ("x [m]", "y [m]")
_FLAG = ("0 or 1",)
_MAX_DRAWS = 10_000
_WALL_CLEARANCE = 0.02
"""Between the robot and a wall at the start of an episode [m]."""


class GoalTask(composer.Task):
    """Reward 1 and the end when the last goal is reached; a small cost of moving.

    Observed are ``pixels``, the robot's image, uint8 [H, W, 3], and ``pose``, float32 [P]: x [m], y [m], yaw [rad],
    then the ``flags`` of the task, each 0 or 1. The flags of a pose select the goal that is pursued there.

    A subclass offers :meth:`goal` and says in ``after_step`` when ``_succeeded``; one with flags extends :meth:`pose`.

    Args:
        robot: The robot, e.g. ``halgan_envs.robots.rover.Rover``.
        arena: The room; robot and boxes are attached to it.
        goals: The goals, each by the name of its box in :meth:`fix_start`.
        min_start_distance: At least so far are the robot and each box apart at the start of an episode [m].
        max_start_distance: At most so far [m]; for goals that are seen from close by only.
        min_box_distance: Between any two boxes at the start of an episode [m].
        energy_cost: Subtracted from the reward for each unit of the Euclidean norm of speed and turn rate, in units of
            the robot's largest ones, each step.
        success_reward: Reward of the step that succeeds.
        control_timestep: Seconds a step.
        physics_timestep: Seconds a physics substep.

    Raises:
        ValueError: if the room is too small for the start distances, they are out of order, or episodes would start
            solved.
    """

    mission: str
    """A line for a person who drives."""
    flags: tuple[str, ...] = ()
    """Names of the entries of a pose after x, y and yaw."""
    stages: tuple[Mapping[str, Any], ...] = ({},)
    """For :meth:`fix_start`: one start for each goal, pursued from the first step."""

    def __init__(
        self,
        robot: Any,
        arena: Arena,
        goals: Mapping[str, Goal],
        *,
        min_start_distance: float,
        max_start_distance: float = math.inf,
        min_box_distance: float = 0.0,
        energy_cost: float = 0.0025,
        success_reward: float = 1.0,
        control_timestep: float = 0.1,
        physics_timestep: float = 0.02,
    ) -> None:
        self.robot = robot
        self.arena = arena
        self.goals = dict(goals)
        self.min_start_distance = min_start_distance
        self.max_start_distance = max_start_distance
        self.min_box_distance = min_box_distance
        self.energy_cost = energy_cost
        self.success_reward = success_reward
        self._check_room()
        self._attach()
        self._observables = self._make_observables()
        self.set_timesteps(control_timestep, physics_timestep)
        self._fixed: dict[str, np.ndarray] = {}
        self._succeeded = False
        self._energy = 0.0

    def _attach(self) -> None:
        self.robot.attach_to(self.arena)
        for goal in self.goals.values():
            self.arena.attach_mocap(goal.prop)

    def _make_observables(self) -> dict[str, KnownSpec]:
        pixels = specs.BoundedArray((*self.robot.image_size, 3), np.uint8, 0, 255, name="pixels")
        observables = {
            "pixels": KnownSpec(lambda physics: self.robot.camera.render(physics), pixels),
            "pose": KnownSpec(lambda physics: self.pose(physics).astype(np.float32), self.pose_spec),
        }
        for observable in observables.values():
            observable.enabled = True
        return observables

    def _check_room(self) -> None:
        reached = max(goal.distance for goal in self.goals.values())
        if not self.min_start_distance > reached:
            raise ValueError(
                f"min_start_distance={self.min_start_distance} m must exceed {reached} m, from where a goal counts as "
                "reached, or episodes start solved."
            )
        if not self.max_start_distance > self.min_start_distance:
            raise ValueError(
                f"max_start_distance={self.max_start_distance} m must exceed "
                f"min_start_distance={self.min_start_distance} m, or there is no start between them."
            )
        robot_range, box_range = self._robot_range, self._box_range
        widest = {
            "min_start_distance": np.hypot(*(np.maximum(robot_range, 0) + np.maximum(box_range, 0))),
            "min_box_distance": np.hypot(*(2 * np.maximum(box_range, 0))),
        }
        for name, farthest in widest.items():
            distance = getattr(self, name)
            if min(*robot_range, *box_range) <= 0 or not distance <= 0.75 * farthest:
                raise ValueError(
                    f"A {self.arena.description} is too small for {name}={distance} m: "
                    "use a larger one or a smaller distance."
                )

    @property
    def _robot_range(self) -> np.ndarray:
        # Largest |x| and |y| of the robot at the start.
        return self.arena.half_extent - self.robot.radius - _WALL_CLEARANCE

    @property
    def _box_range(self) -> np.ndarray:
        # Far enough from the walls that the robot fits before any side of it.
        return self.arena.half_extent - max(goal.distance for goal in self.goals.values()) - self.robot.radius

    @property
    def root_entity(self) -> Arena:
        """The arena."""
        return self.arena

    @property
    def task_observables(self) -> dict[str, KnownSpec]:
        """``pixels`` and ``pose``."""
        return self._observables

    @property
    def pose_spec(self) -> specs.BoundedArray:
        """Of ``pose``, float32 [P]: within the room, and within (-pi, pi], and flags in [0, 1]."""
        half = self.arena.half_extent
        lowest = np.array([*-half, -np.pi, *(0.0 for _ in self.flags)], np.float32)
        highest = np.array([*half, np.pi, *(1.0 for _ in self.flags)], np.float32)
        return specs.BoundedArray(lowest.shape, np.float32, lowest, highest, name="pose")

    def action_spec(self, physics: Any) -> Any:
        """Returns that of the robot."""
        del physics
        return self.robot.action_spec

    def pose(self, physics: Any) -> np.ndarray:
        """Returns the robot's x [m], y [m], yaw [rad], and the task's flags, float64 [P]."""
        return self.robot.pose(physics)

    def goal(self, pose: np.ndarray) -> Goal:
        """Returns the goal that a robot at pose [P] pursues, which the flags select."""
        raise NotImplementedError

    @property
    def goal_offsets(self) -> tuple[float, ...]:
        """The ``offset`` of the goal [m] for each setting of the flags, counted with the first flag as lowest bit."""
        settings = (setting[::-1] for setting in product((0, 1), repeat=len(self.flags)))
        return tuple(round(self.goal(np.array([0.0, 0.0, 0.0, *setting])).offset, 6) for setting in settings)

    def goal_position(self, physics: Any) -> np.ndarray:
        """Returns where the goal is that is pursued at present, x, y [m]; privileged: no agent may know it."""
        return self.goal(self.pose(physics)).prop.position(physics)

    def is_success(self, pose: np.ndarray, position: np.ndarray) -> bool:
        """Returns whether a robot at pose [P] has reached the goal it pursues, if that is at position [2]."""
        return self.goal(pose).is_reached(pose, position)

    def show(self, physics: Any, pose: np.ndarray, goal_position: np.ndarray | None) -> None:
        """Makes a picture: the robot and the goal that it pursues, every other goal out of sight.

        For physics that are rendered, not stepped. Positions derived from what is set are stale until a forward.

        Args:
            physics: The physics.
            pose: Of the robot, [P].
            goal_position: x, y [m]; None leaves the goal out.
        """
        self.robot.set_pose(physics, pose[:3])
        for goal in self.goals.values():
            goal.prop.set_position(physics, _OUT_OF_SIGHT)
        if goal_position is not None:
            self.goal(pose).prop.set_position(physics, goal_position)

    def initialize_episode(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Places robot and boxes where :meth:`fix_start` says, else at random."""
        start = self.draw_start(random_state, self._fixed)
        self.robot.set_pose(physics, start["pose"])
        for name, goal in self.goals.items():
            goal.prop.set_position(physics, start[name])
        self._succeeded = False
        self._energy = 0.0

    def fix_start(self, start: Mapping[str, Any]) -> None:
        """Fixes where episodes start, until it is called again; what is not given is drawn.

        Args:
            start: Any of ``pose``, the robot's x [m], y [m], yaw [rad], and of the names of ``goals``, each box's
                x [m], y [m], and of the flags, 0 or 1. Things that are given may be closer to each other than drawn
                ones. A flag that is not given is 0.

        Raises:
            ValueError: if a name is unknown, numbers are missing or not finite, something is not in the room, or two
                things overlap. What was fixed before then stays fixed.
        """
        fixed = read_start(start, _POSE | dict.fromkeys(self.goals, _POSITION) | dict.fromkeys(self.flags, _FLAG))
        self._check_start(fixed)
        self._fixed = fixed

    def _check_start(self, fixed: Mapping[str, np.ndarray]) -> None:
        self._check_in_room("pose", fixed, self.robot.radius)
        for name, goal in self.goals.items():
            self._check_in_room(name, fixed, goal.prop.size / 2)
            self._check_robot_apart(name, fixed)
        for one, other in combinations(self.goals, 2):
            self._check_boxes_apart(one, other, fixed)
        for flag in self.flags:
            if flag in fixed and fixed[flag] not in (0, 1):
                raise ValueError(f"{flag}={fixed[flag].item():g} must be 0 or 1.")

    def _check_in_room(self, name: str, fixed: Mapping[str, np.ndarray], extent: float) -> None:
        x, y = self.arena.half_extent - extent
        if name in fixed and (np.abs(fixed[name][:2]) > (x, y)).any():
            raise ValueError(
                f"{name}={fixed[name].tolist()} is not inside the {self.arena.description}: "
                f"choose x in [-{x:g}, {x:g}] and y in [-{y:g}, {y:g}] m."
            )

    def _check_robot_apart(self, name: str, fixed: Mapping[str, np.ndarray]) -> None:
        if not {"pose", name} <= fixed.keys():
            return
        prop, pose, position = self.goals[name].prop, fixed["pose"], fixed[name]
        gap = np.hypot(*np.maximum(np.abs(pose[:2] - position) - prop.size / 2, 0)) - self.robot.radius
        if gap < 0:
            raise ValueError(
                f"pose={pose.tolist()} and {name}={position.tolist()} overlap by {-gap:.3f} m: move them apart, "
                f"{self.robot.radius + prop.radius:.3f} m between the centres are always enough."
            )

    def _check_boxes_apart(self, one: str, other: str, fixed: Mapping[str, np.ndarray]) -> None:
        if not {one, other} <= fixed.keys():
            return
        nearest = (self.goals[one].prop.size + self.goals[other].prop.size) / 2
        if np.abs(fixed[one] - fixed[other]).max() < nearest:
            raise ValueError(
                f"{one}={fixed[one].tolist()} and {other}={fixed[other].tolist()} overlap: move them apart, "
                f"{nearest:.3f} m along x or y are enough."
            )

    def draw_start(
        self, random_state: np.random.RandomState, fixed: Mapping[str, np.ndarray] | None = None
    ) -> dict[str, np.ndarray]:
        """Draws where things are, uniformly among what is as far apart as it must be.

        Args:
            random_state: Source of what is drawn.
            fixed: What is not drawn, see :meth:`fix_start`.

        Returns:
            ``pose``, of the robot, [3], and under each name of ``goals`` its box's position [2].

        Raises:
            EpisodeInitializationError: if none is found in many draws.
        """
        fixed = fixed or {}
        ranges = {"pose": self._robot_range} | dict.fromkeys(self.goals, self._box_range)
        for _ in range(_MAX_DRAWS):
            start = {
                name: fixed[name][:2] if name in fixed else random_state.uniform(-widest, widest, size=2)
                for name, widest in ranges.items()
            }
            if self._apart(start, fixed):
                yaw = fixed["pose"][2] if "pose" in fixed else random_state.uniform(-np.pi, np.pi)
                return start | {"pose": np.array([*start["pose"], yaw])}
        raise composer.EpisodeInitializationError(
            f"No start with robot and goal {self.min_start_distance} to {self.max_start_distance} m apart, and goals "
            f"{self.min_box_distance} m from each other, in {_MAX_DRAWS} draws: use a larger place or other distances."
        )

    def _apart(self, start: Mapping[str, np.ndarray], fixed: Mapping[str, np.ndarray]) -> bool:
        for one, other in combinations(start, 2):
            nearest, farthest = self.min_box_distance, math.inf
            if one == "pose":
                nearest, farthest = self.min_start_distance, self.max_start_distance
            is_fixed = {one, other} <= fixed.keys()
            if not is_fixed and not nearest <= np.hypot(*(start[one] - start[other])) <= farthest:
                return False
        return True

    def before_step(self, physics: Any, action: np.ndarray, random_state: np.random.RandomState) -> None:
        """Sets the servos."""
        self.robot.apply_action(physics, action, random_state)
        speed, turn_rate = self.robot.velocities(action)
        self._energy = float(np.hypot(speed / self.robot.max_speed, turn_rate / self.robot.max_turn_rate))

    def get_reward(self, physics: Any) -> float:
        """Returns the success reward, minus the cost of the action."""
        del physics
        return self.success_reward * self._succeeded - self.energy_cost * self._energy

    def should_terminate_episode(self, physics: Any) -> bool:
        """Returns True on success."""
        del physics
        return self._succeeded

    def get_discount(self, physics: Any) -> float:
        """Returns 0 on success, which terminates; 1 otherwise, so that the time limit truncates."""
        del physics
        return 0.0 if self._succeeded else 1.0
