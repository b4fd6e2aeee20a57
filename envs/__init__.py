"""Simulated rooms in which a robot looks for its goal; knows no learning.

>>> import halgan_envs
>>> env = halgan_envs.make("navigate-2m", seed=0)
>>> env.reset()["pixels"].shape
torch.Size([64, 64, 3])
>>> env.close()

Importing it registers the Gymnasium ids of all named environments, e.g. ``halgan_rl/Navigate2m-v0``.
"""

from typing import Any

from . import rendering  # First: it settles the OpenGL backend, which mujoco and dm_control read once.
from .adapters.gymnasium_env import GymnasiumEnv, gymnasium_id, register_named
from .adapters.torchrl_env import ComposerEnv
from .environment import Environment
from .near_goal import collect_failed, collect_near_goal
from .oracle import GoalRenderer
from .rendering.fingerprint import fingerprint
from .suite.names import NAMES, goal_offsets, named, pose_flags
from .suite.navigate import navigate_2m, navigate_4m
from .suite.pebble import find_pebble
from .suite.pick_and_place import pick_and_place_2m

__all__ = [
    "NAMES",
    "ComposerEnv",
    "Environment",
    "GoalRenderer",
    "GymnasiumEnv",
    "collect_failed",
    "collect_near_goal",
    "find_pebble",
    "fingerprint",
    "goal_offsets",
    "gymnasium_id",
    "make",
    "named",
    "navigate_2m",
    "navigate_4m",
    "pick_and_place_2m",
    "pose_flags",
    "rendering",
]

register_named()


def make(name: str, *, seed: int | None = None, **kwargs: Any) -> ComposerEnv:
    """Makes a named environment with its TorchRL face.

    Args:
        name: One of ``NAMES``.
        seed: Of the starts; equal seeds give equal episodes.
        kwargs: Further arguments of the environment's function, e.g. ``time_limit`` [s].

    Raises:
        ValueError: if the name is unknown.
    """
    return ComposerEnv(named(name)(random_state=seed, **kwargs))
