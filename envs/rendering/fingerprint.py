"""Fingerprint of an environment's images: MuJoCo releases and OpenGL drivers change pixels."""

import hashlib

import mujoco
import numpy as np

from ..oracle import GoalRenderer
from ..suite.names import named
from .persistent_camera import BACKEND

_POSE = np.array([-0.3, -0.2, 0.4])
_GOAL_POSITION = np.array([0.2, 0.1])


def fingerprint(name: str) -> dict[str, str]:
    """What the images of an environment depend on: to stamp into weights and data, and to compare before using them.

    Args:
        name: One of ``halgan_envs.NAMES``.

    Returns:
        ``environment``: the name; ``mujoco``: its version; ``gl``: the OpenGL backend; ``golden_frame``: the SHA-256 of
        an image from a fixed pose, its flags 0.

    Raises:
        ValueError: if the name is unknown.
    """
    environment = named(name)(random_state=0)
    renderer = GoalRenderer(environment)
    frame = renderer.render(np.array([*_POSE, *(0.0 for _ in environment.task.flags)]), _GOAL_POSITION)
    renderer.close()
    return {
        "environment": name,
        "mujoco": mujoco.__version__,
        "gl": BACKEND,
        "golden_frame": hashlib.sha256(frame.tobytes()).hexdigest(),
    }
