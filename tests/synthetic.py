"""A tiny near-goal data set without simulator: a red square that grows and moves with the relative pose."""

import torch
from torch import Tensor

from halgan_rl.models.coordinates import CoordinateGenerator
from halgan_rl.poses import relative_pose


def vivid_generator(pose_size: int = 3) -> CoordinateGenerator:
    """Return an untrained generator in whose images pose and latent show in 8 bits."""
    torch.manual_seed(0)
    generator = CoordinateGenerator(pose_size=pose_size, opacity=0.5)
    with torch.no_grad():
        for parameter in generator.parameters():
            parameter.mul_(2)
    return generator


def near_goal(count: int = 64, frames_per_rollout: int = 8, seed: int = 0) -> dict[str, Tensor]:
    """Return frames with a red square on grey noise, their poses, and one goal pose a rollout."""
    rng = torch.Generator().manual_seed(seed)
    goal_pose = torch.rand(count // frames_per_rollout, 3, generator=rng).repeat_interleave(frames_per_rollout, 0)
    offset = torch.rand(count, 3, generator=rng) * torch.tensor([0.8, 0.2, 0.0]) - torch.tensor([0.0, 0.1, 0.0])
    pose = goal_pose - offset
    pixels = failed(count, seed=seed + 1)
    for image, (x, y, _) in zip(pixels, relative_pose(pose, goal_pose), strict=True):
        half, column = int(3 + 8 * (0.8 - x).clamp(0, 1)), int(32 - 60 * y)
        image[32 - half : 32 + half, max(0, column - half) : column + half] = torch.tensor([200, 20, 20]).to(
            torch.uint8
        )
    return {"pixels": pixels, "pose": pose, "goal_pose": goal_pose}


def failed(count: int = 64, seed: int = 5) -> Tensor:
    """Return frames ``[count, 64, 64, 3]`` of grey noise."""
    rng = torch.Generator().manual_seed(seed)
    return torch.randint(90, 150, (count, 64, 64, 1), generator=rng).to(torch.uint8).expand(-1, -1, -1, 3).clone()
