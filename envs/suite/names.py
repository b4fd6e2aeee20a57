"""The named environments."""

from collections.abc import Callable
from contextlib import closing

from ..environment import Environment
from .navigate import navigate_2m, navigate_4m
from .pebble import find_pebble
from .pick_and_place import pick_and_place_2m

NAMES: dict[str, Callable[..., Environment]] = {
    "navigate-2m": navigate_2m,
    "navigate-4m": navigate_4m,
    "pebble": find_pebble,
    "pick-and-place-2m": pick_and_place_2m,
}
"""Functions that take ``random_state`` and ``time_limit`` [s] and build an environment."""


def goal_offsets(name: str) -> tuple[float, ...]:
    """How far ahead of a goal pose the goal stands, on average [m]: for each setting of the pose's flags.

    >>> goal_offsets("navigate-2m")
    (0.14,)

    Raises:
        ValueError: if the name is unknown.
    """
    with closing(named(name)()) as environment:
        return environment.task.goal_offsets


def pose_flags(name: str) -> tuple[str, ...]:
    """The names of the entries of a pose after x, y and yaw, each 0 or 1.

    >>> pose_flags("pick-and-place-2m")
    ('held',)

    Raises:
        ValueError: if the name is unknown.
    """
    with closing(named(name)()) as environment:
        return environment.task.flags


def named(name: str) -> Callable[..., Environment]:
    """The function that builds a named environment.

    Raises:
        ValueError: if the name is unknown.
    """
    if name not in NAMES:
        raise ValueError(f"Unknown environment {name!r}: choose one of {', '.join(sorted(NAMES))}.")
    return NAMES[name]
