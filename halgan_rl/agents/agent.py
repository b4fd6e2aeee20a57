"""An agent that learns, and the configuration that all agents share."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.data import TensorSpec
from torchrl.modules import EGreedyModule
from torchrl.objectives import LossModule, TargetNetUpdater

from halgan_rl.agents.encoder import Downsample, ImageShape
from halgan_rl.keys import Keys, dotted
from halgan_rl.transforms.annealing import Annealing

NOT_IN_KEYS = ("steps_to_next_obs", "priority_weight")
"""What losses also read, where rows have it, though TorchRL does not list it among a loss's keys."""


@dataclass(frozen=True)
class AgentConfig:
    """The configuration that all agents share."""

    discount: float = 0.95
    """Discount factor."""
    tau: float = 2e-2
    """How far the target networks move towards the networks at each update."""
    clip_targets: bool = True
    """Clip the targets of values to [-1, 1]."""
    downsample: Downsample = "stride"
    """How the convolutions halve the image."""
    epsilon: Annealing = Annealing(1.0, 0.1, 6_000)
    """Fraction of uniformly random actions."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        if not 0 <= self.discount <= 1:
            raise ValueError(f"discount must lie in [0, 1], got {self.discount}.")
        if not 0 < self.tau <= 1:
            raise ValueError(f"tau must lie in (0, 1], got {self.tau}.")
        if not 0 <= self.epsilon.end <= self.epsilon.start <= 1:
            raise ValueError(
                f"epsilon is a fraction and must not grow, got {self.epsilon.start} to {self.epsilon.end}: give values "
                "in [0, 1], the larger one first."
            )


@dataclass
class Agent:
    """An agent that learns.

    Attributes:
        network: Chooses the actions; what is averaged, evaluated and saved. It learns on whatever device it is on.
        acting: The same network on the CPU, where the environment is: see :func:`on_cpu`.
        make_policy: Wraps the network, or an average of it, as a deterministic policy.
        explorer: The acting network with its exploration; what collects.
        epsilon_greedy: The part of the explorer that acts at random, less and less; None if there is none.
        loss: TorchRL's loss.
        optimizer: Of all parameters of the loss.
        target_updater: Moves the target networks.
        metrics: Which of the loss's outputs to report, and under which names.
        image_shape: Height, width and channels of the images.
        keys: Where rows keep what.
    """

    network: nn.Module
    acting: nn.Module
    make_policy: Callable[[Any], TensorDictModuleBase]
    explorer: TensorDictModuleBase
    epsilon_greedy: EGreedyModule | None
    loss: LossModule
    optimizer: torch.optim.Optimizer
    target_updater: TargetNetUpdater
    metrics: Mapping[str, str]
    image_shape: ImageShape
    keys: Keys = field(default_factory=Keys)

    def update(self, batch: TensorDictBase) -> TensorDictBase:
        """Makes one update with a batch ``[N]``.

        Returns:
            The loss module's output, which stays on the network's device. Priorities are written into the batch.

        Raises:
            ValueError: If the images are not ``[N, H, W, C]`` of the agent's image shape.
        """
        self._check(batch)
        rows = batch if self.acting is self.network else self._on_device(batch)
        losses = self.loss(rows)
        sum(value for name, value in losses.items() if name.startswith("loss")).backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.target_updater.step()
        if rows is not batch and "priority_weight" in batch.keys():  # noqa: SIM118 (a TensorDict iterates over rows)
            priority = self.loss.tensor_keys.priority
            batch.set(priority, rows.get(priority).to(batch.get("priority_weight").device))
        return losses

    def act_on_latest(self) -> None:
        """Hands what has been learned to the acting network."""
        if self.acting is not self.network:
            self.acting.load_state_dict(self.network.state_dict())

    def step(self, frames: int) -> None:
        """Anneals what the agent anneals by so many environment frames."""
        if self.epsilon_greedy is not None:
            self.epsilon_greedy.step(frames)

    @property
    def epsilon(self) -> float:
        """The present fraction of uniformly random actions; NaN if the agent explores in another way."""
        return float("nan") if self.epsilon_greedy is None else float(self.epsilon_greedy.eps)

    def _check(self, batch: TensorDictBase) -> None:
        """Refuses images with other dimensions, which the networks would take for more rows."""
        for key in (self.keys.pixels, self.keys.next("pixels")):
            shape = batch.get(key).shape[batch.ndim :]
            if batch.ndim and shape != self.image_shape:
                raise ValueError(
                    f"{dotted(key)} of a row is {list(shape)}, the agent was made for {list(self.image_shape)} "
                    "(height, width, channels). Move channels last, and stack frames along the channels."
                )

    def _on_device(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns what the loss reads of a batch, on the device of the network."""
        device = next(self.network.parameters()).device
        return batch.select(*self.loss.in_keys, *NOT_IN_KEYS, strict=False).to(device, non_blocking=True)


class MakeAgent(Protocol):
    """Makes an agent of one algorithm, with plain layers and TorchRL's own losses."""

    def __call__(
        self,
        config: Any,
        *,
        action_spec: TensorSpec,
        image_shape: ImageShape,
        keys: Keys = ...,
        device: torch.device | str = "cpu",
    ) -> Agent:
        """Returns the agent.

        Args:
            config: The algorithm's configuration.
            action_spec: The environment's actions ``[A]``.
            image_shape: Height, width and channels of its images.
            keys: Where rows keep what.
            device: Where to learn.

        Raises:
            ValueError: If the algorithm does not fit the actions or the images.
        """


@dataclass(frozen=True)
class Algorithm:
    """All that is known of an algorithm by its name.

    Attributes:
        config: The class of its configuration.
        make_agent: Makes the agent.
        network: Rebuilds the network that acts, from the ``arguments`` of a manifest; has the ``kind`` of manifests.
        make_policy: Wraps that network as a deterministic policy; takes ``keys=`` as well.
    """

    config: type[AgentConfig]
    make_agent: MakeAgent
    network: Any
    make_policy: Callable[..., TensorDictModuleBase]


Network = TypeVar("Network", bound=nn.Module)


def on_cpu(network: Network) -> Network:
    """Returns a network itself if it is on the CPU, or a copy there: for one frame the way to a GPU is too long."""
    return network if next(network.parameters()).device.type == "cpu" else copy.deepcopy(network).cpu()


def make_epsilon_greedy(epsilon: Annealing, action_spec: TensorSpec, keys: Keys) -> EGreedyModule:
    """Returns what replaces actions by uniformly random ones, less and less."""
    return EGreedyModule(action_spec, epsilon.start, epsilon.end, epsilon.frames, action_key=keys.action)
