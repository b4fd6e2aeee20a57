"""What all losses here bootstrap from: TD(0) targets, within the range of a return."""

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from halgan_rl.agents.agent import AgentConfig
from halgan_rl.keys import Keys


class ClippedTD0Estimator(TD0Estimator):
    r"""TD(0) targets clipped to the range that a return can take.

    With one reward of 1 at the goal and small costs before it, no return exceeds 1. A critic that is fed by its own
    maximum drifts above that bound, the deterministic policy saturates and the agent circles. Clipping the target
    :math:`r + \gamma^k (1 - \text{terminated}) V'`, k the steps that a row spans, ends this (as in HER, Andrychowicz et
    al. 2017, section 4.1).

    Pass it to any TorchRL loss: ``loss.make_value_estimator(ClippedTD0Estimator(low=-1.0, high=1.0, gamma=0.99,
    value_network=loss.actor_critic))``.

    Args:
        low: Smallest return that is possible.
        high: Largest return that is possible.
        **kwargs: See :class:`~torchrl.objectives.value.TD0Estimator`.

    Raises:
        ValueError: If ``low`` is not below ``high``.
    """

    def __init__(self, *, low: float, high: float, **kwargs: Any) -> None:
        if not low < high:
            raise ValueError(f"low={low} must be below high={high}: they bound the return.")
        super().__init__(**kwargs)
        self.low, self.high = low, high

    def value_estimate(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Tensor:
        """Returns the clipped target ``[*B, 1]``; arguments as in TD0Estimator."""
        return super().value_estimate(tensordict, *args, **kwargs).clamp(self.low, self.high)


def set_targets(
    loss: LossModule, config: AgentConfig, *, value_network: TensorDictModuleBase | None, keys: Keys
) -> None:
    """Makes a loss bootstrap as configured, from rewards and flags under the given keys.

    Rows that span several steps say so under ``"steps_to_next_obs"`` ``[1]``: their next value is discounted as often.

    Args:
        loss: TorchRL's.
        config: Gives the discount, and whether targets are clipped to [-1, 1].
        value_network: Gives the values of next states; None if the loss does.
        keys: Where rows keep what.
    """
    if config.clip_targets:
        device = next(loss.parameters()).device
        estimator = ClippedTD0Estimator(
            low=-1.0, high=1.0, gamma=config.discount, value_network=value_network, device=device
        )
        loss.make_value_estimator(estimator)
    else:
        loss.make_value_estimator(ValueEstimators.TD0, gamma=config.discount)
    loss.set_keys(reward=keys.reward, done=keys.done, terminated=keys.terminated)
