"""The named environments."""

from collections.abc import Callable

from ..environment import Environment
from .navigate import camouflage_2m, navigate_2m, navigate_4m
from .pebble import find_pebble
from .pick_and_place import pick_and_place_2m

NAMES: dict[str, Callable[..., Environment]] = {
    "camouflage-2m": camouflage_2m,
    "navigate-2m": navigate_2m,
    "navigate-4m": navigate_4m,
    "pebble": find_pebble,
    "pick-and-place-2m": pick_and_place_2m,
}
"""Functions that take ``random_state`` and ``time_limit`` [s] and build an environment."""


def named(name: str) -> Callable[..., Environment]:
    """Returns the function that builds a named environment.

    Raises:
        ValueError: if the name is unknown.
    """
    if name not in NAMES:
        raise ValueError(f"Unknown environment {name!r}: choose one of {', '.join(sorted(NAMES))}.")
    return NAMES[name]
