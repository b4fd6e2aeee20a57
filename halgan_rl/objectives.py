"""Value targets for sparse, bounded returns."""

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives.value import TD0Estimator


class ClippedTD0Estimator(TD0Estimator):
    r"""TD(0) targets clipped to the range that a return can take.

    With one reward of 1 at the goal and small costs before it, no return exceeds 1. A critic that is fed by its own
    maximum drifts above that bound, the deterministic policy saturates and the agent circles. Clipping the target
    :math:`r + \gamma (1 - \text{terminated}) V'` ends this (as in HER, Andrychowicz et al. 2017, section 4.1).

    Pass it to any TorchRL loss: ``loss.make_value_estimator(ClippedTD0Estimator(low=-1.0, high=1.0, gamma=0.99,
    value_network=loss.actor_critic))``.

    Args:
        low: smallest return that is possible.
        high: largest return that is possible.
        **kwargs: see :class:`~torchrl.objectives.value.TD0Estimator`.

    Raises:
        ValueError: if ``low`` is not below ``high``.
    """

    def __init__(self, *, low: float, high: float, **kwargs: Any) -> None:
        if not low < high:
            raise ValueError(f"low={low} must be below high={high}: they bound the return")
        super().__init__(**kwargs)
        self.low, self.high = low, high

    def value_estimate(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Tensor:
        """Return the clipped target, shape ``[*B, 1]``; arguments as in TD0Estimator."""
        return super().value_estimate(tensordict, *args, **kwargs).clamp(self.low, self.high)
