"""Navigate: find the box, drive up to it, and centre it in the image."""

from ..arenas.walled_room import WalledRoom
from ..props.goal_box import GoalBox
from ..robots.rover import Rover
from .goal import OVERSHOOT, Goal
from .single_goal import SingleGoalTask

_SUCCESS_DISTANCE = 0.16
GOAL_OFFSET = _SUCCESS_DISTANCE - OVERSHOOT
"""How far ahead of the robot the box is when an episode of the named environments succeeds, on average [m]."""


class Navigate(SingleGoalTask):
    """Reward 1 and the end when the robot is close to the box with the box ahead of it; a small cost of moving.

    Close: at most ``success_distance`` between the centres of robot and box. The default is the radius of the box's
    footprint (0.0566 m) plus the robot's (0.05 m) plus 1.1 steps of 0.05 m. Ahead: the box's centre is in front, and
    at most ``centring_tolerance`` beside the optical axis (Sahni et al., NeurIPS 2019, appendix).

    Args:
        robot: The robot.
        arena: The room; robot and box are attached to it.
        goal_box: The goal; starts call it ``box``.
        min_start_distance: Between robot and box at the start of an episode [m].
        success_distance: [m].
        centring_tolerance: [m].
        kwargs: Costs, rewards and timesteps, see :class:`GoalTask`.

    Raises:
        ValueError: if a length is not positive, or the room is too small for the start distance.
    """

    mission = "Find the red box"

    def __init__(
        self,
        robot: Rover,
        arena: WalledRoom,
        goal_box: GoalBox,
        *,
        min_start_distance: float = 1.0,
        success_distance: float = _SUCCESS_DISTANCE,
        centring_tolerance: float = 0.01,
        **kwargs: float,
    ) -> None:
        goal = Goal(goal_box, success_distance, centring_tolerance)
        super().__init__(robot, arena, "box", goal, min_start_distance=min_start_distance, **kwargs)
