"""Simulated rooms in which a robot must find a goal by sight; nothing here learns.

>>> import halgan_envs
>>> env = halgan_envs.make("navigate-2m", seed=0)
>>> env.reset()["pixels"].shape
torch.Size([64, 64, 3])
>>> env.close()

The import registers the Gymnasium ids of all named environments, e.g. ``halgan_rl/Navigate2m-v0``.
"""

if __name__ == "envs":
    raise ImportError("The folder envs is installed as halgan_envs: import halgan_envs.")

from . import rendering  # First: it settles the OpenGL backend, which mujoco and dm_control read once.
from .adapters.gymnasium_env import GymnasiumEnv, gymnasium_id, register_named
from .adapters.torchrl_env import ComposerEnv, make
from .domains import domain
from .environment import Environment
from .frames import failed_frames, near_goal_frames, with_truth, without_goal
from .near_goal import collect_failed, collect_near_goal
from .oracle import GoalRenderer
from .suite.names import NAMES, named
from .suite.navigate import camouflage_2m, navigate_2m, navigate_4m
from .suite.pebble import find_pebble
from .suite.pick_and_place import pick_and_place_2m

__all__ = [
    "NAMES",
    "ComposerEnv",
    "Environment",
    "GoalRenderer",
    "GymnasiumEnv",
    "camouflage_2m",
    "collect_failed",
    "collect_near_goal",
    "domain",
    "failed_frames",
    "find_pebble",
    "gymnasium_id",
    "make",
    "named",
    "navigate_2m",
    "navigate_4m",
    "near_goal_frames",
    "pick_and_place_2m",
    "rendering",
    "with_truth",
    "without_goal",
]

register_named()
