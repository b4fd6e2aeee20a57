"""A Gymnasium environment whose poses say which episode they belong to."""

from typing import Any

import gymnasium
import numpy as np

STEP = 0.25
"""Length of a step [m]."""
START = 8.0
"""Distance between the starts of two episodes [m]."""
LENGTH = 5
"""Steps of an episode."""


class Drift(gymnasium.Env):
    """Drifts ahead; each episode starts elsewhere, and is cut after some steps."""

    observation_space = gymnasium.spaces.Dict(
        pixels=gymnasium.spaces.Box(0, 255, (4, 5, 3), np.uint8),
        pose=gymnasium.spaces.Box(-1e3, 1e3, (3,), np.float32),
    )
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, **options: Any) -> None:
        self.episode = self.time = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        super().reset(seed=seed)
        self.episode, self.time = self.episode + 1, 0
        return self._observe(), {}

    def step(self, action: int) -> tuple[dict, float, bool, bool, dict]:
        self.time += 1
        return self._observe(), 0.0, False, self.time == LENGTH, {}

    def _observe(self) -> dict:
        pixels = np.full((4, 5, 3), 10 * self.episode + self.time, np.uint8)
        pose = np.array([START * self.episode + STEP * self.time, 0.5, -0.25], np.float32)
        return {"pixels": pixels, "pose": pose}


gymnasium.register("Drift-v0", entry_point=Drift)
