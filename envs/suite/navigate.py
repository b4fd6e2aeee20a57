"""The named environments of the Navigate task: plain functions that put robot, room and task together."""

import numpy as np

from ..arenas.walled_room import WALLS, WalledRoom
from ..environment import Environment
from ..props.goal_box import GoalBox
from ..robots.rover import Rover
from ..tasks.navigate import Navigate


def navigate_4m(
    random_state: int | np.random.RandomState | None = None, time_limit: float = 20.0, reverse_speed: float = 0.0
) -> Environment:
    """Builds the paper's room (Sahni et al., NeurIPS 2019): 4 m, starts at least 1 m from the box, centred within 1 cm.

    Args:
        random_state: Seed or generator of the starts.
        time_limit: Seconds an episode; a step takes 0.1 s.
        reverse_speed: Of the robot at forward action -1 [m/s]; 0: it has no reverse gear.
    """
    # The robot, and what it must find.
    robot = Rover(reverse_speed=reverse_speed)
    goal_box = GoalBox()

    # A room to search.
    arena = WalledRoom(size=4.0)

    # A task that rewards success only.
    task = Navigate(robot, arena, goal_box, min_start_distance=1.0, centring_tolerance=0.01)

    return Environment(task, time_limit=time_limit, random_state=random_state)


def navigate_2m(
    random_state: int | np.random.RandomState | None = None, time_limit: float = 20.0, reverse_speed: float = 0.0
) -> Environment:
    """Builds half the room with half the start distance, 2 m and 0.5 m: learned in minutes.

    Args:
        random_state: Seed or generator of the starts.
        time_limit: Seconds an episode; a step takes 0.1 s.
        reverse_speed: Of the robot at forward action -1 [m/s]; 0: it has no reverse gear.
    """
    # The robot, and what it must find.
    robot = Rover(reverse_speed=reverse_speed)
    goal_box = GoalBox()

    # A room that most of a look takes in.
    arena = WalledRoom(size=2.0)

    # A task that rewards success only.
    task = Navigate(robot, arena, goal_box, min_start_distance=0.5, centring_tolerance=0.01)

    return Environment(task, time_limit=time_limit, random_state=random_state)


def camouflage_2m(
    random_state: int | np.random.RandomState | None = None, time_limit: float = 20.0, reverse_speed: float = 0.0
) -> Environment:
    """Builds the 2 m room with a box that has no colour of its own: checkered, in the darker colours of two walls.

    Args:
        random_state: Seed or generator of the starts.
        time_limit: Seconds an episode; a step takes 0.1 s.
        reverse_speed: Of the robot at forward action -1 [m/s]; 0: it has no reverse gear.
    """
    # The robot, and what it must find.
    robot = Rover(reverse_speed=reverse_speed)
    goal_box = GoalBox(checker=(WALLS["south"].dark, WALLS["west"].dark))

    # A room whose walls have these colours.
    arena = WalledRoom(size=2.0)

    # A task that rewards success only.
    task = Navigate(robot, arena, goal_box, min_start_distance=0.5, centring_tolerance=0.01)

    return Environment(task, time_limit=time_limit, random_state=random_state)
