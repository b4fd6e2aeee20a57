"""A tiny near-goal data set without simulator: a red square that grows and moves with the relative pose."""

import torch
from torch import Tensor

from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.poses import relative_pose

RED = torch.tensor([200, 20, 20], dtype=torch.uint8)
GREEN = torch.tensor([20, 180, 20], dtype=torch.uint8)


def vivid_generator(pose_size: int = 3) -> CoordinateGenerator:
    """Return an untrained generator in whose images pose and latent show in 8 bits."""
    torch.manual_seed(0)
    generator = CoordinateGenerator(pose_size=pose_size, opacity=0.5)
    with torch.no_grad():
        for parameter in generator.parameters():
            parameter.mul_(2)
    return generator


def near_goal(
    count: int = 64, frames_per_rollout: int = 8, seed: int = 0, *, flagged: bool = False
) -> dict[str, Tensor]:
    """Return frames with a square on grey noise, their poses, and one goal pose a rollout.

    The square is red. If flagged, half of the rollouts have a flag of 1 and a green one, see :func:`failed`.
    """
    rng = torch.Generator().manual_seed(seed)
    goal_pose = torch.rand(count // frames_per_rollout, 3, generator=rng).repeat_interleave(frames_per_rollout, 0)
    offset = torch.rand(count, 3, generator=rng) * torch.tensor([0.8, 0.2, 0.0]) - torch.tensor([0.0, 0.1, 0.0])
    data = failed(count, seed=seed + 1, flagged=flagged)
    flags = data["pose"][:, 3:]
    data |= {"pose": torch.cat([goal_pose - offset, flags], 1), "goal_pose": torch.cat([goal_pose, flags], 1)}
    relative = relative_pose(data["pose"], data["goal_pose"])
    for image, flag, (x, y, _) in zip(data["pixels"], flags, relative, strict=True):
        half, column = int(3 + 8 * (0.8 - x).clamp(0, 1)), int(32 - 60 * y)
        image[32 - half : 32 + half, max(0, column - half) : column + half] = GREEN if flag.any() else RED
    return data


def failed(count: int = 64, seed: int = 5, *, flagged: bool = False) -> dict[str, Tensor]:
    """Return frames of grey noise and poses; if flagged, the second half has a flag of 1, and a red bar below."""
    rng = torch.Generator().manual_seed(seed)
    pixels = torch.randint(90, 150, (count, 64, 64, 1), generator=rng).to(torch.uint8).expand(-1, -1, -1, 3).clone()
    pose = torch.rand(count, 3, generator=rng)
    if flagged:
        held = torch.arange(count)[:, None] >= count // 2
        pose = torch.cat([pose, held.float()], 1)
        pixels[count // 2 :, 56:] = RED
    return {"pixels": pixels, "pose": pose}
