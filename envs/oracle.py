"""GoalRenderer: the simulator as a hallucinator, whose pictures no generative model can beat."""

import mujoco
import numpy as np
import torch
from torch import Tensor

from envs.arenas.walled_room import WALL_GROUP
from envs.environment import Environment
from envs.names import named

GOAL_OFFSET = 0.14
"""How far ahead of the robot the box stands when an episode succeeds, on average over scripted rollouts [m]."""

OUT_OF_SIGHT = (0.0, 100.0)
"""Position x, y [m] where the box is put when it must not be seen."""


class GoalRenderer:
    """Adds the box to images, had it been where hindsight puts it.

    A hallucinator by its call signature: it keeps the pixels that it is given but for those of the box, which it
    renders in a physics of its own. Walls hide no box: most random walks end at a wall, and hindsight then puts the box
    into it. Like every OpenGL context this one belongs to the thread that renders first (with EGL).

    Args:
        environment: Name of an environment, or one (then owned and closed by this renderer).
        goal_offset: The box stands this far ahead of the goal pose [m].

    Raises:
        ValueError: if the name is unknown.
    """

    def __init__(self, environment: str | Environment, *, goal_offset: float = GOAL_OFFSET) -> None:
        self._environment = _build(environment)
        self._goal_offset = goal_offset
        self._environment.reset()  # Compiles the model for good.
        self._physics = self._environment.physics

    def __call__(self, pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
        """Renders the goal into every image.

        Args:
            pixels: uint8 [N, F, H, W, 3]; not modified.
            pose: float [N, F, P]: x [m], y [m], yaw [rad], ... of each image.
            goal_pose: float [N, 1, P]: the pose from which the goal is reached.

        Returns:
            uint8, of the shape and on the device of ``pixels``.

        Raises:
            ValueError: if a pose is not finite or has fewer than three entries.
        """
        if min(pose.shape[-1], goal_pose.shape[-1]) < 3:
            raise ValueError(f"Poses start with x, y, yaw; these have sizes {pose.shape[-1]}, {goal_pose.shape[-1]}.")
        leading = pixels.shape[:-3]
        poses = pose[..., :3].expand(*leading, 3).reshape(-1, 3).double().cpu().numpy()
        goals = goal_pose[..., :3].expand(*leading, 3).reshape(-1, 3).double().cpu().numpy()
        images = pixels.reshape(-1, *pixels.shape[-3:]).cpu().numpy().copy()
        for image, at, goal in zip(images, poses, goals, strict=True):
            self._add_box(image, at, self.box_position(goal))
        return torch.from_numpy(images).reshape(pixels.shape).to(pixels.device)

    def _add_box(self, image: np.ndarray, pose: np.ndarray, box_position: np.ndarray) -> None:
        visible_groups = self._environment.task.rover.camera.options.geomgroup
        visible_groups[WALL_GROUP] = False
        without, with_box = self.render(pose), self.render(pose, box_position)
        visible_groups[WALL_GROUP] = True
        np.copyto(image, with_box, where=(with_box != without).any(-1, keepdims=True))

    def box_position(self, goal_pose: np.ndarray) -> np.ndarray:
        """Where the box stands, x, y [m], for a robot that has reached it at goal_pose [3]."""
        x, y, yaw = goal_pose[:3]
        return np.array([x + self._goal_offset * np.cos(yaw), y + self._goal_offset * np.sin(yaw)])

    def render(self, pose: np.ndarray, box_position: np.ndarray | None = None) -> np.ndarray:
        """Renders the robot's camera.

        Args:
            pose: Of the robot: x [m], y [m], yaw [rad].
            box_position: x, y [m]; None leaves the box out.

        Returns:
            uint8 [H, W, 3].

        Raises:
            ValueError: if the pose is not finite.
        """
        if not np.isfinite(pose[:3]).all():
            raise ValueError(f"Cannot render from pose {np.asarray(pose).tolist()}: its entries must be finite.")
        task, physics = self._environment.task, self._physics
        task.rover.set_pose(physics, pose[:3])
        task.goal_box.set_position(physics, OUT_OF_SIGHT if box_position is None else box_position)
        mujoco.mj_kinematics(physics.model.ptr, physics.data.ptr)
        mujoco.mj_camlight(physics.model.ptr, physics.data.ptr)
        return task.rover.camera.render(physics)

    def render_without_goal(self, pose: np.ndarray) -> np.ndarray:
        """Renders the robot's camera at pose [3] in a room without box."""
        return self.render(pose)

    def close(self) -> None:
        """Frees camera and physics."""
        self._environment.close()


def _build(environment: str | Environment) -> Environment:
    return environment if isinstance(environment, Environment) else named(environment)(random_state=0)
