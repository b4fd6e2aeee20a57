"""The named environment of the PickAndPlace task: a plain function that puts robot, room and task together."""

import numpy as np

from ..arenas.walled_room import WalledRoom
from ..environment import Environment
from ..props.goal_box import GREEN, RED, GoalBox
from ..robots.rover import Rover
from ..tasks.pick_and_place import PickAndPlace


def pick_and_place_2m(
    random_state: int | np.random.RandomState | None = None, time_limit: float = 40.0, reverse_speed: float = 0.0
) -> Environment:
    """Builds the paper's "successive navigation" (Sahni et al., NeurIPS 2019): 2 m, a red box goes to a green one.

    Args:
        random_state: Seed or generator of the starts.
        time_limit: Seconds an episode; a step takes 0.1 s.
        reverse_speed: Of the robot at forward action -1 [m/s]; 0: it has no reverse gear.
    """
    # The robot, what it must fetch, and where to.
    robot = Rover(reverse_speed=reverse_speed)
    red_box = GoalBox(size=0.04, rgba=RED, name="red_box")
    green_box = GoalBox(size=0.08, rgba=GREEN, name="green_box")

    # A room that most of a look takes in.
    arena = WalledRoom(size=2.0)

    # A task that rewards the delivery only.
    task = PickAndPlace(robot, arena, red_box, green_box, min_start_distance=0.5, min_box_distance=0.4)

    return Environment(task, time_limit=time_limit, random_state=random_state)
