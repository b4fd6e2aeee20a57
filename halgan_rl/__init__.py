"""Visual hindsight experience replay for PyTorch: replay transforms, hallucinators, agents; knows no simulator.

The names that most users import. The rest is in the rooms below: ``transforms``, ``replay``, ``hallucination``,
``agents``, ``training``, ``experiment``.
"""

import halgan_rl.quiet_imports  # noqa: F401 (first: TorchRL's collectors come without its four warnings)
from halgan_rl.experiment.domain import Domain
from halgan_rl.hallucination.bank import HallucinationBank
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.weights import load_generator, shipped_weights
from halgan_rl.keys import Keys
from halgan_rl.poses import PlanarPoses, Poses
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.transforms import (
    Annealing,
    DrawHindsightGoal,
    HallucinateGoal,
    Hallucinator,
    HindsightConfig,
    HindsightReward,
    StampFuturePoses,
    pipelines,
)

__all__ = [
    "Annealing",
    "Domain",
    "DrawHindsightGoal",
    "FrameStorage",
    "GeneratorHallucinator",
    "HallucinateGoal",
    "HallucinationBank",
    "Hallucinator",
    "HindsightConfig",
    "HindsightReward",
    "Keys",
    "PlanarPoses",
    "Poses",
    "StampFuturePoses",
    "load_generator",
    "pipelines",
    "shipped_weights",
]
