"""Parking: a toy that needs no simulator, with the data contract of the real environments in tiny images.

A car on an unbounded grid drives one cell ahead or turns by 90 degrees. It sees the 15x15 cells around it from above,
its own heading pointing up: a parking spot (red) and the cell that the spot faces (green), on a ground (blue) whose
shade tells cells apart. It must stand on the spot, facing as the spot does. Nothing else is rewarded, and chance hardly
ever gets there.
"""

import math

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from halgan_rl.poses import PlanarPoses, relative_pose, wrap_angle

VIEW = 7  # cells seen to each side
SIZE = 2 * VIEW + 1
AHEAD, LEFT, RIGHT = range(3)


def render(pose: Tensor, goal_pose: Tensor) -> Tensor:
    """Returns what is seen from ``pose`` [..., 3]: uint8 [..., 15, 15, 3]."""
    ground = (7 * pose[..., 0] + 13 * pose[..., 1] + 5 * pose[..., 2]).round().remainder(16).to(torch.uint8)
    pixels = torch.zeros(*pose.shape[:-1], SIZE, SIZE, 3, dtype=torch.uint8)
    pixels[..., 2] = ground[..., None, None]
    return hallucinate(pixels, pose, goal_pose)


def hallucinate(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """The exact hallucinator: puts the spot at ``goal_pose`` and leaves the ground as it is."""
    ahead, left, turn = relative_pose(pose, goal_pose).unbind(-1)
    spot = _cell(ahead, left)
    faced = _cell(ahead + turn.cos(), left + turn.sin())
    return torch.stack([255 * spot, 255 * faced, pixels[..., 2]], dim=-1).to(torch.uint8)


def _cell(ahead: Tensor, left: Tensor) -> Tensor:
    """Marks the cell at a relative position: bool [..., 15, 15], all False if it is out of view."""
    offset = VIEW - torch.arange(SIZE)
    return (offset[:, None] == ahead.round()[..., None, None]) & (offset == left.round()[..., None, None])


class Parking(EnvBase):
    """The environment; ``count`` cars at once give batch size [count], None gives []."""

    def __init__(self, count: int | None = None, *, seed: int = 0, time_limit: int = 18, distance: int = 6) -> None:
        super().__init__(batch_size=[] if count is None else [count])
        shape = self.batch_size
        self.time_limit = time_limit
        self.distance = distance
        self.poses = PlanarPoses()
        self.observation_spec = Composite(
            pixels=Unbounded((*shape, SIZE, SIZE, 3), dtype=torch.uint8), pose=Unbounded((*shape, 3)), shape=shape
        )
        self.action_spec = Categorical(3, shape=shape)
        self.reward_spec = Unbounded((*shape, 1))
        flag = Binary(1, shape=(*shape, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=shape)
        self.pose, self.goal_pose = torch.zeros(*shape, 3), torch.zeros(*shape, 3)
        self.time = torch.zeros(shape, dtype=torch.int64)
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self.rng = torch.Generator().manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        chosen = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict:
            chosen = tensordict["_reset"].reshape(self.batch_size)
        self.pose = torch.where(chosen[..., None], self._random_pose(0, 0), self.pose)
        self.goal_pose = torch.where(chosen[..., None], self._random_pose(self.distance, 6), self.goal_pose)
        self.time = torch.where(chosen, 0, self.time)
        return TensorDict(self._observe(), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        x, y, yaw = self.pose.unbind(-1)
        action = tensordict["action"]
        ahead = (action == AHEAD).float()
        turn = (action == LEFT).float() - (action == RIGHT).float()
        moved = [x + (ahead * yaw.cos()).round(), y + (ahead * yaw.sin()).round(), wrap_angle(yaw + turn * math.pi / 2)]
        self.pose = torch.stack(moved, dim=-1)
        self.time = self.time + 1
        terminated = self.poses.reached(self.pose, self.goal_pose)[..., None]
        truncated = (self.time >= self.time_limit)[..., None] & ~terminated
        flags = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict({**self._observe(), "reward": terminated.float(), **flags}, batch_size=self.batch_size)

    def _observe(self) -> dict[str, Tensor]:
        return {"pixels": render(self.pose, self.goal_pose), "pose": self.pose.clone()}

    def _random_pose(self, nearest: int, furthest: int) -> Tensor:
        """Draws cells whose larger coordinate lies between two distances, and headings."""

        def draw(low: int, high: int) -> Tensor:
            return torch.randint(low, high + 1, self.batch_size, generator=self.rng).float()

        far, near = draw(nearest, furthest) * (2 * draw(0, 1) - 1), draw(-furthest, furthest)
        swap = draw(0, 1).bool()
        x, y = torch.where(swap, near, far), torch.where(swap, far, near)
        return torch.stack([x, y, wrap_angle(draw(0, 3) * math.pi / 2)], dim=-1)
