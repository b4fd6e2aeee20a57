"""What a run must know of each named environment, as one frozen value; the only module that imports halgan_rl."""

import functools
from collections.abc import Callable

import numpy as np
from torchrl.envs import EnvBase

from halgan_rl.experiment.domain import Domain
from halgan_rl.poses import PlanarPoses

from .adapters.torchrl_env import action_spec, make
from .environment import Environment
from .oracle import GoalRenderer
from .rendering.fingerprint import fingerprint
from .suite.names import named


def domain(name: str) -> Domain:
    """Returns all that a run must know of a named environment, built once in a process.

    The first call compiles one environment, that of the goal renderer: flags, goal offsets, action spec and golden
    frame are read from it. With EGL that renderer belongs to the thread of the first call. The domain pickles; a child
    process that uses its goal renderer builds its own.

    Args:
        name: One of ``halgan_envs.NAMES``.

    Raises:
        ValueError: if the name is unknown.

    Examples:
        >>> navigate = domain("navigate-2m")
        >>> navigate.image_shape, navigate.poses.goal_offsets, navigate is domain("navigate-2m")
        ((64, 64, 3), (0.14,), True)
    """
    return _domain(name, named(name))


@functools.cache
def _domain(name: str, build: Callable[..., Environment]) -> Domain:
    renderer = _goal_renderer(name, build)
    task = renderer.environment.task
    return Domain(
        name=name,
        make=functools.partial(make, name),
        action_spec=action_spec(renderer.environment),
        image_shape=(*task.robot.image_size, 3),
        poses=PlanarPoses(flags=task.flags, goal_offsets=task.goal_offsets),
        fingerprint=fingerprint(name, renderer),
        goal_renderer=functools.partial(shared_goal_renderer, name),
        overview=overview,
    )


def shared_goal_renderer(name: str) -> GoalRenderer:
    """Returns the goal renderer that this process shares for a named environment; leave it open.

    Raises:
        ValueError: if the name is unknown.
    """
    return _goal_renderer(name, named(name))


@functools.cache
def _goal_renderer(name: str, build: Callable[..., Environment]) -> GoalRenderer:
    # Cached by the function as well: another function under the same name is another environment.
    del name
    return GoalRenderer(build(random_state=0))


def overview(env: EnvBase, height: int, width: int) -> np.ndarray:
    """Returns the room from outside, for people: uint8 ``[height, width, 3]``.

    Args:
        env: Made by the domain.
        height: [pixels].
        width: [pixels].
    """
    return env.render_overview(height, width)
