"""GymnasiumEnv: the Gymnasium adapter of the named environments, and their ids."""

from typing import Any

import gymnasium
import numpy as np
from dm_env import specs
from gymnasium import spaces

from ..suite.names import NAMES, named
from .transition import Transition, advance, read


class GymnasiumEnv(gymnasium.Env[dict[str, Any], Any]):
    """A named environment as a Gymnasium environment.

    Observations are a dict of ``pixels`` uint8 [64, 64, 3] and ``pose`` float32 [P] (x [m], y [m], yaw [rad], then the
    flags of the task), actions float32 [2] in [-1, 1]: forward speed and turn rate; or integers where they are
    discrete. Success terminates and sets ``is_success`` in the info; the environment's own time limit truncates. An
    episode equals that of the TorchRL adapter with the same seed.

    An OpenGL context lives in one process and, with EGL, on one thread: spawn the workers of vectorised environments,
    ``gymnasium.make_vec(..., vectorization_mode="async", vector_kwargs={"context": "spawn"})``.

    Args:
        name: One of ``halgan_envs.NAMES``.
        render_mode: ``"rgb_array"``: :meth:`render` shows the room from outside. None: it shows nothing.
        kwargs: Further arguments of the environment's function, e.g. ``time_limit`` [s].

    Raises:
        ValueError: if the name or the render mode is unknown.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, name: str, *, render_mode: str | None = None, **kwargs: Any) -> None:
        _check_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.environment = named(name)(**kwargs)
        task = self.environment.task
        self.metadata = {**self.metadata, "render_fps": round(1 / task.control_timestep)}
        self.observation_space = _observation_space(task.robot.image_size, task.pose_spec)
        self.action_space = _action_space(self.environment.action_spec())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: Of this and all later starts; None continues the series of starts.
            options: Fixes the start, see the ``fix_start`` of the task: in Navigate any of ``pose``, the robot's x [m],
                y [m], yaw [rad], and ``box``, its x [m], y [m]. What is not given is drawn.

        Returns:
            The first observation, and the info.

        Raises:
            ValueError: if the options are unknown or impossible; nothing is reset then.
            RuntimeError: after :meth:`close`.
        """
        super().reset(seed=seed)
        if seed is not None:
            self.environment.random_state.seed(seed)
        transition = read(self.environment.reset_to(options or {}))
        return _observation(transition), _info(transition)

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Takes an action for one step.

        Returns:
            Observation, reward, terminated, truncated, info.

        Raises:
            ValueError: if the action is not in the action space.
            RuntimeError: if the episode is over, or after :meth:`close`.
        """
        transition = advance(self.environment, np.asarray(action))
        return (
            _observation(transition),
            transition.reward,
            transition.terminated,
            transition.truncated,
            _info(transition),
        )

    def render(self) -> np.ndarray | None:
        """Returns the room from outside, uint8 [240, 320, 3]; None without a render mode."""
        return None if self.render_mode is None else self.environment.render_overview()

    def close(self) -> None:
        """Frees cameras and physics; a reset, a step or a picture then raises a ``RuntimeError``."""
        self.environment.close()


def gymnasium_id(name: str) -> str:
    """Returns the Gymnasium id of a named environment.

    >>> gymnasium_id("navigate-2m")
    'halgan_rl/Navigate2m-v0'
    """
    return f"halgan_rl/{''.join(word.capitalize() for word in name.split('-'))}-v0"


def register_named() -> None:
    """Registers every named environment with Gymnasium; ``import halgan_envs`` does it."""
    for name in NAMES:
        gymnasium.register(gymnasium_id(name), f"{__name__}:{GymnasiumEnv.__name__}", kwargs={"name": name})


def _observation_space(image_size: tuple[int, int], pose: specs.BoundedArray) -> spaces.Dict:
    return spaces.Dict(
        pixels=spaces.Box(0, 255, (*image_size, 3), np.uint8),
        pose=spaces.Box(pose.minimum, pose.maximum, dtype=np.float32),
    )


def _action_space(spec: specs.Array) -> spaces.Space:
    if isinstance(spec, specs.DiscreteArray):
        return spaces.Discrete(spec.num_values)
    return spaces.Box(-1.0, 1.0, spec.shape, np.float32)


def _observation(transition: Transition) -> dict[str, np.ndarray]:
    return {"pixels": transition.pixels, "pose": transition.pose}


def _info(transition: Transition) -> dict[str, Any]:
    return {"is_success": transition.terminated}


def _check_render_mode(render_mode: str | None, known: list[str]) -> None:
    if render_mode is not None and render_mode not in known:
        raise ValueError(f"Unknown render_mode {render_mode!r}: choose None or one of {known}.")
