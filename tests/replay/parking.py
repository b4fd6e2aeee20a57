"""Rows of the toy, and hindsight on them."""

import functools

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import Compose

from halgan_rl.transforms import DrawHindsightGoal, HallucinateGoal, HindsightReward, StampFuturePoses
from tests import toy
from tests.transforms.rows import always, random_source

DISTANCE = 6


@functools.cache
def collect(frames: int, count: int | None = 3, length: int = 7, seed: int = 0) -> list[TensorDictBase]:
    """Batches from a real collector with a random policy; 7 steps at a time split the episodes of 18."""
    torch.manual_seed(seed)
    environment = toy.Parking(count, seed=seed)
    collector = Collector(environment, None, frames_per_batch=length * (count or 1), total_frames=frames)
    batches = [batch.exclude("collector") for batch in collector]
    collector.shutdown()
    return batches


def relabelling(probability: float = 1.0) -> Compose:
    """The toy's exact hallucinations."""
    return Compose(
        StampFuturePoses(DISTANCE),
        DrawHindsightGoal(always(probability), rng=random_source()),
        HallucinateGoal(toy.hallucinate),
        HindsightReward(),
    )
