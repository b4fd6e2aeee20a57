"""Goal: a prop, and when a robot has reached it."""

from dataclasses import dataclass

import numpy as np

from ..props.mocap_prop import MocapProp

OVERSHOOT = 0.02
"""How much closer than the goal's distance a robot comes in the step that reaches it, on average over scripted
rollouts [m]."""


@dataclass(frozen=True)
class Goal:
    """A prop that is reached when the robot is close to it and has it straight ahead.

    Attributes:
        prop: What is to be reached; has a ``size`` and a ``radius`` [m].
        distance: Close is at most this far, between the centres of robot and prop [m].
        tolerance: Straight ahead is at most this far beside the optical axis [m].
        nearest: Closer than this the robot's camera loses it, and it is not reached [m].
        overshoot: How much closer than ``distance`` a robot is when it has reached it, on average over scripted
            rollouts [m].
    """

    prop: MocapProp
    distance: float
    tolerance: float
    nearest: float = 0.0
    overshoot: float = OVERSHOOT

    @property
    def offset(self) -> float:
        """How far ahead of the robot the prop is when it is reached, on average over scripted rollouts [m]."""
        return self.distance - self.overshoot

    def is_reached(self, pose: np.ndarray, position: np.ndarray) -> bool:
        """Returns whether a robot at pose [P] has reached the prop at position [2]."""
        ahead, left = in_robot_frame(pose, position)
        close = self.nearest <= np.hypot(ahead, left) <= self.distance
        return bool(close and ahead > 0 and abs(left) <= self.tolerance)

    def check(self, robot_radius: float, *, distance_name: str, tolerance_name: str) -> None:
        """Refuses lengths with which the goal is never reached.

        Args:
            robot_radius: [m].
            distance_name: What the caller calls the distance.
            tolerance_name: What the caller calls the tolerance.

        Raises:
            ValueError: if the robot cannot come so close, or the tolerance is not positive.
        """
        nearest = robot_radius + self.prop.size / 2
        if not self.distance > nearest:
            raise ValueError(
                f"{distance_name}={self.distance} m cannot be reached: robot and goal touch at {nearest:.3f} m; "
                "use a larger one."
            )
        if not self.tolerance > 0:
            raise ValueError(f"{tolerance_name} must be positive; got {self.tolerance} m.")


def in_robot_frame(pose: np.ndarray, position: np.ndarray) -> tuple[float, float]:
    """Returns how far a position [2] is ahead and to the left of a pose [P], both in metres.

    >>> ahead, left = in_robot_frame(np.array([1.0, 1.0, np.pi / 2]), np.array([1.0, 3.0]))
    >>> round(ahead, 6), round(abs(left), 6)
    (2.0, 0.0)
    """
    dx, dy = position[0] - pose[0], position[1] - pose[1]
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return float(cos * dx + sin * dy), float(-sin * dx + cos * dy)
