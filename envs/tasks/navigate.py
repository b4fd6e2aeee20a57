"""Navigate: find the box, drive up to it, and centre it in the image."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_control import composer

from envs.arenas.walled_room import WalledRoom
from envs.props.goal_box import GoalBox
from envs.robots.rover import Rover
from envs.tasks.fixed_start import read_start

_MAX_DRAWS = 10_000
_WALL_CLEARANCE = 0.02
"""Between the robot and a wall at the start of an episode [m]."""
_START = {"pose": ("x [m]", "y [m]", "yaw [rad]"), "box": ("x [m]", "y [m]")}
"""What of a start can be fixed, and what the numbers mean."""


class Navigate(composer.Task):
    """Reward 1 and the end when the robot stands close to the box with the box ahead of it; a small cost of moving.

    Close: at most ``success_distance`` between the centres of robot and box. The default is the radius of the box's
    footprint (0.0566 m) plus the robot's (0.05 m) plus 1.1 steps of 0.05 m. Ahead: the box's centre is in front, and
    at most ``centring_tolerance`` beside the optical axis (Sahni et al., NeurIPS 2019, appendix).

    Args:
        rover: The robot.
        arena: The room; robot and box are attached to it.
        goal_box: The goal.
        min_start_distance: Between robot and box at the start of an episode [m].
        success_distance: [m].
        centring_tolerance: [m].
        energy_cost: Subtracted from the reward for each unit of the Euclidean norm of speed and turn rate, in units of
            the robot's largest ones, each step.
        success_reward: Reward of the step that succeeds.
        control_timestep: Seconds a step.
        physics_timestep: Seconds a physics substep.

    Raises:
        ValueError: if a length is not positive, or the room is too small for the start distance.
    """

    def __init__(
        self,
        rover: Rover,
        arena: WalledRoom,
        goal_box: GoalBox,
        *,
        min_start_distance: float = 1.0,
        success_distance: float = 0.16,
        centring_tolerance: float = 0.01,
        energy_cost: float = 0.0025,
        success_reward: float = 1.0,
        control_timestep: float = 0.1,
        physics_timestep: float = 0.02,
    ) -> None:
        self.rover = rover
        self.arena = arena
        self.goal_box = goal_box
        self.min_start_distance = min_start_distance
        self.success_distance = success_distance
        self.centring_tolerance = centring_tolerance
        self.energy_cost = energy_cost
        self.success_reward = success_reward
        self._check_lengths()
        self._check_room()
        self._attach()
        self.set_timesteps(control_timestep, physics_timestep)
        self._fixed: dict[str, np.ndarray] = {}
        self._succeeded = False
        self._energy = 0.0

    def _attach(self) -> None:
        self.arena.attach(self.rover)
        self.arena.attach_mocap(self.goal_box)
        for observable in self.rover.observables.as_dict(fully_qualified=False).values():
            observable.enabled = True

    def _check_lengths(self) -> None:
        nearest = self.rover.radius + self.goal_box.size / 2
        if not self.success_distance > nearest:
            raise ValueError(
                f"success_distance={self.success_distance} m cannot be reached: robot and box touch at "
                f"{nearest:.3f} m; use a larger one."
            )
        if not self.centring_tolerance > 0:
            raise ValueError(f"centring_tolerance must be positive; got {self.centring_tolerance} m.")
        if not self.min_start_distance > self.success_distance:
            raise ValueError(
                f"min_start_distance={self.min_start_distance} m must exceed "
                f"success_distance={self.success_distance} m, or episodes start solved."
            )

    def _check_room(self) -> None:
        farthest = np.sqrt(2) * (max(self._robot_range, 0) + max(self._box_range, 0))
        if min(self._robot_range, self._box_range) <= 0 or self.min_start_distance > 0.75 * farthest:
            raise ValueError(
                f"A room of {self.arena.size} m is too small for min_start_distance={self.min_start_distance} m: "
                "use a larger room or a smaller distance."
            )

    @property
    def _robot_range(self) -> float:
        # Largest |x| and |y| of the robot at the start.
        return self.arena.size / 2 - self.rover.radius - _WALL_CLEARANCE

    @property
    def _box_range(self) -> float:
        # Far enough from the walls that the robot can stand before any side of it.
        return self.arena.size / 2 - self.success_distance - self.rover.radius

    @property
    def root_entity(self) -> WalledRoom:
        """The arena."""
        return self.arena

    def action_spec(self, physics: Any) -> Any:
        """Forward speed and turn rate in [-1, 1]."""
        del physics
        return self.rover.action_spec

    def initialize_episode(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Places robot and box where :meth:`fix_start` says, else at random."""
        pose, position = self.draw_start(random_state, **self._fixed)
        self.rover.set_pose(physics, pose)
        self.goal_box.set_position(physics, position)
        self._succeeded = False
        self._energy = 0.0

    def fix_start(self, start: Mapping[str, Any]) -> None:
        """Fixes where episodes start, until it is called again; what is not given is drawn.

        Args:
            start: Any of ``pose``, the robot's x [m], y [m], yaw [rad], and ``box``, its x [m], y [m]. If both are
                given they may be closer to each other than ``min_start_distance``.

        Raises:
            ValueError: if a name is unknown, numbers are missing or not finite, one of the two is not in the room, or
                they overlap. What was fixed before then stays fixed.
        """
        fixed = read_start(start, _START)
        self._check_in_room("pose", fixed, self.rover.radius)
        self._check_in_room("box", fixed, self.goal_box.size / 2)
        self._check_apart(fixed)
        self._fixed = fixed

    def _check_in_room(self, name: str, fixed: Mapping[str, np.ndarray], extent: float) -> None:
        limit = self.arena.size / 2 - extent
        if name in fixed and np.abs(fixed[name][:2]).max() > limit:
            raise ValueError(
                f"{name}={fixed[name].tolist()} is not inside the room of {self.arena.size} m: "
                f"choose x and y in [-{limit:g}, {limit:g}] m."
            )

    def _check_apart(self, fixed: Mapping[str, np.ndarray]) -> None:
        if len(fixed) < len(_START):
            return
        pose, box = fixed["pose"], fixed["box"]
        gap = np.hypot(*np.maximum(np.abs(pose[:2] - box) - self.goal_box.size / 2, 0)) - self.rover.radius
        if gap < 0:
            raise ValueError(
                f"pose={pose.tolist()} and box={box.tolist()} overlap by {-gap:.3f} m: move them apart, "
                f"{self.rover.radius + self.goal_box.radius:.3f} m between the centres are always enough."
            )

    def draw_start(
        self, random_state: np.random.RandomState, pose: np.ndarray | None = None, box: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """A robot pose [3] and a box position [2], uniform among those far enough apart.

        Args:
            random_state: Source of what is drawn.
            pose: Fixes the robot's pose [3].
            box: Fixes the box's position [2].

        Raises:
            EpisodeInitializationError: if none is found in many draws.
        """
        if pose is not None and box is not None:
            return pose, box
        for _ in range(_MAX_DRAWS):
            robot = random_state.uniform(-self._robot_range, self._robot_range, size=2) if pose is None else pose[:2]
            position = random_state.uniform(-self._box_range, self._box_range, size=2) if box is None else box
            if np.hypot(*(robot - position)) >= self.min_start_distance:
                yaw = random_state.uniform(-np.pi, np.pi) if pose is None else pose[2]
                return np.array([*robot, yaw]), position
        raise composer.EpisodeInitializationError(
            f"No start with robot and box {self.min_start_distance} m apart in {_MAX_DRAWS} draws: "
            "use a larger room or a smaller min_start_distance."
        )

    def before_step(self, physics: Any, action: np.ndarray, random_state: np.random.RandomState) -> None:
        """Sets the servos."""
        self.rover.apply_action(physics, action, random_state)
        speed, turn_rate = self.rover.velocities(action)
        self._energy = float(np.hypot(speed / self.rover.max_speed, turn_rate / self.rover.max_turn_rate))

    def after_step(self, physics: Any, random_state: np.random.RandomState) -> None:
        """Notes whether the goal is reached."""
        del random_state
        self._succeeded = self.is_success(self.rover.pose(physics), self.goal_box.position(physics))

    def is_success(self, pose: np.ndarray, box_position: np.ndarray) -> bool:
        """Whether a robot at pose [3] has reached a box at position [2]."""
        ahead, left = box_in_robot_frame(pose, box_position)
        return bool(
            np.hypot(ahead, left) <= self.success_distance and ahead > 0 and abs(left) <= self.centring_tolerance
        )

    def get_reward(self, physics: Any) -> float:
        """The success reward, minus the cost of the action."""
        del physics
        return self.success_reward * self._succeeded - self.energy_cost * self._energy

    def should_terminate_episode(self, physics: Any) -> bool:
        """True on success."""
        del physics
        return self._succeeded

    def get_discount(self, physics: Any) -> float:
        """0 on success, which terminates; 1 otherwise, so that the time limit truncates."""
        del physics
        return 0.0 if self._succeeded else 1.0


def box_in_robot_frame(pose: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    """How far a position [2] is ahead and to the left of a pose [3], both in metres.

    >>> ahead, left = box_in_robot_frame(np.array([1.0, 1.0, np.pi / 2]), np.array([1.0, 3.0]))
    >>> round(ahead, 6), round(abs(left), 6)
    (2.0, 0.0)
    """
    dx, dy = position[0] - pose[0], position[1] - pose[1]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return float(cos * dx + sin * dy), float(-sin * dx + cos * dy)
