"""Frames of named environments, as tensors: what generators are trained on, and what they are judged by."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .near_goal import collect_failed, collect_near_goal
from .oracle import GoalRenderer
from .suite.names import named

Frames = dict[str, Tensor]
"""``pixels`` uint8 [N, H, W, 3], ``pose`` float32 [N, P]; frames near a goal also ``goal_pose`` float32 [N, P]."""


def near_goal_frames(name: str, count: int, *, seed: int, steps_before_goal: int = 32) -> Frames:
    """Collects near-goal frames of successful rollouts, see :func:`collect_near_goal`.

    Args:
        name: Of the environment.
        count: N.
        seed: Of everything random.
        steps_before_goal: Frames of each rollout besides its last.
    """
    return _collect(name, collect_near_goal, count, seed, steps_before_goal=steps_before_goal)


def failed_frames(name: str, count: int, *, seed: int) -> Frames:
    """Collects frames of failed random walks, see :func:`collect_failed`.

    Args:
        name: Of the environment.
        count: N.
        seed: Of everything random.
    """
    return _collect(name, collect_failed, count, seed)


def without_goal(frames: Frames, renderer: GoalRenderer) -> Frames:
    """Returns the frames with ``pixels`` as they are seen from their poses in a room without a goal."""
    images = [renderer.render_without_goal(pose) for pose in frames["pose"].double().numpy()]
    return frames | {"pixels": torch.from_numpy(np.stack(images))}


def with_truth(frames: Frames, renderer: GoalRenderer) -> Frames:
    """Returns the frames without goals, and beside them ``truth``: the same with each row's goal rendered."""
    frames = without_goal(frames, renderer)
    truth = renderer(*(frames[name].unsqueeze(1) for name in ("pixels", "pose", "goal_pose"))).squeeze(1)
    return frames | {"truth": truth}


def _collect(
    name: str, collector: Callable[..., dict[str, np.ndarray]], count: int, seed: int, **kwargs: Any
) -> Frames:
    environment = named(name)(random_state=seed)
    try:
        data = collector(environment, count, np.random.RandomState(seed), **kwargs)
    finally:
        environment.close()
    return {entry: torch.from_numpy(array) for entry, array in data.items()}
