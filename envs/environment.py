"""A composer environment that is compiled once and closes its camera."""

from typing import Any

import numpy as np
from dm_control import composer


class Environment(composer.Environment):
    """``composer.Environment`` without its costs: no recompilation at a reset, no buffer axis in observations.

    Args:
        task: The task; its ``rover`` holds the camera.
        time_limit: Seconds an episode.
        random_state: Seed or generator of the starts.
    """

    def __init__(
        self, task: Any, *, time_limit: float, random_state: int | np.random.RandomState | None = None
    ) -> None:
        # Floating point adds 200 steps of 0.1 s up to a little less than 20 s; half a step of slack counts them right.
        super().__init__(
            task=task,
            time_limit=time_limit - task.control_timestep / 2,
            random_state=random_state,
            strip_singleton_obs_buffer_dim=True,
            recompile_mjcf_every_episode=False,
        )

    def close(self) -> None:
        """Frees camera and physics; harmless when repeated."""
        if self._physics is not None:
            self.task.rover.close()
            super().close()
