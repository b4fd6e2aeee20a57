"""Simulated rooms in which a robot looks for its goal; knows no learning.

>>> import envs
>>> env = envs.make("navigate-2m", seed=0)
>>> env.reset()["pixels"].shape
torch.Size([64, 64, 3])
>>> env.close()

Importing it registers the Gymnasium ids of all named environments, e.g. ``halgan_rl/Navigate2m-v0``.
"""

from typing import Any

from envs import gl_backend  # First: it settles the OpenGL backend, which mujoco and dm_control read once.
from envs.environment import Environment
from envs.golden import fingerprint
from envs.gymnasium_env import GymnasiumEnv, gymnasium_id, register_named
from envs.names import NAMES, goal_offsets, named, pose_flags
from envs.navigate import navigate_2m, navigate_4m
from envs.near_goal import collect_failed, collect_near_goal
from envs.oracle import GoalRenderer
from envs.pebble import find_pebble
from envs.pick_and_place import pick_and_place_2m
from envs.torchrl_env import ComposerEnv

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
    "gl_backend",
    "goal_offsets",
    "gymnasium_id",
    "make",
    "named",
    "navigate_2m",
    "navigate_4m",
    "pick_and_place_2m",
    "pose_flags",
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
