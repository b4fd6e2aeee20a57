"""The named environment of the pebble task: a plain function that puts robot, road and task together."""

import numpy as np

from ..arenas.road import Road
from ..environment import Environment
from ..props.pebble import Pebble
from ..robots.turtlebot import TurtleBot, motions_for
from ..tasks.pebble import FindPebble


def find_pebble(
    random_state: int | np.random.RandomState | None = None, time_limit: float = 25.0, reverse_speed: float = 0.0
) -> Environment:
    """Builds the paper's TurtleBot task (Sahni et al., NeurIPS 2019): find the pebble on a road; four discrete actions.

    Episodes start 0.6 m to 1.5 m from the pebble, at any angle: farther off a camera of 64 x 64 pixels hardly shows it.

    Args:
        random_state: Seed or generator of the starts.
        time_limit: Seconds an episode; a step takes 0.25 s.
        reverse_speed: Of the robot's fourth action, backward [m/s]; 0: it has no reverse gear, the fourth action drives
            fast.

    Raises:
        ValueError: if the reverse speed is negative or more than the robot reaches.
    """
    # The robot, and what it must find.
    robot = TurtleBot(motions=motions_for(reverse_speed))
    pebble = Pebble()

    # A road full of other things to look at.
    arena = Road()

    # A task that rewards success only.
    task = FindPebble(robot, arena, pebble)

    return Environment(task, time_limit=time_limit, random_state=random_state)
