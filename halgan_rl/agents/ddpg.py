"""DDPG on camera images, out of TorchRL's parts."""

import dataclasses

import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, TensorSpec
from torchrl.modules import AdditiveGaussianModule, EGreedyModule
from torchrl.objectives import DDPGLoss, ValueEstimators

from halgan_rl.agents.fast_cpu.fused_soft_update import FusedSoftUpdate
from halgan_rl.agents.fast_cpu.one_pass_losses import OnePassDDPGLoss
from halgan_rl.agents.networks import Actor, Critic, deterministic_policy
from halgan_rl.agents.objectives import ClippedTD0Estimator
from halgan_rl.experiment import config as hindsight_config
from halgan_rl.experiment.config import HindsightConfig
from halgan_rl.training.loop import Agent, on_cpu


@dataclasses.dataclass(frozen=True)
class DDPGConfig(HindsightConfig):
    """What a DDPG agent with hindsight is told."""

    actor_learning_rate: float = 1e-4
    """Adam's learning rate for the actor."""
    critic_learning_rate: float = 1e-3
    """Adam's learning rate for the critic."""
    preactivation_weight: float = 1e-3
    """Price of the square of what goes into the actor's tanh."""
    small_output: bool = True
    """Start the actor's last layer near zero."""
    noise: float = 0.1
    """Standard deviation of the Gaussian noise on the actions."""


PAPER = hindsight_config.PAPER | {
    "actor_learning_rate": 1e-5,
    "critic_learning_rate": 1e-4,
    "preactivation_weight": 0.0,
    "small_output": False,
}
"""What the paper's tables say alike for all tasks with continuous actions."""

FIGURES = {"pred_value": "q_value", "loss_value": "loss_value", "loss_actor": "loss_actor"}
"""Which of the loss's outputs are reported, and as what."""


def make_agent(config: DDPGConfig, action_spec: TensorSpec) -> Agent:
    """Return actor and critic, both on the camera image alone, how the actor explores, and how they learn.

    Raises:
        ValueError: if the environment's actions are discrete.
    """
    if not isinstance(action_spec, Bounded):
        raise ValueError(
            f"{config.environment} has discrete actions, DDPG needs continuous ones: train it with DDQN "
            "(halgan_rl.agents.ddqn; recipes/ddqn_pebble.py)"
        )
    size, downsample = action_spec.shape[-1], config.downsample
    network = Actor(size, downsample=downsample, small_output=config.small_output).to(config.device)
    acting = on_cpu(network)
    critic = Critic(size, downsample=downsample).to(config.device)
    noise = AdditiveGaussianModule(action_spec, sigma_init=config.noise, sigma_end=config.noise)
    epsilon = EGreedyModule(action_spec, config.epsilon_start, config.epsilon_end, config.epsilon_frames)
    loss = make_loss(config, network, critic)
    return Agent(
        network=network,
        acting=acting,
        make_policy=deterministic_policy,
        explorer=TensorDictSequential(deterministic_policy(acting), noise, epsilon),
        epsilon=epsilon,
        loss=loss,
        optimizer=make_optimizer(config, loss),
        target_updater=FusedSoftUpdate(loss, tau=config.target_rate),
        figures=FIGURES,
    )


def make_loss(config: DDPGConfig, actor: Actor, critic: Critic) -> DDPGLoss:
    """Return TorchRL's DDPG loss with the targets that the configuration asks for."""
    loss = OnePassDDPGLoss(actor, critic, preactivation_weight=config.preactivation_weight)
    if config.clip_targets:
        estimator = ClippedTD0Estimator(
            low=-1.0, high=1.0, gamma=config.discount, value_network=loss.actor_critic, device=config.device
        )
        estimator.set_keys(value=loss.tensor_keys.state_action_value)
        loss.make_value_estimator(estimator)
    else:
        loss.make_value_estimator(ValueEstimators.TD0, gamma=config.discount)
    return loss


def make_optimizer(config: DDPGConfig, loss: DDPGLoss) -> torch.optim.Optimizer:
    """Return one Adam for both networks, with a learning rate for each."""
    actor_parameters = list(loss.actor_network_params.values(True, True))
    critic_parameters = list(loss.value_network_params.values(True, True))
    return torch.optim.Adam(
        [
            {"params": actor_parameters, "lr": config.actor_learning_rate},
            {"params": critic_parameters, "lr": config.critic_learning_rate},
        ],
        fused=True,
    )
