"""DDPG for sparse, bounded returns: targets that no return exceeds, and an actor that does not saturate."""

from typing import Any

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives import DDPGLoss
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


class UnsaturatedDDPGLoss(DDPGLoss):
    """DDPG whose actor pays for the square of what goes into its tanh.

    Before the critic has learned where reward is, its slope is much the same everywhere, and the actor follows it to a
    corner of the action space, for all images alike. The tanh is flat there: nothing leads back. A small price on the
    pre-activations keeps the slope (Andrychowicz et al., "Hindsight Experience Replay", 2017, appendix A).

    The actor must write ``preactivation_key`` beside its action, see
    :func:`halgan_rl.agents.networks.deterministic_policy`.

    Args:
        *args: see :class:`~torchrl.objectives.DDPGLoss`.
        preactivation_weight: the price; 0 is TorchRL's own loss.
        preactivation_key: what goes into the tanh, ``[..., A]``.
        **kwargs: see :class:`~torchrl.objectives.DDPGLoss`.

    Raises:
        ValueError: if the weight is negative.
        KeyError: if the actor does not write ``preactivation_key``.
    """

    def __init__(
        self,
        *args: Any,
        preactivation_weight: float = 1e-4,
        preactivation_key: NestedKey = "preactivation",
        **kwargs: Any,
    ) -> None:
        if preactivation_weight < 0:
            raise ValueError(f"preactivation_weight must not be negative, got {preactivation_weight}")
        super().__init__(*args, **kwargs)
        self.preactivation_weight = preactivation_weight
        self.preactivation_key = preactivation_key

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the actor's loss and nothing to log; arguments as in DDPGLoss."""
        observed = tensordict.select(*self.actor_in_keys, *self.value_exclusive_keys, strict=False).detach()
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            acted = self.actor_network(observed)
        with self._cached_detached_value_params.to_module(self.value_network, preserve_module_state=False):
            value = self.value_network(acted).get(self.tensor_keys.state_action_value)
        price = self.preactivation_weight * acted.get(self.preactivation_key).square().mean(-1)
        loss = self._reduce_loss(
            price - value.squeeze(-1), tensordict=tensordict, weights=self._maybe_get_priority_weight(tensordict)
        )
        self._clear_weakrefs(tensordict, loss, "value_network_params", "actor_network_params")
        return loss, {}
