"""Bounds of continuous actions, and the way from them to [-1, 1] and back."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec

Bounds = tuple[tuple[float, ...], tuple[float, ...]]
"""Lowest and highest value of each entry of an action."""
LARGEST = 1e30
"""What is beyond this is no bound: some environments write the largest float for none."""


def bounds_of(action_spec: TensorSpec, algorithm: str) -> Bounds:
    """Returns the bounds of continuous actions ``[A]``.

    Args:
        action_spec: The environment's.
        algorithm: Names the algorithm in errors.

    Raises:
        ValueError: If the actions are discrete, have no finite bounds, or are no vector.
    """
    if not isinstance(action_spec, Bounded) or not action_spec.dtype.is_floating_point:
        raise ValueError(
            f"{algorithm} needs continuous actions with bounds, got {type(action_spec).__name__} "
            f"{list(action_spec.shape)} of {action_spec.dtype}: train discrete actions with DDQN "
            "(halgan_rl.agents.ddqn), and bound unbounded ones in the environment."
        )
    if action_spec.ndim != 1:
        raise ValueError(
            f"{algorithm} needs actions [A], got {list(action_spec.shape)}: for several environments at once, pass the "
            "spec of one (env.action_spec_unbatched)."
        )
    low, high = (tuple(bound.tolist()) for bound in (action_spec.space.low, action_spec.space.high))
    for place, (least, most) in enumerate(zip(low, high, strict=True)):
        if not least < most or max(-least, most) > LARGEST:
            raise ValueError(
                f"{algorithm} needs finite bounds of its actions, got [{least}, {most}] for entry {place}: bound the "
                "environment's action spec."
            )
    return low, high


class ActionScale(nn.Module):
    """Scales actions between [-1, 1] and their bounds. With bounds of -1 and 1 it does nothing, to the last bit.

    Args:
        low: Lowest value of each entry, ``[A]``.
        high: Highest value of each entry, ``[A]``.

    Examples:
        >>> scale = ActionScale(low=[0.0, -2.0], high=[1.0, 2.0])
        >>> scale.from_unit(torch.tensor([-1.0, 0.5])).tolist(), scale.to_unit(torch.tensor([0.75, 2.0])).tolist()
        ([0.0, 1.0], [0.5, 1.0])
    """

    middle: Tensor
    reach: Tensor

    def __init__(self, low: Sequence[float], high: Sequence[float]) -> None:
        super().__init__()
        self.is_unit = all(bound == -1.0 for bound in low) and all(bound == 1.0 for bound in high)
        if not self.is_unit:
            lowest, highest = torch.tensor(low), torch.tensor(high)
            self.register_buffer("middle", (lowest + highest) / 2, persistent=False)
            self.register_buffer("reach", (highest - lowest) / 2, persistent=False)

    def from_unit(self, action: Tensor) -> Tensor:
        """Returns actions ``[..., A]`` within the bounds of ones in [-1, 1]."""
        return action if self.is_unit else self.middle + self.reach * action

    def to_unit(self, action: Tensor) -> Tensor:
        """Returns actions ``[..., A]`` in [-1, 1] of ones within the bounds."""
        return action if self.is_unit else (action - self.middle) / self.reach


class BoundedTanh(nn.Module):
    """A tanh, scaled to the bounds of the actions.

    Args:
        low: Lowest value of each entry, ``[A]``.
        high: Highest value of each entry, ``[A]``.
    """

    def __init__(self, low: Sequence[float], high: Sequence[float]) -> None:
        super().__init__()
        self.scale = ActionScale(low, high)

    def forward(self, preactivation: Tensor) -> Tensor:
        """Returns actions ``[..., A]`` within their bounds, of unbounded numbers ``[..., A]``."""
        return self.scale.from_unit(preactivation.tanh())
