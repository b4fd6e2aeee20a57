"""Fingerprint of an environment's images: MuJoCo releases and OpenGL drivers change pixels."""

import hashlib
from typing import Protocol

import mujoco
import numpy as np

from .persistent_camera import BACKEND

_POSE = (-0.3, -0.2, 0.4)
_GOAL_POSITION = (0.2, 0.1)


class Renderer(Protocol):
    """Renders a robot's camera from any pose, such as :class:`halgan_envs.GoalRenderer`."""

    @property
    def flags(self) -> tuple[str, ...]:
        """Names of the entries of a pose after x, y and yaw."""

    def render(self, pose: np.ndarray, goal_position: np.ndarray | None = None) -> np.ndarray:
        """Returns the image uint8 ``[H, W, 3]`` from a pose ``[P]``, the goal at x, y [m]."""


def fingerprint(name: str, renderer: Renderer) -> dict[str, str]:
    """Returns what the images of an environment depend on: stamped into weights and data, and compared before use.

    Args:
        name: Of the environment.
        renderer: Renders its images.

    Returns:
        ``environment``: the name; ``mujoco``: its version; ``gl``: the OpenGL backend; ``golden_frame``: the SHA-256 of
        an image from a fixed pose, its flags 0.
    """
    frame = renderer.render(np.array([*_POSE, *(0.0 for _ in renderer.flags)]), np.array(_GOAL_POSITION))
    return {
        "environment": name,
        "mujoco": mujoco.__version__,
        "gl": BACKEND,
        "golden_frame": hashlib.sha256(frame.tobytes()).hexdigest(),
    }
