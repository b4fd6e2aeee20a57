"""Double DQN on camera images, out of TorchRL's parts."""

import dataclasses

import torch
from tensordict.nn import TensorDictSequential
from torchrl.data import OneHot, TensorSpec
from torchrl.modules import EGreedyModule
from torchrl.objectives import DQNLoss, ValueEstimators

from halgan_rl.agents.fast_cpu.fused_soft_update import FusedSoftUpdate
from halgan_rl.agents.fast_cpu.one_pass_losses import OnePassDQNLoss
from halgan_rl.agents.networks import QNetwork, greedy_policy
from halgan_rl.agents.objectives import ClippedTD0Estimator
from halgan_rl.experiment.config import HindsightConfig
from halgan_rl.training.loop import Agent, on_cpu


@dataclasses.dataclass(frozen=True)
class DDQNConfig(HindsightConfig):
    """What a DDQN agent with hindsight is told."""

    learning_rate: float = 1e-3
    """Adam's learning rate."""


def make_agent(config: DDQNConfig, action_spec: TensorSpec) -> Agent:
    """Return a network of action values on the camera image alone, how it explores, and how it learns.

    Raises:
        ValueError: if the environment's actions are continuous.
    """
    if not isinstance(action_spec, OneHot):
        raise ValueError(
            f"{config.environment} has continuous actions, DDQN needs one-hot ones: train it with DDPG "
            "(halgan_rl.agents.ddpg; recipes/ddpg_navigate.py)"
        )
    network = QNetwork(action_spec.shape[-1], downsample=config.downsample).to(config.device)
    acting = on_cpu(network)
    epsilon = EGreedyModule(action_spec, config.epsilon_start, config.epsilon_end, config.epsilon_frames)
    loss = make_loss(config, network)
    return Agent(
        network=network,
        acting=acting,
        make_policy=greedy_policy,
        explorer=TensorDictSequential(greedy_policy(acting), epsilon),
        epsilon=epsilon,
        loss=loss,
        optimizer=torch.optim.Adam(loss.value_network_params.values(True, True), config.learning_rate, fused=True),
        target_updater=FusedSoftUpdate(loss, tau=config.target_rate),
        figures={"loss": "loss"},
    )


def make_loss(config: DDQNConfig, network: QNetwork) -> DQNLoss:
    """Return TorchRL's double-DQN loss with the targets that the configuration asks for."""
    loss = OnePassDQNLoss(network)
    if config.clip_targets:
        estimator = ClippedTD0Estimator(
            low=-1.0, high=1.0, gamma=config.discount, value_network=loss.value_network, device=config.device
        )
        loss.make_value_estimator(estimator)
    else:
        loss.make_value_estimator(ValueEstimators.TD0, gamma=config.discount)
    return loss
