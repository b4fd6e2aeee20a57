"""Double DQN on camera images, out of TorchRL's parts (van Hasselt et al. 2016)."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import OneHot, TensorSpec
from torchrl.modules import QValueModule
from torchrl.objectives import DQNLoss, SoftUpdate

from halgan_rl.agents.agent import Agent, AgentConfig, Algorithm, make_epsilon_greedy, on_cpu
from halgan_rl.agents.clipped_targets import set_targets
from halgan_rl.agents.encoder import Downsample, Encoder, ImageShape, make_head
from halgan_rl.keys import Keys
from halgan_rl.transforms.annealing import Annealing

METRICS = {"loss": "loss"}
"""Which of the loss's outputs are reported, and as what."""


@dataclass(frozen=True)
class DDQNConfig(AgentConfig):
    """Configuration of a DDQN agent."""

    learning_rate: float = 1e-3
    """Adam's learning rate."""


PAPER = DDQNConfig(
    discount=0.99,
    tau=1e-3,
    clip_targets=False,
    downsample="max_pool",
    epsilon=Annealing(1.0, 0.5, 100_000),
)
"""What the paper's tables say for tasks with discrete actions (Sahni et al., NeurIPS 2019, appendix)."""


class QNetwork(nn.Module):
    """The action values of DDQN: 33,708 parameters for images 64x64x3 and 4 actions.

    Args:
        image_shape: Height, width and channels.
        actions: Number of discrete actions A.
        downsample: See :class:`~halgan_rl.agents.encoder.Encoder`.

    Attributes:
        kind: What manifests call such networks.
        arguments: What rebuilds the network, ready for JSON.
    """

    kind = "q_network"

    def __init__(
        self, image_shape: Iterable[int] = (64, 64, 3), *, actions: int = 4, downsample: Downsample = "stride"
    ) -> None:
        super().__init__()
        self.encoder = Encoder(image_shape, downsample)
        self.head = make_head(self.encoder.features, actions)
        self.arguments: dict[str, Any] = {
            "image_shape": list(self.encoder.image_shape),
            "actions": actions,
            "downsample": downsample,
        }

    def forward(self, pixels: Tensor) -> Tensor:
        """Returns values ``[..., A]`` for images uint8 ``[..., H, W, C]``."""
        return self.head(self.encoder(pixels)).reshape(*pixels.shape[:-3], -1)


class FirstBest(QValueModule):
    """TorchRL's choice of the best action, one-hot; of several whose values are the same to the last bit, the first.

    TorchRL's own marks all of them (0.14.1), which is no action.
    """

    @staticmethod
    def _one_hot(value: Tensor) -> Tensor:
        return nn.functional.one_hot(value.argmax(-1), value.shape[-1])


def greedy_policy(network: QNetwork, *, keys: Keys = Keys()) -> TensorDictSequential:
    """Returns the policy of an action-value network: reads images, writes the best action, one-hot, and all values.

    Args:
        network: The network.
        keys: Names of the images and actions.

    Examples:
        >>> from tensordict import TensorDict
        >>> images = torch.zeros(5, 64, 64, 3, dtype=torch.uint8)
        >>> greedy_policy(QNetwork())(TensorDict({"pixels": images}, batch_size=[5]))["action"].shape
        torch.Size([5, 4])
    """
    return TensorDictSequential(
        TensorDictModule(network, in_keys=[keys.pixels], out_keys=["action_value"]),
        FirstBest(action_space="one_hot", out_keys=[keys.action, "action_value", "chosen_action_value"]),
    )


def make_agent(
    config: DDQNConfig,
    *,
    action_spec: TensorSpec,
    image_shape: ImageShape,
    keys: Keys = Keys(),
    device: torch.device | str = "cpu",
) -> Agent:
    """Returns a network of action values on the camera image alone, how it explores, and how it learns.

    Args:
        config: The configuration.
        action_spec: One-hot actions ``[A]``.
        image_shape: Height, width and channels.
        keys: Where rows keep what.
        device: Where to learn.

    Raises:
        ValueError: If the actions are continuous, or discrete and not one-hot.
    """
    check_one_hot(action_spec)
    network = QNetwork(image_shape, actions=action_spec.shape[-1], downsample=config.downsample).to(device)
    acting = on_cpu(network)
    epsilon_greedy = make_epsilon_greedy(config.epsilon, action_spec, keys)
    loss = make_loss(config, network, keys)
    return Agent(
        network=network,
        acting=acting,
        make_policy=partial(greedy_policy, keys=keys),
        explorer=TensorDictSequential(greedy_policy(acting, keys=keys), epsilon_greedy),
        epsilon_greedy=epsilon_greedy,
        loss=loss,
        optimizer=torch.optim.Adam(loss.value_network_params.values(True, True), config.learning_rate, fused=True),
        target_updater=SoftUpdate(loss, tau=config.tau),
        metrics=METRICS,
        image_shape=network.encoder.image_shape,
        keys=keys,
    )


def check_one_hot(action_spec: TensorSpec) -> None:
    """Raises a ValueError unless actions are one-hot ``[A]``."""
    if not isinstance(action_spec, OneHot) or action_spec.ndim != 1:
        raise ValueError(
            f"DDQN needs discrete, one-hot actions [A], got {type(action_spec).__name__} {list(action_spec.shape)}: "
            "train continuous actions with DDPG (halgan_rl.agents.ddpg), make categorical ones one-hot "
            "(GymEnv(..., categorical_action_encoding=False)), and for several environments at once pass the spec of "
            "one (env.action_spec_unbatched)."
        )


def make_loss(config: DDQNConfig, network: QNetwork, keys: Keys) -> DQNLoss:
    """Returns TorchRL's double-DQN loss, with a target network."""
    loss = DQNLoss(greedy_policy(network, keys=keys), delay_value=True, double_dqn=True, action_space="one_hot")
    loss.set_keys(action=keys.action)
    set_targets(loss, config, value_network=loss.value_network, keys=keys)
    return loss


ALGORITHM = Algorithm(DDQNConfig, make_agent, QNetwork, greedy_policy)
