"""ComposerEnv: the TorchRL adapter of an environment."""

from typing import Any

import numpy as np
import torch
from dm_env import specs
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase

from ..environment import Environment
from ..suite.names import named
from .transition import Transition, advance, read


class ComposerEnv(EnvBase):
    """A composer environment as a TorchRL environment.

    Reads ``action``, float32 [2], or one-hot int64 [A] where actions are discrete; writes ``pixels`` uint8 [64, 64, 3],
    ``pose`` float32 [P] (x [m], y [m], yaw [rad], then the flags of the task), ``reward`` float32 [1], and ``done``,
    ``terminated``, ``truncated`` bool [1]. Success terminates; the time limit truncates. Pickle a factory such as
    ``functools.partial(halgan_envs.make, "navigate-2m")``, not the environment: an OpenGL context lives in one process
    and, with EGL, on one thread.

    Args:
        environment: The environment, owned and closed by this one.
    """

    def __init__(self, environment: Environment) -> None:
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([]))
        self.environment = environment
        self.robot = environment.task.robot
        self._make_specs()

    def _make_specs(self) -> None:
        height, width = self.robot.image_size
        self.observation_spec = Composite(
            pixels=Bounded(0, 255, shape=(height, width, 3), dtype=torch.uint8),
            pose=Unbounded(shape=self.environment.task.pose_spec.shape, dtype=torch.float32),
        )
        self.action_spec = action_spec(self.environment)
        self._is_one_hot = isinstance(self.action_spec, OneHot)
        self.reward_spec = Unbounded(shape=(1,), dtype=torch.float32)
        self.done_spec = Composite(
            done=Binary(1, shape=(1,), dtype=torch.bool),
            terminated=Binary(1, shape=(1,), dtype=torch.bool),
            truncated=Binary(1, shape=(1,), dtype=torch.bool),
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        del tensordict, kwargs
        return self._pack(read(self.environment.reset()))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].numpy()
        transition = advance(self.environment, _choice(action) if self._is_one_hot else action)
        out = self._pack(transition)
        out.set("reward", torch.tensor([transition.reward], dtype=torch.float32))
        return out

    def _pack(self, transition: Transition) -> TensorDict:
        source = {
            "pixels": torch.from_numpy(transition.pixels),
            "pose": torch.from_numpy(transition.pose),
            "done": torch.tensor([transition.terminated or transition.truncated]),
            "terminated": torch.tensor([transition.terminated]),
            "truncated": torch.tensor([transition.truncated]),
        }
        return TensorDict._new_unsafe(source, batch_size=self.batch_size, device=self.device)

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # TorchRL would check shapes and complete the done flags here; _pack leaves nothing to complete.
        return next_tensordict_out

    def _set_seed(self, seed: int | None) -> None:
        self.environment.random_state.seed(seed)

    def render_overview(self, height: int = 240, width: int = 320) -> np.ndarray:
        """Renders the room from outside, for people: uint8 [height, width, 3], anti-aliased.

        Raises:
            RuntimeError: after :meth:`close`.
        """
        return self.environment.render_overview(height, width)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Frees cameras and physics; a reset, a step or a picture then raises a ``RuntimeError``."""
        super().close(raise_if_closed=raise_if_closed)
        self.environment.close()


def make(name: str, *, seed: int | None = None, **kwargs: Any) -> ComposerEnv:
    """Makes a named environment as a TorchRL environment.

    Args:
        name: One of ``halgan_envs.NAMES``.
        seed: Of the starts; equal seeds give equal episodes.
        kwargs: Further arguments of the environment's function, e.g. ``time_limit`` [s].

    Raises:
        ValueError: if the name is unknown.
    """
    return ComposerEnv(named(name)(random_state=seed, **kwargs))


def action_spec(environment: Environment) -> Bounded | OneHot:
    """Returns the spec of an environment's actions: float32 [2] in [-1, 1], or one-hot int64 [A] if discrete."""
    spec = environment.action_spec()
    if isinstance(spec, specs.DiscreteArray):
        return OneHot(spec.num_values, dtype=torch.int64)
    return Bounded(-1.0, 1.0, shape=spec.shape, dtype=torch.float32)


def _choice(action: np.ndarray) -> Any:
    if action.ndim != 1 or np.count_nonzero(action) != 1 or action.sum() != 1:
        raise ValueError(f"An action is one-hot, a single 1 among zeros; got {action.tolist()}.")
    return action.argmax()
