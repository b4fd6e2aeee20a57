"""FindPebble: find a pebble on the road, drive up to it, and centre it in the image."""

from ..arenas.road import Road
from ..props.pebble import Pebble
from ..robots.turtlebot import TurtleBot
from .goal import Goal
from .single_goal import SingleGoalTask


class FindPebble(SingleGoalTask):
    """Reward 1 and the end when the pebble lies close ahead of the robot and in the middle of its image.

    Close: the pebble is between ``nearest`` and ``success_distance`` from the robot's centre, which is one step of
    driving, and near the lower edge of the image. In the middle: at most ``centring_tolerance`` beside the optical
    axis, which turns of 12 degrees always achieve there. The task is that of Sahni et al. (NeurIPS 2019); the numbers
    are chosen for this robot and its steps.

    Args:
        robot: The robot.
        arena: The road; robot and pebble are attached to it.
        pebble: The goal; starts call it ``pebble``.
        min_start_distance: At least so far are robot and pebble apart at the start of an episode [m].
        max_start_distance: At most so far [m]; by default from where a robot turned to the pebble sees it well.
        success_distance: [m].
        nearest: Closer than this the pebble is out of the image, or about to be [m].
        centring_tolerance: [m].
        energy_cost: See :class:`GoalTask`.
        control_timestep: Seconds a step.
        physics_timestep: Seconds a physics substep.

    Raises:
        ValueError: if a length is not positive, start distances are out of order, or the road is too small for them.
    """

    mission = "Drive up to the pebble"

    def __init__(
        self,
        robot: TurtleBot,
        arena: Road,
        pebble: Pebble,
        *,
        min_start_distance: float = 0.6,
        max_start_distance: float = 1.5,
        success_distance: float = 0.45,
        nearest: float = 0.34,
        centring_tolerance: float = 0.05,
        energy_cost: float = 0.0,
        control_timestep: float = 0.25,
        physics_timestep: float = 0.01,
    ) -> None:
        if not 0 <= nearest < success_distance:
            raise ValueError(
                f"nearest={nearest} m must lie between 0 and success_distance={success_distance} m, "
                "or the pebble is never reached."
            )
        goal = Goal(
            pebble,
            success_distance,
            centring_tolerance,
            nearest=nearest,
            overshoot=(success_distance - nearest) / 2,
        )
        super().__init__(
            robot,
            arena,
            "pebble",
            goal,
            min_start_distance=min_start_distance,
            max_start_distance=max_start_distance,
            energy_cost=energy_cost,
            control_timestep=control_timestep,
            physics_timestep=physics_timestep,
        )
