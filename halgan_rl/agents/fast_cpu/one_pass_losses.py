"""TorchRL's losses of our agents, with as few passes through their convolutions as there can be.

The values and gradients are those of the losses from which they derive, except for rounding. Those run each network by
itself, and the critic twice on the same frame; here networks that see the same frames share a pass
(:func:`~halgan_rl.agents.fast_cpu.block_encoder.encode_together`), and nothing is computed twice. Networks are kept as
modules that hold the loss's own parameters: filling one with parameters at each call, as TorchRL does, costs more than
all that is not convolution.

A loss becomes one of these in place: see :func:`share_passes`.

Shapes: B is the batch, ``[*B]``, N the product of its dimensions; F are features, A is the action's size.
"""

import copy
from functools import cached_property
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential, dispatch
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.objectives import DQNLoss, LossModule
from torchrl.objectives.utils import distance_loss

from halgan_rl.agents.action_bounds import BoundedTanh
from halgan_rl.agents.ddpg import Actor, Critic, UnsaturatedDDPGLoss
from halgan_rl.agents.ddqn import FirstBest, QNetwork
from halgan_rl.agents.fast_cpu.block_encoder import encode_together, fits
from halgan_rl.keys import next_key


class _OnePassLoss(LossModule):
    """A loss whose networks are at hand as modules."""

    def _modules_of(self, network: str) -> tuple[Any, Any]:
        """Returns a network and its target network, which hold the loss's parameters themselves."""
        children = dict(self.named_children())  # as attributes, TorchRL warns that no updater is known yet
        module = getattr(self, network)
        return filled(module, children[f"{network}_params"]), filled(module, children[f"target_{network}_params"])

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._erase_cache()  # of a copy: its networks hold parameters of its own


def filled(network: nn.Module, parameters: TensorDictBase) -> Any:
    """Returns a copy of a network that has other parameters: these very tensors, so that it follows their changes."""
    copied = copy.deepcopy(network)
    parameters.to_module(copied)
    return copied


def _pass_through(head: nn.Sequential, features: Tensor) -> Tensor:
    """Returns what a head makes of features, with gradients for these only."""
    for layer in head:
        if isinstance(layer, nn.Linear):
            features = F.linear(features, layer.weight.detach(), layer.bias.detach())
        else:
            features = layer(features)
    return features


class OnePassDDPGLoss(_OnePassLoss, UnsaturatedDDPGLoss):
    """:class:`~halgan_rl.agents.ddpg.UnsaturatedDDPGLoss` of an actor and a critic, with a target network each.

    Both losses share a graph: add them up before ``backward``; neither depends on the other's network. Backward through
    one alone works once (PyTorch's ``retain_graph`` allows more), and then the convolutions of the other network get
    gradients of zero, where TorchRL's loss gives none.
    """

    @cached_property  # TorchRL erases what is called _cached... when the parameters move
    def _cached_networks(self) -> tuple[tuple[Actor, Critic], tuple[Actor, Critic]]:
        actors, critics = self._modules_of("actor_network"), self._modules_of("value_network")
        online, target = ((actor[0].module, critic.module) for actor, critic in zip(actors, critics, strict=True))
        return online, target

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Returns the losses and metrics of TorchRL's DDPGLoss; writes the priorities."""
        (actor, critic), _ = self._cached_networks
        target = self._target_value(tensordict)  # [*B]
        pixels_key, action_key = self.value_network.in_keys
        pixels, action = tensordict.get(pixels_key), tensordict.get(action_key).detach()  # [*B, H, W, C], [*B, A]
        shape = pixels.shape[:-3]

        # Actor and critic see s in one pass: [*B, H, W, C] -> [N, F] each.
        actor_features, critic_features = encode_together(pixels, [actor.encoder, critic.encoder])

        # The value of the action that was taken: [N, F] and [N, A] -> [N, 1] -> [*B].
        unit_action = critic.scale.to_unit(action).reshape(-1, action.shape[-1])
        value = critic.judge(critic_features, unit_action).reshape(shape)

        # The value of the actor's own action, [N, F] -> [N, A] -> [N], with gradients for the actor only.
        preactivation = actor.head(actor_features)
        joined = torch.cat([critic_features.detach(), preactivation.tanh()], -1)
        reached = _pass_through(critic.head, joined).squeeze(-1)
        penalty = self.preactivation_weight * preactivation.square().mean(-1)

        td_error = (value - target).square().detach()
        tensordict.set(self.tensor_keys.priority, td_error, inplace=True)
        losses = {
            "loss_actor": (penalty - reached).reshape(shape),
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
        """Returns the targets ``[*B]`` of the values."""
        _, (actor, critic) = self._cached_networks
        pixels = tensordict.get(next_key(self.value_network.in_keys[0]))

        # The target networks see s' in one pass, and the critic values the actor's action there: [*B, 1].
        actor_features, critic_features = encode_together(pixels, [actor.encoder, critic.encoder])
        value = critic.judge(critic_features, actor.head(actor_features).tanh()).reshape(*pixels.shape[:-3], 1)
        return self.value_estimator.value_estimate(tensordict, next_value=value).squeeze(-1)


class OnePassDQNLoss(_OnePassLoss, DQNLoss):
    """TorchRL's DQNLoss of a network of action values, with one-hot actions and a target network."""

    @cached_property
    def _cached_networks(self) -> tuple[QNetwork, QNetwork]:
        online, target = self._modules_of("value_network")
        return online[0].module, target[0].module

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Returns the loss of TorchRL's DQNLoss; writes the priorities."""
        target = self._target_value(tensordict)  # [*B]
        network, pixels = self._cached_networks[0], tensordict.get(self.value_network.in_keys[0])

        # The values of all actions at s, and that of the action that was taken: [*B, A] -> [*B].
        (features,) = encode_together(pixels, [network.encoder])
        values = network.head(features).reshape(*pixels.shape[:-3], -1)
        value = (values * tensordict.get(self.tensor_keys.action).to(values.dtype)).sum(-1)

        error = (value - target).square().detach()
        tensordict.set(self.tensor_keys.priority, error.unsqueeze(-1), inplace=True)
        loss = distance_loss(value, target, self.loss_function)
        weights = self._maybe_get_priority_weight(tensordict)
        return TensorDict({"loss": self._reduce_loss(loss, tensordict=tensordict, weights=weights)})

    @torch.no_grad()
    def _target_value(self, tensordict: TensorDictBase) -> Tensor:
        """Returns the targets ``[*B]`` of the values."""
        pixels = tensordict.get(next_key(self.value_network.in_keys[0]))

        # The target network and, if double, the network itself see s' in one pass: [*B, H, W, C] -> [N, A] each.
        online, target = self._cached_networks
        networks = [target, online] if self.double_dqn else [target]
        features = encode_together(pixels, [network.encoder for network in networks])
        valued, *chosen = (network.head(seen) for network, seen in zip(networks, features, strict=True))

        # The first best action of the one, valued by the other: [N, A] -> [N, 1] -> [*B, 1].
        best = (chosen[0] if chosen else valued).argmax(-1, keepdim=True)
        value = valued.gather(-1, best).reshape(*pixels.shape[:-3], 1)
        return self.value_estimator.value_estimate(tensordict, next_value=value).squeeze(-1)


def share_passes(loss: LossModule) -> bool:
    """Makes a loss of our agents share passes, in place: the same parameters and targets, another ``forward``.

    Returns:
        Whether it does: the loss is TorchRL's with our networks and their usual layers, on a CPU.
    """
    if isinstance(loss, _OnePassLoss):
        return True
    if not next(loss.parameters()).is_cpu:
        return False
    if type(loss) is UnsaturatedDDPGLoss:
        parts = [*_parts(loss.actor_network), *_parts(loss.value_network)]
        wanted, fast = [Actor, BoundedTanh, Critic], OnePassDDPGLoss
    elif type(loss) is DQNLoss and loss.delay_value:
        parts, wanted, fast = _parts(loss.value_network), [QNetwork, FirstBest], OnePassDQNLoss
    else:
        return False
    if [type(part) for part in parts] != wanted or not all(_is_usual(part) for part in parts):
        return False
    loss.__class__ = fast
    _ = loss._cached_networks  # now: where the loss is compiled is no place to copy networks
    return True


def _parts(network: nn.Module) -> list[nn.Module]:
    """Returns the modules of a network that reads and writes a TensorDict, one after another."""
    modules = network.module if isinstance(network, TensorDictSequential) else [network]
    return [part.module if isinstance(part, TensorDictModule) else part for part in modules]


def _is_usual(part: nn.Module) -> bool:
    """Whether an encoder fits, and all that learns behind it are linear layers: see :func:`_pass_through`."""
    if not isinstance(part, Actor | Critic | QNetwork):
        return True
    learning = [layer for layer in part.head if next(layer.parameters(), None) is not None]
    return fits(part.encoder) and all(type(layer) is nn.Linear for layer in learning)
