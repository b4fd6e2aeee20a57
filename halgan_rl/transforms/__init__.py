"""Hindsight as TorchRL replay transforms: small, single-purpose, composed with :class:`torchrl.envs.Compose`."""

from halgan_rl.transforms.annealing import Annealing
from halgan_rl.transforms.base import ReplayTransform
from halgan_rl.transforms.draw_hindsight_goal import DrawHindsightGoal
from halgan_rl.transforms.hallucinate_goal import HallucinateGoal, Hallucinator
from halgan_rl.transforms.hindsight_config import HindsightConfig
from halgan_rl.transforms.hindsight_reward import HindsightReward
from halgan_rl.transforms.stamp_future_poses import StampFuturePoses

__all__ = [
    "Annealing",
    "DrawHindsightGoal",
    "HallucinateGoal",
    "Hallucinator",
    "HindsightConfig",
    "HindsightReward",
    "ReplayTransform",
    "StampFuturePoses",
]
