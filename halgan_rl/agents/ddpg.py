"""DDPG on camera images, out of TorchRL's parts (Lillicrap et al., "Continuous control with deep RL", 2016)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, SoftUpdate

from halgan_rl.agents.action_bounds import ActionScale, BoundedTanh, bounds_of
from halgan_rl.agents.agent import Agent, AgentConfig, Algorithm, make_epsilon_greedy, on_cpu
from halgan_rl.agents.clipped_targets import set_targets
from halgan_rl.agents.encoder import Downsample, Encoder, ImageShape, make_head
from halgan_rl.keys import Keys
from halgan_rl.transforms.annealing import Annealing

SMALL = 3e-3
"""Bound on what the actor's last layer starts from (Lillicrap et al. 2016, section 7)."""
METRICS = {"pred_value": "q_value", "loss_value": "loss_value", "loss_actor": "loss_actor"}
"""Which of the loss's outputs are reported, and as what."""


@dataclass(frozen=True)
class DDPGConfig(AgentConfig):
    """Configuration of a DDPG agent."""

    actor_learning_rate: float = 1e-4
    """Adam's learning rate for the actor."""
    critic_learning_rate: float = 1e-3
    """Adam's learning rate for the critic."""
    preactivation_weight: float = 1e-3
    """Penalty weight of the square of what goes into the actor's tanh."""
    small_output: bool = True
    """Start the actor's last layer near zero."""
    noise: float = 0.1
    """Standard deviation of the Gaussian noise on the actions, as a fraction of half their range."""


PAPER = DDPGConfig(
    discount=0.99,
    tau=1e-3,
    clip_targets=False,
    downsample="max_pool",
    epsilon=Annealing(1.0, 0.5, 100_000),
    actor_learning_rate=1e-5,
    critic_learning_rate=1e-4,
    preactivation_weight=0.0,
    small_output=False,
)
"""What the paper's tables say for tasks with continuous actions (Sahni et al., NeurIPS 2019, appendix)."""


class Actor(nn.Module):
    """The actor of DDPG, up to the tanh that bounds its actions: 33,642 parameters for images 64x64x3 and 2 actions.

    :func:`deterministic_policy` adds the tanh. It is kept apart because the loss needs what goes into it: see
    :class:`UnsaturatedDDPGLoss`.

    Args:
        image_shape: Height, width and channels.
        low: Lowest value of each entry of an action, ``[A]``.
        high: Highest value of each entry, ``[A]``.
        downsample: See :class:`~halgan_rl.agents.encoder.Encoder`.
        small_output: Start the last layer's weights and biases within 3e-3 of zero, as DDPG does: the actions of an
            untrained policy are then near the middle of their bounds, for all images.

    Attributes:
        kind: What manifests call such networks.
        arguments: What rebuilds the network, ready for JSON.

    Examples:
        >>> from tensordict import TensorDict
        >>> images = torch.zeros(5, 64, 64, 3, dtype=torch.uint8)
        >>> deterministic_policy(Actor())(TensorDict({"pixels": images}, batch_size=[5]))["action"].shape
        torch.Size([5, 2])
    """

    kind = "actor"

    def __init__(
        self,
        image_shape: Iterable[int] = (64, 64, 3),
        *,
        low: Sequence[float] = (-1.0, -1.0),
        high: Sequence[float] = (1.0, 1.0),
        downsample: Downsample = "stride",
        small_output: bool = True,
    ) -> None:
        super().__init__()
        self.encoder = Encoder(image_shape, downsample)
        self.head = make_head(self.encoder.features, len(low))
        if small_output:
            for parameter in self.head[-1].parameters():
                nn.init.uniform_(parameter, -SMALL, SMALL)
        self.low, self.high = low, high
        self.arguments: dict[str, Any] = {
            "image_shape": list(self.encoder.image_shape),
            "low": list(low),
            "high": list(high),
            "downsample": downsample,
        }

    def forward(self, pixels: Tensor) -> Tensor:
        """Returns unbounded pre-activations ``[..., A]`` for images uint8 ``[..., H, W, C]``."""
        return self.head(self.encoder(pixels)).reshape(*pixels.shape[:-3], -1)


def deterministic_policy(
    actor: Actor,
    *,
    keys: Keys = Keys(),
    preactivation_key: NestedKey = "preactivation",
) -> TensorDictSequential:
    """Returns the policy of an actor: reads images, writes actions within their bounds and what went into their tanh.

    Args:
        actor: The network.
        keys: Names of the images and actions.
        preactivation_key: Where to write what goes into the tanh, unbounded, ``[..., A]``.
    """
    squash = BoundedTanh(actor.low, actor.high).to(next(actor.parameters()).device)
    return TensorDictSequential(
        TensorDictModule(actor, in_keys=[keys.pixels], out_keys=[preactivation_key]),
        TensorDictModule(squash, in_keys=[preactivation_key], out_keys=[keys.action]),
    )


class Critic(nn.Module):
    """The value of an action in DDPG: 33,673 parameters for images 64x64x3 and 2 actions.

    The action, scaled to [-1, 1], joins the flattened features.

    Args:
        image_shape: Height, width and channels.
        low: Lowest value of each entry of an action, ``[A]``.
        high: Highest value of each entry, ``[A]``.
        downsample: See :class:`~halgan_rl.agents.encoder.Encoder`.
    """

    def __init__(
        self,
        image_shape: Iterable[int] = (64, 64, 3),
        *,
        low: Sequence[float] = (-1.0, -1.0),
        high: Sequence[float] = (1.0, 1.0),
        downsample: Downsample = "stride",
    ) -> None:
        super().__init__()
        self.encoder = Encoder(image_shape, downsample)
        self.head = make_head(self.encoder.features + len(low), 1)
        self.scale = ActionScale(low, high)

    def forward(self, pixels: Tensor, action: Tensor) -> Tensor:
        """Returns values ``[..., 1]`` for images uint8 ``[..., H, W, C]`` and actions ``[..., A]``."""
        unit_action = self.scale.to_unit(action).reshape(-1, action.shape[-1])
        return self.judge(self.encoder(pixels), unit_action).reshape(*pixels.shape[:-3], 1)

    def judge(self, features: Tensor, unit_action: Tensor) -> Tensor:
        """Returns values ``[N, 1]`` for features ``[N, F]`` and actions ``[N, A]`` scaled to [-1, 1]."""
        return self.head(torch.cat([features, unit_action.to(features.dtype)], -1))


class UnsaturatedDDPGLoss(DDPGLoss):
    """DDPG with a penalty on the square of what goes into the actor's tanh.

    Before the critic has learned where reward is, its slope is much the same everywhere, and the actor follows it to a
    corner of the action space, for all images alike. The tanh is flat there: nothing leads back. A small penalty on the
    pre-activations keeps the slope (Andrychowicz et al., "Hindsight Experience Replay", 2017, appendix A).

    Args:
        *args: See :class:`~torchrl.objectives.DDPGLoss`. The actor writes ``preactivation_key`` beside its action, see
            :func:`deterministic_policy`.
        preactivation_weight: The penalty's weight; 0 is TorchRL's own loss.
        preactivation_key: What goes into the tanh, ``[..., A]``.
        **kwargs: See :class:`~torchrl.objectives.DDPGLoss`.

    Raises:
        ValueError: If the weight is negative.
        KeyError: If the actor does not write ``preactivation_key``.
    """

    def __init__(
        self,
        *args: Any,
        preactivation_weight: float = 1e-4,
        preactivation_key: NestedKey = "preactivation",
        **kwargs: Any,
    ) -> None:
        if preactivation_weight < 0:
            raise ValueError(f"preactivation_weight must not be negative, got {preactivation_weight}.")
        super().__init__(*args, **kwargs)
        self.preactivation_weight = preactivation_weight
        self.preactivation_key = preactivation_key

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the actor's loss and nothing to log; arguments as in DDPGLoss."""
        observed = tensordict.select(*self.actor_in_keys, *self.value_exclusive_keys, strict=False).detach()
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            acted = self.actor_network(observed)
        with self._cached_detached_value_params.to_module(self.value_network, preserve_module_state=False):
            value = self.value_network(acted).get(self.tensor_keys.state_action_value)
        penalty = self.preactivation_weight * acted.get(self.preactivation_key).square().mean(-1)
        loss = self._reduce_loss(
            penalty - value.squeeze(-1), tensordict=tensordict, weights=self._maybe_get_priority_weight(tensordict)
        )
        self._clear_weakrefs(tensordict, loss, "value_network_params", "actor_network_params")
        return loss, {}


def make_agent(
    config: DDPGConfig,
    *,
    action_spec: TensorSpec,
    image_shape: ImageShape,
    keys: Keys = Keys(),
    device: torch.device | str = "cpu",
) -> Agent:
    """Returns actor and critic, both on the camera image alone, how the actor explores, and how they learn.

    Args:
        config: The configuration.
        action_spec: Actions ``[A]`` with finite bounds, which the policy and its exploration keep.
        image_shape: Height, width and channels.
        keys: Where rows keep what.
        device: Where to learn.

    Raises:
        ValueError: If the actions are discrete or unbounded.
    """
    low, high = bounds_of(action_spec, "DDPG")

    # Networks, in this order: it is the order of the random numbers that they start from.
    actor = Actor(image_shape, low=low, high=high, downsample=config.downsample, small_output=config.small_output).to(
        device
    )
    acting = on_cpu(actor)
    critic = Critic(image_shape, low=low, high=high, downsample=config.downsample).to(device)

    # Exploration: Gaussian noise, and uniformly random actions.
    noise = AdditiveGaussianModule(
        action_spec,
        sigma_init=config.noise,
        sigma_end=config.noise,
        std=[(most - least) / 2 for least, most in zip(low, high, strict=True)],
        action_key=keys.action,
    )
    epsilon_greedy = make_epsilon_greedy(config.epsilon, action_spec, keys)

    loss = make_loss(config, actor, critic, keys)
    return Agent(
        network=actor,
        acting=acting,
        make_policy=partial(deterministic_policy, keys=keys),
        explorer=TensorDictSequential(deterministic_policy(acting, keys=keys), noise, epsilon_greedy),
        epsilon_greedy=epsilon_greedy,
        loss=loss,
        optimizer=make_optimizer(config, loss),
        target_updater=SoftUpdate(loss, tau=config.tau),
        metrics=METRICS,
        image_shape=actor.encoder.image_shape,
        keys=keys,
    )


def make_loss(config: DDPGConfig, actor: Actor, critic: Critic, keys: Keys) -> UnsaturatedDDPGLoss:
    """Returns the loss, with a target network for each network."""
    loss = UnsaturatedDDPGLoss(
        deterministic_policy(actor, keys=keys),
        TensorDictModule(critic, in_keys=[keys.pixels, keys.action], out_keys=["state_action_value"]),
        delay_actor=True,
        delay_value=True,
        preactivation_weight=config.preactivation_weight,
    )
    set_targets(loss, config, value_network=loss.actor_critic, keys=keys)
    return loss


def make_optimizer(config: DDPGConfig, loss: DDPGLoss) -> torch.optim.Optimizer:
    """Returns one Adam for both networks, with a learning rate for each."""
    rates = (config.actor_learning_rate, config.critic_learning_rate)
    groups = zip((loss.actor_network_params, loss.value_network_params), rates, strict=True)
    return torch.optim.Adam(
        [{"params": list(parameters.parameters()), "lr": rate} for parameters, rate in groups], fused=True
    )


ALGORITHM = Algorithm(DDPGConfig, make_agent, Actor, deterministic_policy)
