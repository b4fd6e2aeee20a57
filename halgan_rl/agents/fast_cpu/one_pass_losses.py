"""TorchRL's losses of our agents, with as few passes through their convolutions as there can be.

The values and gradients are those of the losses that they derive from, but for rounding. Those ask each network for
itself, and the critic twice about the same frame; here networks that see the same frames share a pass
(:func:`halgan_rl.agents.networks.see`), and nothing is asked twice. Networks are kept as modules that hold the loss's own
parameters: filling one with parameters at each call, as TorchRL does, costs more than all that is not convolution.
"""

import copy
from functools import cached_property
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.objectives import DQNLoss, LossModule
from torchrl.objectives.utils import distance_loss

from halgan_rl.agents.networks import Actor, Critic, QNetwork, deterministic_policy, greedy_policy, see
from halgan_rl.agents.objectives import UnsaturatedDDPGLoss
from halgan_rl.keys import next_key


class _OnePassLoss(LossModule):
    """A loss whose networks are at hand as modules."""

    def _modules_of(self, network: str) -> tuple[Any, Any]:
        """Return a network and its target network, which hold the loss's parameters themselves."""
        children = dict(self.named_children())  # asked by name, TorchRL warns that no updater is known yet
        module = getattr(self, network)
        return filled(module, children[f"{network}_params"]), filled(module, children[f"target_{network}_params"])

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._erase_cache()  # of a copy: its networks hold parameters of its own


def filled(network: nn.Module, parameters: TensorDictBase) -> Any:
    """Return a copy of a network that has other parameters: these very tensors, so that it follows their changes."""
    copied = copy.deepcopy(network)
    parameters.to_module(copied)
    return copied


def _pass_through(head: nn.Sequential, features: Tensor) -> Tensor:
    """Return what a head makes of features, with gradients for these only."""
    for layer in head:
        if isinstance(layer, nn.Linear):
            features = F.linear(features, layer.weight.detach(), layer.bias.detach())
        else:
            features = layer(features)
    return features


class OnePassDDPGLoss(_OnePassLoss, UnsaturatedDDPGLoss):
    """:class:`halgan_rl.agents.objectives.UnsaturatedDDPGLoss` of an actor and a critic, with a target network each.

    Both losses share a graph: add them up before ``backward``; neither depends on the other's network. Backward through
    one alone works once (PyTorch's ``retain_graph`` allows more), and then the convolutions of the other network get
    gradients of zero, where TorchRL's loss gives none.

    Args:
        actor: its parameters are trained where they are.
        critic: likewise, with the same down-sampling.
        pixels_key: images uint8 ``[..., 64, 64, 3]``, also below ``"next"``.
        action_key: actions taken, ``[..., A]``.
        **kwargs: see :class:`halgan_rl.agents.objectives.UnsaturatedDDPGLoss`.

    Raises:
        ValueError: with ``separate_losses``, which is for networks that share parameters.
    """

    def __init__(
        self,
        actor: Actor,
        critic: Critic,
        *,
        pixels_key: NestedKey = "pixels",
        action_key: NestedKey = "action",
        preactivation_key: NestedKey = "preactivation",
        **kwargs: Any,
    ) -> None:
        if kwargs.get("separate_losses"):
            raise ValueError(
                "separate_losses=True is for networks that share parameters: use UnsaturatedDDPGLoss for them"
            )
        policy = deterministic_policy(
            actor, pixels_key=pixels_key, preactivation_key=preactivation_key, action_key=action_key
        )
        judge = TensorDictModule(critic, in_keys=[pixels_key, action_key], out_keys=["state_action_value"])
        super().__init__(
            policy, judge, delay_actor=True, delay_value=True, preactivation_key=preactivation_key, **kwargs
        )
        self.pixels_key, self.action_key = pixels_key, action_key
        _ = self._cached_networks  # now: where the loss is compiled is no place to copy networks

    @cached_property  # TorchRL erases what is called _cached... when the parameters move
    def _cached_networks(self) -> tuple[tuple[Actor, Critic], tuple[Actor, Critic]]:
        actors, critics = self._modules_of("actor_network"), self._modules_of("value_network")
        online, target = ((actor[0].module, critic.module) for actor, critic in zip(actors, critics, strict=True))
        return online, target

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses and figures of TorchRL's DDPGLoss; write the priorities."""
        (actor, critic), _ = self._cached_networks
        target = self._target_value(tensordict)
        pixels, action = tensordict.get(self.pixels_key), tensordict.get(self.action_key).detach()
        shape = pixels.shape[:-3]
        actor_features, critic_features = see(pixels, [actor.vision, critic.vision])
        value = critic.judge(critic_features, action.reshape(-1, action.shape[-1])).reshape(shape)
        preactivation = actor.head(actor_features)
        joined = torch.cat([critic_features.detach(), preactivation.tanh()], -1)
        reached = _pass_through(critic.head, joined).squeeze(-1)
        price = self.preactivation_weight * preactivation.square().mean(-1)

        td_error = (value - target).square().detach()
        tensordict.set(self.tensor_keys.priority, td_error, inplace=True)
        losses = {
            "loss_actor": (price - reached).reshape(shape),
            "loss_value": distance_loss(value, target, loss_function=self.loss_function),
        }
        weights = self._maybe_get_priority_weight(tensordict)
        losses = {
            name: self._reduce_loss(loss, tensordict=tensordict, weights=weights) for name, loss in losses.items()
        }
        predicted = value.detach()
        return TensorDict(
            {
                **losses,
                "td_error": td_error,
                "pred_value": predicted,
                "target_value": target,
                "target_value_max": target.max(),
                "pred_value_max": predicted.max(),
            }
        )

    @torch.no_grad()
    def _target_value(self, tensordict: TensorDictBase) -> Tensor:
        _, (actor, critic) = self._cached_networks
        pixels = tensordict.get(next_key(self.pixels_key))
        actor_features, critic_features = see(pixels, [actor.vision, critic.vision])
        value = critic.judge(critic_features, actor.head(actor_features).tanh()).reshape(*pixels.shape[:-3], 1)
        return self.value_estimator.value_estimate(tensordict, next_value=value).squeeze(-1)


class OnePassDQNLoss(_OnePassLoss, DQNLoss):
    """TorchRL's DQNLoss of a network of action values, with one-hot actions and a target network.

    Args:
        network: its parameters are trained where they are.
        double: whether the network itself chooses the action that the target network values (van Hasselt et al., "Deep
            Reinforcement Learning with Double Q-learning", 2016).
        pixels_key: images uint8 ``[..., 64, 64, 3]``, also below ``"next"``.
        **kwargs: see :class:`~torchrl.objectives.DQNLoss`.
    """

    def __init__(
        self, network: QNetwork, *, double: bool = True, pixels_key: NestedKey = "pixels", **kwargs: Any
    ) -> None:
        policy = greedy_policy(network, pixels_key=pixels_key)
        super().__init__(policy, delay_value=True, double_dqn=double, action_space="one_hot", **kwargs)
        self.pixels_key = pixels_key
        _ = self._cached_networks  # now: where the loss is compiled is no place to copy networks

    @cached_property
    def _cached_networks(self) -> tuple[QNetwork, QNetwork]:
        online, target = self._modules_of("value_network")
        return online[0].module, target[0].module

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss of TorchRL's DQNLoss; write the priorities."""
        target = self._target_value(tensordict)
        values = self._cached_networks[0](tensordict.get(self.pixels_key))
        value = (values * tensordict.get(self.tensor_keys.action).to(values.dtype)).sum(-1)
        error = (value - target).square().detach()
        tensordict.set(self.tensor_keys.priority, error.unsqueeze(-1), inplace=True)
        loss = distance_loss(value, target, self.loss_function)
        weights = self._maybe_get_priority_weight(tensordict)
        return TensorDict({"loss": self._reduce_loss(loss, tensordict=tensordict, weights=weights)})

    @torch.no_grad()
    def _target_value(self, tensordict: TensorDictBase) -> Tensor:
        pixels = tensordict.get(next_key(self.pixels_key))
        online, target = self._cached_networks
        networks = [target, online] if self.double_dqn else [target]
        features = see(pixels, [network.vision for network in networks])
        valued, *chosen = (network.head(seen) for network, seen in zip(networks, features, strict=True))
        best = (chosen[0] if chosen else valued).argmax(-1, keepdim=True)
        value = valued.gather(-1, best).reshape(*pixels.shape[:-3], 1)
        return self.value_estimator.value_estimate(tensordict, next_value=value).squeeze(-1)
