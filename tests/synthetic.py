"""A tiny near-goal data set without simulator: a square that grows and moves with the relative pose."""

import torch
from torch import Tensor

from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.poses import relative_pose

RED = torch.tensor([200, 20, 20], dtype=torch.uint8)
GREEN = torch.tensor([20, 180, 20], dtype=torch.uint8)
WHITE, BLACK = torch.tensor([230], dtype=torch.uint8), torch.tensor([10], dtype=torch.uint8)
STEP = 0.1
"""How far the robot drove ahead from one stacked frame to the next [m]."""

ImageShape = tuple[int, int, int]
RGB: ImageShape = (64, 64, 3)
SHAPES = {"84x84x3": ((84, 84, 3), 1), "64x64x1": ((64, 64, 1), 1), "64x64x12": ((64, 64, 12), 4)}
"""Image shapes that are not the default, each with its number of stacked frames."""


def vivid_generator(pose_size: int = 3, *, image_shape: ImageShape = RGB, frame_stack: int = 1) -> CoordinateGenerator:
    """Returns an untrained generator in whose images pose and latent show in 8 bits."""
    torch.manual_seed(0)
    generator = CoordinateGenerator(pose_size=pose_size, opacity=0.5, image_shape=image_shape, frame_stack=frame_stack)
    with torch.no_grad():
        for parameter in generator.parameters():
            parameter.mul_(2)
    return generator


def near_goal(
    count: int = 64,
    frames_per_rollout: int = 8,
    seed: int = 0,
    *,
    flagged: bool = False,
    image_shape: ImageShape = RGB,
    frame_stack: int = 1,
) -> dict[str, Tensor]:
    """Returns frames with a square on grey noise, their poses, and one goal pose a rollout.

    The square is red, or white in grey frames. If flagged, half of the rollouts have a flag of 1 and a green (black)
    one, see :func:`failed`. Older frames of a stack are seen from farther away. The entry ``"empty"`` has the same
    frames without the square.
    """
    rng = torch.Generator().manual_seed(seed)
    goal_pose = torch.rand(count // frames_per_rollout, 3, generator=rng).repeat_interleave(frames_per_rollout, 0)
    offset = torch.rand(count, 3, generator=rng) * torch.tensor([0.8, 0.2, 0.0]) - torch.tensor([0.0, 0.1, 0.0])
    data = failed(count, seed=seed + 1, flagged=flagged, image_shape=image_shape, frame_stack=frame_stack)
    flags = data["pose"][:, 3:]
    data |= {"pose": torch.cat([goal_pose - offset, flags], 1), "goal_pose": torch.cat([goal_pose, flags], 1)}
    data["empty"] = data["pixels"].clone()
    relative = relative_pose(data["pose"], data["goal_pose"])
    colours = (WHITE, BLACK) if image_shape[2] == frame_stack else (RED, GREEN)
    for image, flag, (x, y, _) in zip(data["pixels"], flags, relative, strict=True):
        frames = image.unflatten(-1, (frame_stack, -1)).unbind(-2)
        for age, frame in enumerate(reversed(frames)):
            draw_square(frame, float(x) + STEP * age, float(y), colours[int(flag.any())])
    return data


def draw_square(frame: Tensor, x: float, y: float, colour: Tensor) -> None:
    """Draws the goal, seen x [m] ahead and y [m] to the left, into a frame ``[H, W, c]``."""
    height, width, _ = frame.shape
    half, column = int((3 + 8 * min(max(0.8 - x, 0), 1)) * width / 64), int((32 - 60 * y) * width / 64)
    middle = height // 2
    frame[max(0, middle - half) : middle + half, max(0, column - half) : column + half] = colour


def failed(
    count: int = 64, seed: int = 5, *, flagged: bool = False, image_shape: ImageShape = RGB, frame_stack: int = 1
) -> dict[str, Tensor]:
    """Returns frames of grey noise and poses; if flagged, the second half has a flag of 1, and a bar below.

    The bar has the colour that the goal has without the flag.
    """
    height, width, channels = image_shape
    rng = torch.Generator().manual_seed(seed)
    grey = torch.randint(90, 150, (count, height, width, 1), generator=rng).to(torch.uint8)
    pixels = grey.expand(-1, -1, -1, channels).clone()
    pose = torch.rand(count, 3, generator=rng)
    if flagged:
        held = torch.arange(count)[:, None] >= count // 2
        pose = torch.cat([pose, held.float()], 1)
        pixels[count // 2 :, height - 8 :] = (WHITE if channels == frame_stack else RED).repeat(frame_stack)
    return {"pixels": pixels, "pose": pose}
