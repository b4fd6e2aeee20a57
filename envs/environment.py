"""A composer environment that is compiled once, starts where a caller fixes it, and closes its cameras."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_control import composer

from .rendering.persistent_camera import PersistentCamera


class Environment(composer.Environment):
    """``composer.Environment`` without its costs: no recompilation at a reset, no buffer axis in observations.

    Args:
        task: The task; its ``robot`` holds the camera.
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
        self._overview: PersistentCamera | None = None
        self._action_spec = task.action_spec(self.physics)

    def action_spec(self) -> Any:
        """Returns that of the task, made once."""
        return self._action_spec

    @property
    def is_closed(self) -> bool:
        """Whether :meth:`close` has freed the physics."""
        return self._physics is None

    @property
    def physics(self) -> Any:
        """A proxy of the physics, which must not outlive the environment.

        Raises:
            RuntimeError: after :meth:`close`.
        """
        self._check_open()
        return super().physics

    def reset(self) -> Any:
        """Starts an episode.

        Returns:
            The first ``dm_env.TimeStep``.

        Raises:
            RuntimeError: after :meth:`close`.
        """
        self._check_open()
        return super().reset()

    def step(self, action: Any) -> Any:
        """Takes an action for one step.

        Args:
            action: As ``action_spec`` says; not checked.

        Returns:
            The next ``dm_env.TimeStep``; the first of an episode if there was none or the last one was over.

        Raises:
            RuntimeError: after :meth:`close`.
        """
        self._check_open()
        return super().step(action)

    def reset_to(self, start: Mapping[str, Any]) -> Any:
        """Starts an episode from a fixed start; later episodes are drawn again.

        Args:
            start: What is fixed, see the ``fix_start`` of the task; the rest is drawn as usual.

        Returns:
            The first ``dm_env.TimeStep``.

        Raises:
            ValueError: if the start is impossible; the episode before goes on.
            RuntimeError: after :meth:`close`.
        """
        self._check_open()
        self.task.fix_start(start)
        try:
            return self.reset()
        finally:
            self.task.fix_start({})

    def render_overview(self, height: int = 240, width: int = 320) -> np.ndarray:
        """Renders the room from outside, for people: uint8 [height, width, 3], anti-aliased.

        Raises:
            RuntimeError: after :meth:`close`.
        """
        self._check_open()
        if self._overview is None or self._overview.shape != (height, width):
            self._close_overview()
            self._overview = PersistentCamera(self.physics, "overview", height=height, width=width, samples=4)
        return self._overview.render(self.physics)

    def _check_open(self) -> None:
        if self.is_closed:
            raise RuntimeError("This environment is closed: make a new one to reset, step or render.")

    def _close_overview(self) -> None:
        if self._overview is not None:
            self._overview.close()
        self._overview = None

    def close(self) -> None:
        """Frees cameras and physics; harmless when repeated."""
        self._close_overview()
        if not self.is_closed:
            self.task.robot.close()
            super().close()
