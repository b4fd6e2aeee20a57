"""A foreign environment without simulator: a robot on a plane must walk up to a pillar that it sees.

Images have any size and channels, single or stacked: what a user may bring. Actions are a step ahead and a turn.
"""

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from halgan_rl.experiment.domain import Domain
from halgan_rl.poses import PlanarPoses, wrap_angle

OFFSET = 0.3
"""The pillar is this far ahead of the robot that has reached it [m]."""
HALF_VIEW = 0.6
"""The camera sees so far to either side [rad]."""
POSES = PlanarPoses(goal_offsets=(OFFSET,))


def draw(pose: Tensor, pillar: Tensor | None, shape: tuple[int, int, int]) -> Tensor:
    """Return what is seen from a pose [3]: uint8 [H, W, c], a pillar at [2] or none on a wall whose shade turns."""
    height, width, channels = shape
    bearing = HALF_VIEW * (1 - 2 * (torch.arange(width) + 0.5) / width)  # [W], left is positive
    wall = 90 + 30 * (3 * (pose[2] + bearing)).sin()
    floor = 40 + 20 * torch.linspace(0, 1, height)
    image = torch.where(torch.arange(height)[:, None] < height // 2, wall[None], floor[:, None])
    image = image[..., None].expand(-1, -1, channels).clone()
    if pillar is not None:
        x, y = (pillar - pose[:2]).tolist()
        distance = max(math.hypot(x, y), 0.05)
        at = float(wrap_angle(torch.tensor(math.atan2(y, x) - float(pose[2]))))
        columns = (bearing - at).abs() < math.atan(0.06 / distance)
        rows = (torch.arange(height) - height / 2).abs() < 0.12 * height / distance
        colour = torch.tensor([230.0, 30.0, 60.0][:channels]) if channels == 3 else torch.tensor([250.0])
        image[rows[:, None] & columns] = colour
    return image.round().to(torch.uint8)


class Room(EnvBase):
    """The environment. ``image_shape`` is that of an observation, with ``frame_stack`` frames along its channels."""

    def __init__(
        self, image_shape: tuple[int, int, int] = (64, 64, 3), frame_stack: int = 1, seed: int | None = None
    ) -> None:
        super().__init__()
        self.frame_shape = (*image_shape[:2], image_shape[2] // frame_stack)
        self.frames: deque[Tensor] = deque(maxlen=frame_stack)
        self.observation_spec = Composite(
            pixels=Bounded(0, 255, shape=image_shape, dtype=torch.uint8), pose=Unbounded((3,))
        )
        self.action_spec = Bounded(-1.0, 1.0, (2,))
        self.reward_spec = Unbounded((1,))
        flag = Binary(1, shape=(1,), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone())
        self.set_seed(seed or 0)

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        self.pose = torch.tensor([0.0, 0.0, float(self._uniform(-math.pi, math.pi))])
        angle, distance = self._uniform(-math.pi, math.pi), self._uniform(0.8, 1.5)
        self.pillar = distance * torch.stack([angle.cos(), angle.sin()])
        self.time = 0
        self.frames.extend([self._frame()] * (self.frames.maxlen or 1))
        return TensorDict(self._observe())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        ahead, turn = tensordict["action"].unbind()
        x, y, yaw = self.pose
        step = 0.04 * (1 + ahead)
        self.pose = torch.stack([x + step * yaw.cos(), y + step * yaw.sin(), wrap_angle(yaw + 0.2 * turn)])
        self.time += 1
        self.frames.append(self._frame())
        reached = (POSES.goal_position(self.pose, self.pose) - self.pillar).norm() < 0.1
        terminated, truncated = reached.reshape(1), torch.tensor([self.time >= 40]) & ~reached
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**self._observe(), "reward": terminated.float(), **flags})

    def _frame(self) -> Tensor:
        return draw(self.pose, self.pillar, self.frame_shape)

    def _observe(self) -> dict[str, Tensor]:
        return {"pixels": torch.cat(tuple(self.frames), -1), "pose": self.pose.clone()}

    def _uniform(self, low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand((), generator=self.rng)


def paint(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """The exact hallucinator for single frames: draws the pillar where hindsight puts it."""
    pillars = POSES.goal_position(pose, goal_pose.expand_as(pose)).flatten(0, -2)
    frames = [draw(*each, tuple(pixels.shape[-3:])) for each in zip(pose.flatten(0, -2), pillars, strict=True)]
    return torch.stack(frames).reshape(pixels.shape)


def make(image_shape: tuple[int, int, int], frame_stack: int, *, seed: int | None = None) -> Room:
    """Make the environment."""
    return Room(image_shape, frame_stack, seed)


def goal_renderer() -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """Return the exact hallucinator, as a domain offers it."""
    return paint


def room_domain(image_shape: tuple[int, int, int] = (64, 64, 3), frame_stack: int = 1, **more: Any) -> Domain:
    """Return the domain as a user fills it in by hand: no fingerprint, no goal renderer, no view from outside."""
    return Domain(
        name="room",
        make=partial(make, image_shape, frame_stack),
        action_spec=Bounded(-1.0, 1.0, (2,)),
        image_shape=image_shape,
        frame_stack=frame_stack,
        poses=POSES,
        **more,
    )


def near_goal(domain: Domain, rollouts: int = 24, length: int = 12, *, seed: int = 0) -> dict[str, Tensor]:
    """Return frames of wandering towards the pillar, their poses, and the goal pose of each rollout."""
    rng = torch.Generator().manual_seed(seed)
    height, width, channels = domain.image_shape
    shape, stack = (height, width, channels // domain.frame_stack), domain.frame_stack
    pixels, poses, goals = [], [], []
    for _ in range(rollouts):
        goal = torch.cat([torch.zeros(2), 6.3 * torch.rand(1, generator=rng)])
        pillar = POSES.goal_position(goal, goal)
        back = torch.linspace(0.9, 0.0, length + stack - 1)  # metres before the goal pose
        sway = 0.25 * (torch.rand(length + stack - 1, generator=rng) - 0.5)
        walk = torch.stack([-back * goal[2].cos(), -back * goal[2].sin(), goal[2] + sway], 1)
        frames = [draw(pose, pillar, shape) for pose in walk]
        for last in range(stack - 1, len(walk)):
            pixels.append(torch.cat(frames[last - stack + 1 : last + 1], -1))
            poses.append(walk[last])
            goals.append(goal)
    return {"pixels": torch.stack(pixels), "pose": torch.stack(poses), "goal_pose": torch.stack(goals)}


def failed(domain: Domain, count: int = 200, *, seed: int = 1) -> dict[str, Tensor]:
    """Return frames without a pillar, and their poses."""
    rng = torch.Generator().manual_seed(seed)
    height, width, channels = domain.image_shape
    pose = torch.rand(count, 3, generator=rng) * torch.tensor([2.0, 2.0, 6.3]) - torch.tensor([1.0, 1.0, 0.0])
    frames = [draw(each, None, (height, width, channels // domain.frame_stack)) for each in pose]
    return {"pixels": torch.stack([frame.repeat(1, 1, domain.frame_stack) for frame in frames]), "pose": pose}
