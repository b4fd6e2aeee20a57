"""What a reset or a step of an environment yields, as its TorchRL and Gymnasium adapters read it."""

from typing import Any, NamedTuple

import numpy as np
from dm_env import specs

from ..environment import Environment

_OVERSHOOT = 1e-3
"""Actions this little out of range are clipped (rounding); larger ones are errors."""


class Transition(NamedTuple):
    """Where a reset or a step led; the arrays are fresh ones."""

    pixels: np.ndarray
    """The robot's image, uint8 [H, W, 3]."""
    pose: np.ndarray
    """float32 [P]: x [m], y [m], yaw [rad], then the flags of the task."""
    reward: float
    """Reward of the step; 0 after a reset."""
    terminated: bool
    """Whether the goal is reached."""
    truncated: bool
    """Whether the time is over and the goal is not reached."""


def read(timestep: Any) -> Transition:
    """Reads a ``dm_env.TimeStep``."""
    terminated = bool(timestep.last() and timestep.discount == 0.0)
    return Transition(
        pixels=timestep.observation["pixels"],
        pose=timestep.observation["pose"],
        reward=0.0 if timestep.first() else float(timestep.reward),
        terminated=terminated,
        truncated=bool(timestep.last() and not terminated),
    )


def advance(environment: Environment, action: np.ndarray) -> Transition:
    """Takes one step with an action: [2], or the number of a discrete one.

    Raises:
        ValueError: if the action is not one, see :func:`checked_action` and :func:`checked_choice`.
        RuntimeError: if no episode is going on.
    """
    spec = environment.action_spec()
    is_choice = isinstance(spec, specs.DiscreteArray)
    timestep = environment.step(checked_choice(action, spec.num_values) if is_choice else checked_action(action))
    if timestep.first():
        raise RuntimeError("The episode is over: call reset before the next step.")
    return read(timestep)


def checked_action(action: np.ndarray) -> np.ndarray:
    """Returns an action [2] clipped to [-1, 1].

    Raises:
        ValueError: if there are not two entries, or one is not a number, or out of range by more than rounding.

    >>> checked_action(np.array([1.0001, -0.5])).tolist()
    [1.0, -0.5]
    """
    if action.shape != (2,):
        raise ValueError(f"An action has two entries, forward and turn; got {action.tolist()}.")
    # Written so that NaN fails too.
    if not abs(action).max() <= 1 + _OVERSHOOT:
        raise ValueError(f"Actions must lie in [-1, 1]; got {action.tolist()}: squash or clamp the policy's output.")
    return np.clip(action, -1.0, 1.0)


def checked_choice(action: np.ndarray, count: int) -> int:
    """Returns the number of one of so many discrete actions.

    Args:
        action: An integer without dimensions.
        count: How many actions there are.

    Raises:
        ValueError: if it is no integer, or out of range.

    >>> checked_choice(np.array(3), 4)
    3
    """
    if action.shape != () or action.dtype.kind not in "iu" or not 0 <= action < count:
        raise ValueError(f"An action is one of the integers 0 to {count - 1}; got {action.tolist()}.")
    return int(action)


def random_action(spec: specs.Array, random_state: np.random.RandomState) -> Any:
    """Returns a uniformly random action: the number of a discrete one, else [2] in [-1, 1]."""
    if isinstance(spec, specs.DiscreteArray):
        return random_state.randint(spec.num_values)
    return random_state.uniform(spec.minimum, spec.maximum, size=spec.shape)
