"""What tests of the recipes share."""

from contextlib import AbstractContextManager
from typing import Any
from unittest import mock

from halgan_rl.experiment.run import Run

TINY = {
    "total_frames": 160,
    "hindsight.max_distance": 32,
    "painter.bank": False,
    "training.warmup_frames": 64,
    "training.batch_size": 8,
    "training.replay_capacity": 200,
    "evaluation.every": 80,
    "evaluation.starts": 1,
    "evaluation.film_starts": 1,
    "evaluation.background": False,
}
"""Values of a run of a few seconds that reaches its updates."""


def without_pictures() -> AbstractContextManager[Any]:
    """Return a context in which runs draw nothing and film nothing, which takes two fifths of a tiny one."""
    return mock.patch.object(Run, "draw")
