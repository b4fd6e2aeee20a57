"""DDPG and DDQN updates a second, beside Stable-Baselines3 and TorchRL's plain loop: same networks, no hindsight.

Usage::

    python -m benchmarks.updates

Ours is the recipe's update: sampling from a ``FrameStorage``, the batches of a round at once; TorchRL's loss with
clipped targets (and, in DDPG, the penalty on the actor's pre-activations) and shared passes through the convolutions;
one fused Adam. Stable-Baselines3's is ``DDPG.train``, with all gradient steps of a round, or ``DQN.train``, with plain
convolutions as features extractor, in DDPG one for each of actor and critic (it has one learning rate for both).
TorchRL's is ``DDPGLoss`` or ``DQNLoss``, an Adam for each network and ``SoftUpdate`` on a ``LazyTensorStorage`` of
images channels first. Peers have networks of plain layers that compute the same, in PyTorch's default memory format;
TorchRL's in ``channels_last`` as well. The numbers of parameters are compared before measuring. One thread, processor
time in alternating rounds: medians, and medians of the rounds' ratios.

Stable-Baselines3's DQN is not double: its online network does not see next frames, one forward pass less. So both it
and ours are measured twice: double, for which its target network is wrapped in one that runs both, and not double.
Its ``train`` leaves the target network to the steps in the environment; here the target network follows at each update,
as in the others.

"Our convolutions alone" are the passes of our update, forward and, where they learn, backward, from the images on, with
all that serves them (images become floats, pixels and kernels are laid out in blocks): what an update would take if all
else (sampling, heads, losses, Adam, targets) cost nothing.
"""

import dataclasses
import itertools
import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
import tyro
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl import logger as torchrl_logger
from torchrl.data import Bounded, LazyTensorStorage, OneHot, TensorDictReplayBuffer, TensorSpec
from torchrl.objectives import DDPGLoss, DQNLoss, LossModule, SoftUpdate, ValueEstimators

from benchmarks import sb3_peers
from benchmarks.plain_encoder import PlainEncoder
from benchmarks.rounds import ratio, seconds_a_call, take_turns, warm_heap
from benchmarks.rows import Rows, channels_first, plain
from benchmarks.tables import Table, report
from halgan_rl.agents import registry
from halgan_rl.agents.agent import Agent, AgentConfig
from halgan_rl.agents.ddpg import Actor, Critic, DDPGConfig
from halgan_rl.agents.ddqn import DDQNConfig, QNetwork, greedy_policy
from halgan_rl.agents.encoder import Downsample
from halgan_rl.agents.fast_cpu import accelerate
from halgan_rl.agents.fast_cpu.block_encoder import BlockEncoder, encode_together
from halgan_rl.replay.frame_storage import FrameStorage
from halgan_rl.training.loop import draw_batches
from recipes import ddpg_navigate, ddqn_pebble

Updates = Callable[[int], object]
"""Makes so many updates."""
Counts = tuple[int, ...]
"""Numbers of parameters of actor and critic, or of the one network of action values."""
Variant = Callable[[Any, TensorDict, int], tuple[Updates, Counts]]
"""Makes updates for an agent's configuration, the rows of a buffer, and the size of batches."""


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Updates a second, side by side."""

    rounds: int = 11
    """Alternating rounds; the median is reported."""
    updates: int = 8
    """Updates a round."""
    rows: int = 5_000
    """Rows in the buffers."""
    batch_sizes: tuple[int, ...] = (32, 128)
    """Rows an update."""
    downsamples: tuple[Downsample, ...] = ("stride", "max_pool")
    """How the convolutions halve the image, in all of them."""


def ours(
    actions: TensorSpec, config: AgentConfig, rows: TensorDict, batch_size: int, *, double: bool = True
) -> tuple[Updates, Counts]:
    """Returns the recipe's updates, and the numbers of parameters."""
    buffer = TensorDictReplayBuffer(storage=FrameStorage(len(rows)), generator=torch.Generator().manual_seed(0))
    buffer.extend(plain(rows))
    agent = make_agent(actions, config, double=double)

    def run(count: int) -> None:
        for batch in draw_batches(buffer, count, batch_size):
            agent.update(batch)

    return run, count_parameters(agent.loss)


def make_agent(actions: TensorSpec, config: AgentConfig, *, double: bool = True) -> Agent:
    """Returns the recipe's agent, fast on a CPU, with targets that are double or not."""
    agent = registry.make_agent(config, action_spec=actions, image_shape=(64, 64, 3))
    accelerate(agent)
    if not double:
        agent.loss.double_dqn = False
    return agent


Passes = Sequence[tuple[int, bool]]
"""Passes through convolutions: how many networks share one, and whether they learn by it."""


def convolutions(config: AgentConfig, rows: TensorDict, batch_size: int, passes: Passes) -> Updates:
    """Returns the convolutions of our update: forward, and back where they learn."""
    pixels = rows["pixels"][:batch_size]
    networks = [[BlockEncoder(downsample=config.downsample) for _ in range(count)] for count, _ in passes]

    def run(count: int) -> None:
        for encoders, (_, learns) in count * list(zip(networks, passes, strict=True)):
            with torch.set_grad_enabled(learns):
                features = encode_together(pixels, encoders)
            if learns:
                torch.autograd.backward(features, [torch.ones_like(seen) for seen in features])

    return run


def with_plain_encoder(network: nn.Module, config: AgentConfig, memory_format: torch.memory_format) -> nn.Module:
    """Returns one of our networks, changed to images channels first and plain convolutions."""
    network.encoder = PlainEncoder(config.downsample, memory_format)
    return network


LearningRates = list[tuple[TensorDict, float]]
"""Parameters, and the learning rate of their Adam."""


def torchrl_ddpg(config: DDPGConfig, memory_format: torch.memory_format) -> tuple[LossModule, LearningRates]:
    """Returns TorchRL's loss on our actor and critic, channels first."""
    actor, critic = (with_plain_encoder(network, config, memory_format) for network in (Actor(), Critic()))
    loss = DDPGLoss(
        TensorDictModule(nn.Sequential(actor, nn.Tanh()), in_keys=["pixels"], out_keys=["action"]),
        TensorDictModule(critic, in_keys=["pixels", "action"], out_keys=["state_action_value"]),
        delay_actor=True,
        delay_value=True,
    )
    rates = (config.actor_learning_rate, config.critic_learning_rate)
    return loss, list(zip((loss.actor_network_params, loss.value_network_params), rates, strict=True))


def torchrl_ddqn(config: DDQNConfig, memory_format: torch.memory_format) -> tuple[LossModule, LearningRates]:
    """Returns TorchRL's loss on our network of action values, channels first."""
    values = greedy_policy(with_plain_encoder(QNetwork(), config, memory_format))
    loss = DQNLoss(values, delay_value=True, double_dqn=True, action_space="one_hot")
    return loss, [(loss.value_network_params, config.learning_rate)]


def torchrl_loop(
    make_loss: Callable[[Any, torch.memory_format], tuple[LossModule, LearningRates]],
    memory_format: torch.memory_format,
    config: AgentConfig,
    rows: TensorDict,
    batch_size: int,
) -> tuple[Updates, Counts]:
    """Returns TorchRL's plain updates, and the numbers of parameters."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), batch_size=batch_size)
    buffer.extend(plain(rows).update({"pixels": channels_first(rows["pixels"])}).update(_next_channels_first(rows)))
    loss, rates = make_loss(config, memory_format)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=config.discount)
    optimizers = [torch.optim.Adam(parameters.values(True, True), lr=rate) for parameters, rate in rates]
    target_updater = SoftUpdate(loss, tau=config.tau)

    def run(count: int) -> None:
        for _ in range(count):
            _torchrl_update(buffer, loss, optimizers, target_updater)

    return run, count_parameters(loss)


def _next_channels_first(rows: TensorDict) -> dict[str, dict[str, Tensor]]:
    return {"next": {"pixels": channels_first(rows["next", "pixels"])}}


def _torchrl_update(
    buffer: TensorDictReplayBuffer, loss: LossModule, optimizers: list[torch.optim.Adam], target_updater: SoftUpdate
) -> None:
    losses = loss(buffer.sample())
    sum(value for name, value in losses.items() if name.startswith("loss")).backward()
    for optimizer in optimizers:
        optimizer.step()
        optimizer.zero_grad()
    target_updater.step()


def sb3_ddpg(config: DDPGConfig, rows: TensorDict, batch_size: int) -> tuple[Updates, Counts]:
    """Returns Stable-Baselines3's updates, and the numbers of parameters."""
    return sb3_peers.make_ddpg_updates(rows, config, config.critic_learning_rate, batch_size)


def sb3_dqn(config: DDQNConfig, rows: TensorDict, batch_size: int, *, double: bool) -> tuple[Updates, Counts]:
    """Returns Stable-Baselines3's updates, and the numbers of parameters."""
    return sb3_peers.make_dqn_updates(rows, config, config.learning_rate, batch_size, double=double)


def count_parameters(loss: LossModule) -> Counts:
    """Returns the number of parameters of each network that a loss trains."""
    networks = [getattr(loss, f"{name}_network_params", None) for name in ("actor", "value")]
    return tuple(sum(p.numel() for p in network.values(True, True)) for network in networks if network is not None)


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """What is measured of an algorithm.

    Attributes:
        config: the recipe's agent.
        actions: of its environment.
        variants: ours and its peers.
        passes: of our updates, under the names by which they are reported.
    """

    config: AgentConfig
    actions: TensorSpec
    variants: Mapping[str, Variant]
    passes: Mapping[str, Passes]


DRIVE, CHOICE = Bounded(-1.0, 1.0, (2,)), OneHot(4, dtype=torch.int64)
ALGORITHMS = {
    "DDPG": Algorithm(
        ddpg_navigate.DEFAULT.agent,
        DRIVE,
        {
            "ours": partial(ours, DRIVE),
            "SB3 DDPG.train": sb3_ddpg,
            "torchrl plain loop": partial(torchrl_loop, torchrl_ddpg, torch.contiguous_format),
            "torchrl plain loop, channels_last": partial(torchrl_loop, torchrl_ddpg, torch.channels_last),
        },
        passes={"our convolutions alone": ((2, True), (2, False))},  # actor and critic at s, their targets at s'
    ),
    "DDQN": Algorithm(
        ddqn_pebble.DEFAULT.agent,
        CHOICE,
        {
            "ours": partial(ours, CHOICE),
            "ours, not double": partial(ours, CHOICE, double=False),
            "SB3 DQN.train, made double": partial(sb3_dqn, double=True),
            "SB3 DQN.train, not double": partial(sb3_dqn, double=False),
            "torchrl plain loop": partial(torchrl_loop, torchrl_ddqn, torch.contiguous_format),
            "torchrl plain loop, channels_last": partial(torchrl_loop, torchrl_ddqn, torch.channels_last),
        },
        passes={
            "our convolutions alone": ((1, True), (2, False)),  # the network at s; with its target at s'
            "our convolutions alone, not double": ((1, True), (1, False)),
        },
    ),
}


def make_updates(algorithm: Algorithm, rows: TensorDict, *, batch_size: int = 32, **changes: Any) -> dict[str, Updates]:
    """Returns the updates of each variant and our convolutions alone; the networks have the same numbers of parameters.

    Args:
        algorithm: what to measure.
        rows: what to fill the buffers with; actions are drawn anew.
        batch_size: rows an update.
        changes: of the agent's configuration.

    Raises:
        RuntimeError: if the numbers differ.
    """
    config = dataclasses.replace(algorithm.config, **changes)
    rows = rows.clone(False).set("action", algorithm.actions.rand((len(rows),)))
    made = {name: variant(config, rows, batch_size) for name, variant in algorithm.variants.items()}
    counts = {name: parameters for name, (_, parameters) in made.items()}
    if len(set(counts.values())) != 1:
        raise RuntimeError(f"the networks differ, this would compare apples with pears: {counts}")
    bounds = {name: convolutions(config, rows, batch_size, passes) for name, passes in algorithm.passes.items()}
    return {name: run for name, (run, _) in made.items()} | bounds


Case = tuple[str, str, int, str]
"""Algorithm, down-sampling, batch size, variant."""


def measure(benchmark: Benchmark) -> dict[Case, list[float]]:
    """Returns times of some updates [s], all taken by turns."""
    rows = Rows(64).take(benchmark.rows)
    measures = {}
    for (algorithm, made), *options in itertools.product(
        ALGORITHMS.items(), benchmark.downsamples, benchmark.batch_sizes
    ):
        downsample, size = options
        for name, run in make_updates(made, rows, batch_size=size, downsample=downsample).items():
            measures[algorithm, downsample, size, name] = partial(seconds_a_call, partial(run, benchmark.updates), 1)
    return take_turns(measures, benchmark.rounds)


def our(name: str) -> str:
    """Returns which of our variants another one is compared with."""
    return "ours, not double" if name.endswith("not double") else "ours"


def describe(seconds: list[float], updates: int) -> tuple[str, str]:
    """Returns the time of an update [ms], and updates a second, of some rounds' times [s]."""
    median = statistics.median(seconds)
    return f"{1e3 * median / updates:.1f}", f"{updates / median:.0f}"


HEADER = (
    *("algorithm", "networks", "batch", "variant", "ms an update", "updates/s"),
    *("ours, same networks", "ours, strides"),
)


def main(benchmark: Benchmark) -> None:
    """Prints and save the table."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    torchrl_logger.setLevel("WARNING")
    warm_heap()
    seconds = measure(benchmark)
    title = (
        f"Updates, one thread, medians of {benchmark.rounds} alternating rounds of {benchmark.updates}, processor "
        "time. The factors, medians of those of each round, tell how many times as fast ours is: with the same "
        "networks, and with strides."
    )
    lines = [
        [algorithm, downsample, str(size), name, *describe(value, benchmark.updates)]
        + [
            f"{ratio(value, seconds[algorithm, other, size, our(name)]):.2f}"
            for other in (downsample, benchmark.downsamples[0])
        ]
        for (algorithm, downsample, size, name), value in seconds.items()
    ]
    report("updates", [Table(title, HEADER, lines)])


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
