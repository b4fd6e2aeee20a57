"""GoalRenderer: the simulator as a hallucinator, the upper bound for generative models."""

from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from .arenas.arena import WALL_GROUP
from .environment import Environment
from .suite.names import named


class GoalRenderer:
    """Adds the goal to images, as if it had been where hindsight puts it.

    Its call is that of a hallucinator. Only the pixels of the goal change; they are rendered in a physics of its own.
    The flags of each image's pose select the goal. Walls hide no goal: most random walks end at a wall, and hindsight
    then puts the goal into it. As every OpenGL context this one belongs to the thread that makes it (with EGL).

    Args:
        environment: Name of an environment, or one (then owned and closed by this renderer).

    Raises:
        ValueError: if the name is unknown.
    """

    def __init__(self, environment: str | Environment) -> None:
        self.environment = environment if isinstance(environment, Environment) else named(environment)(random_state=0)
        self.environment.reset()  # Compiles the model for good.
        self._task, self._physics = self.environment.task, self.environment.physics

    @property
    def flags(self) -> tuple[str, ...]:
        """Names of the entries of a pose after x, y and yaw."""
        return self._task.flags

    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Renders the goal into every image.

        Args:
            pixels: uint8 [N, F, H, W, 3]; not modified.
            pose: float [N, F, P]: x [m], y [m], yaw [rad], flags of each image.
            goal_pose: float [N, 1, P]: the pose from which the goal is reached; its flags are ignored.

        Returns:
            uint8, of the shape and on the device of ``pixels``.

        Raises:
            ValueError: if a pose is not finite or lacks entries.
            RuntimeError: after :meth:`close`.
        """
        self._check_open()
        _check_size(pose.shape[-1], self._task.flags)
        _check_size(goal_pose.shape[-1])
        leading = pixels.shape[:-3]
        poses, goals = (p.expand(*leading, -1).flatten(0, -2).double().cpu().numpy() for p in (pose, goal_pose))
        images = pixels.reshape(-1, *pixels.shape[-3:]).cpu().numpy().copy()
        for image, at, goal in zip(images, poses, goals, strict=True):
            self._add_goal(image, at, self.goal_position(at, goal))
        return torch.from_numpy(images).reshape(pixels.shape).to(pixels.device)

    def _add_goal(self, image: np.ndarray, pose: np.ndarray, goal_position: np.ndarray) -> None:
        visible_groups = self._task.robot.camera.options.geomgroup
        visible_groups[WALL_GROUP] = False
        try:
            without, with_goal = self.render(pose), self.render(pose, goal_position)
        finally:
            visible_groups[WALL_GROUP] = True
        np.copyto(image, with_goal, where=(with_goal != without).any(-1, keepdims=True))

    def goal_position(self, pose: np.ndarray, goal_pose: np.ndarray) -> np.ndarray:
        """Returns where the goal is, x, y [m], that a robot pursues at pose [P] and reaches at goal_pose [P]."""
        x, y, yaw = goal_pose[:3]
        offset = self._task.goal(pose).offset
        return np.array([x + offset * np.cos(yaw), y + offset * np.sin(yaw)])

    def render(self, pose: np.ndarray, goal_position: np.ndarray | None = None) -> np.ndarray:
        """Renders the robot's camera.

        Args:
            pose: Of the robot, [P]: x [m], y [m], yaw [rad], flags.
            goal_position: Of the goal that the flags select, x, y [m]; None leaves it out.

        Returns:
            uint8 [H, W, 3].

        Raises:
            ValueError: if the pose is not finite or lacks entries.
            RuntimeError: after :meth:`close`.
        """
        self._check_open()
        _check_size(len(pose), self._task.flags)
        if not np.isfinite(pose).all():
            raise ValueError(f"Cannot render from pose {np.asarray(pose).tolist()}: its entries must be finite.")
        self._task.show(self._physics, pose, goal_position)
        mujoco.mj_kinematics(self._physics.model.ptr, self._physics.data.ptr)
        mujoco.mj_camlight(self._physics.model.ptr, self._physics.data.ptr)
        return self._task.robot.camera.render(self._physics)

    def render_without_goal(self, pose: np.ndarray) -> np.ndarray:
        """Renders the robot's camera at pose [P] in a room without goals."""
        return self.render(pose)

    def _check_open(self) -> None:
        if self.environment.is_closed:
            raise RuntimeError("This goal renderer is closed: make a new halgan_envs.GoalRenderer to render again.")

    def close(self) -> None:
        """Frees camera and physics; harmless when repeated."""
        self.environment.close()


def _check_size(size: int, flags: Sequence[str] = ()) -> None:
    entries = ("x", "y", "yaw", *flags)
    if size < len(entries):
        raise ValueError(f"Poses start with {', '.join(entries)}; this one has size {size}.")
