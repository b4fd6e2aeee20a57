"""Painters applied to frames with a pose and a goal pose each."""

from torch import Tensor

from halgan_rl.hallucination.training.data import Frames
from halgan_rl.transforms.hallucinate_goal import Hallucinator


def paint_each(painter: Hallucinator, data: Frames) -> Tensor:
    """Returns the images ``[N, H, W, C]`` with each row's goal painted in, each with a latent of its own."""
    return painter(*(data[name].unsqueeze(1) for name in ("pixels", "pose", "goal_pose"))).squeeze(1)


def paint_one_goal(painter: Hallucinator, data: Frames) -> Tensor:
    """Returns the images ``[N, H, W, C]`` with one goal, the first row's, painted into all, with one latent."""
    return painter(data["pixels"][None], data["pose"][None], data["goal_pose"][None, :1]).squeeze(0)
