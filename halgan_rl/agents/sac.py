"""SAC on camera images, out of TorchRL's parts (Haarnoja et al., "Soft Actor-Critic Algorithms", 2018).

Its entropy coefficient is small, and so is its learning rate: returns lie in [-1, 1], and a bonus for entropy at each
step that adds up to more than the reward at the goal would pay for staying away from it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from tensordict.nn.distributions import NormalParamExtractor
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from halgan_rl.agents.action_bounds import BoundedTanh, Bounds, bounds_of
from halgan_rl.agents.agent import Agent, AgentConfig, Algorithm, make_epsilon_greedy, on_cpu
from halgan_rl.agents.clipped_targets import set_targets
from halgan_rl.agents.ddpg import Critic
from halgan_rl.agents.encoder import Downsample, Encoder, ImageShape, make_head
from halgan_rl.keys import Keys

METRICS = {
    "loss_qvalue": "loss_value",
    "loss_actor": "loss_actor",
    "entropy": "entropy",
    "alpha": "entropy_coefficient",
}
"""Which of the loss's outputs are reported, and as what."""
SMALLEST_DEVIATION = 0.1
"""Smallest standard deviation of the policy before its tanh."""


@dataclass(frozen=True)
class SACConfig(AgentConfig):
    """Configuration of a SAC agent."""

    actor_learning_rate: float = 3e-4
    """Adam's learning rate for the actor."""
    critic_learning_rate: float = 1e-3
    """Adam's learning rate for the two critics."""
    alpha: float = 0.001
    """Entropy coefficient, at first: what a nat of entropy at one step is worth in reward. With 0.01 a run had 8 %
    success after 6,000 frames of Navigate, with 0.001 another had 27 %."""
    learn_alpha: bool = True
    """Learn the entropy coefficient, so that the policy's entropy comes to ``target_entropy``."""
    alpha_learning_rate: float = 3e-4
    """Adam's learning rate for the logarithm of the entropy coefficient."""
    alpha_bounds: tuple[float, float] = (1e-4, 0.02)
    """Bounds of an entropy coefficient that is learned."""
    target_entropy: float = -1.0
    """Entropy to come to, in nats for each entry of an action scaled to [-1, 1]; uniform actions have 0.69."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        super().__post_init__()
        least, most = self.alpha_bounds
        if not 0 < least <= self.alpha <= most:
            raise ValueError(f"alpha={self.alpha} must be positive and within alpha_bounds={self.alpha_bounds}.")


class SACActor(nn.Module):
    """The actor of SAC, up to the tanh: mean and standard deviation of a normal distribution.

    It has 33,708 parameters for images 64x64x3 and 2 actions.

    Args:
        image_shape: Height, width and channels.
        low: Lowest value of each entry of an action, ``[A]``.
        high: Highest value of each entry, ``[A]``.
        downsample: See :class:`~halgan_rl.agents.encoder.Encoder`.

    Attributes:
        kind: What manifests call such networks.
        arguments: What rebuilds the network, ready for JSON.
    """

    kind = "sac_actor"

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
        self.head = make_head(self.encoder.features, 2 * len(low))
        self.split = NormalParamExtractor("biased_softplus_1.0", scale_lb=SMALLEST_DEVIATION)
        self.low, self.high = low, high
        self.arguments: dict[str, Any] = {
            "image_shape": list(self.encoder.image_shape),
            "low": list(low),
            "high": list(high),
            "downsample": downsample,
        }

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation, ``[..., A]`` each, for images uint8 ``[..., H, W, C]``."""
        return self.split(self.head(self.encoder(pixels)).reshape(*pixels.shape[:-3], -1))


def deterministic_policy(actor: SACActor, *, keys: Keys = Keys()) -> TensorDictSequential:
    """Returns the policy that acts by the mean: reads images, writes actions within their bounds."""
    squash = BoundedTanh(actor.low, actor.high).to(next(actor.parameters()).device)
    return TensorDictSequential(
        TensorDictModule(actor, in_keys=[keys.pixels], out_keys=["loc", "scale"]),
        TensorDictModule(squash, in_keys=["loc"], out_keys=[keys.action]),
    )


def stochastic_policy(actor: SACActor, *, keys: Keys = Keys()) -> ProbabilisticActor:
    """Returns the policy that draws: reads images, writes actions within their bounds."""
    device = next(actor.parameters()).device
    unit = {*actor.low, -1.0} == {-1.0} and {*actor.high, 1.0} == {1.0}
    low, high = (torch.tensor(bound, device=device) for bound in (actor.low, actor.high))
    return ProbabilisticActor(
        TensorDictModule(actor, in_keys=[keys.pixels], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[keys.action],
        distribution_class=TanhNormal,
        distribution_kwargs={} if unit else {"low": low, "high": high},
    )


def make_agent(
    config: SACConfig,
    *,
    action_spec: TensorSpec,
    image_shape: ImageShape,
    keys: Keys = Keys(),
    device: torch.device | str = "cpu",
) -> Agent:
    """Returns an actor and two critics, all on the camera image alone, how the actor explores, and how they learn.

    Args:
        config: The configuration.
        action_spec: Actions ``[A]`` with finite bounds, which the policy keeps.
        image_shape: Height, width and channels.
        keys: Where rows keep what.
        device: Where to learn.

    Raises:
        ValueError: If the actions are discrete or unbounded.
    """
    low, high = bounds = bounds_of(action_spec, "SAC")
    actor = SACActor(image_shape, low=low, high=high, downsample=config.downsample).to(device)
    acting = on_cpu(actor)
    critics = [Critic(image_shape, low=low, high=high, downsample=config.downsample).to(device) for _ in range(2)]
    epsilon_greedy = make_epsilon_greedy(config.epsilon, action_spec, keys) if config.epsilon.start > 0 else None
    explorer = [stochastic_policy(acting, keys=keys), *([epsilon_greedy] if epsilon_greedy else [])]
    loss = make_loss(config, actor, critics, bounds, keys)
    return Agent(
        network=actor,
        acting=acting,
        make_policy=partial(deterministic_policy, keys=keys),
        explorer=TensorDictSequential(*explorer),
        epsilon_greedy=epsilon_greedy,
        loss=loss,
        optimizer=make_optimizer(config, loss),
        target_updater=SoftUpdate(loss, tau=config.tau),
        metrics=METRICS,
        image_shape=actor.encoder.image_shape,
        keys=keys,
    )


def make_loss(config: SACConfig, actor: SACActor, critics: list[Critic], bounds: Bounds, keys: Keys) -> SACLoss:
    """Returns TorchRL's loss, with a target network for each critic."""
    size = len(bounds[0])
    widths = sum(math.log((most - least) / 2) for least, most in zip(*bounds, strict=True))
    least, most = config.alpha_bounds if config.learn_alpha else (None, None)
    loss = SACLoss(
        stochastic_policy(actor, keys=keys),
        [TensorDictModule(critic, [keys.pixels, keys.action], ["state_action_value"]) for critic in critics],
        loss_function="l2",
        alpha_init=config.alpha,
        min_alpha=least,
        max_alpha=most,
        fixed_alpha=not config.learn_alpha,
        target_entropy=size * config.target_entropy + widths,  # TorchRL's is that of actions within their bounds
        deactivate_vmap=True,
    )
    set_targets(loss, config, value_network=None, keys=keys)
    return loss


def make_optimizer(config: SACConfig, loss: SACLoss) -> torch.optim.Optimizer:
    """Returns one Adam for all, with a learning rate for actor, critics and entropy coefficient."""
    groups = [
        {"params": list(loss.actor_network_params.parameters()), "lr": config.actor_learning_rate},
        {"params": list(loss.qvalue_network_params.parameters()), "lr": config.critic_learning_rate},
    ]
    if config.learn_alpha:
        groups.append({"params": [loss.log_alpha], "lr": config.alpha_learning_rate})
    return torch.optim.Adam(groups, fused=True)


ALGORITHM = Algorithm(SACConfig, make_agent, SACActor, deterministic_policy)
