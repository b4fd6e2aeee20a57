"""DDPG updates a second, beside Stable-Baselines3 and TorchRL's plain loop: same networks and batch, no hindsight.

Usage::

    python -m benchmarks.updates

Ours is the recipe's update: sampling from a ``FrameStorage``, TorchRL's loss with clipped targets and the price on the
actor's pre-activations, one fused Adam, images and convolutions in ``channels_last``. Stable-Baselines3's is
``DDPG.train`` with our convolutions as features extractor, one for each of actor and critic (it has one learning rate
for both). TorchRL's is ``DDPGLoss``, two Adams and ``SoftUpdate`` on a ``LazyTensorStorage`` of images channels first.
Both peers' networks are in PyTorch's default memory format; the numbers of parameters are compared before measuring.
One thread, medians of processor time in alternating rounds.
"""

import dataclasses
import itertools
from collections.abc import Callable
from functools import partial

import torch
import tyro
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl import logger as torchrl_logger
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import DDPGLoss, SoftUpdate, ValueEstimators

from benchmarks import sb3_peers
from benchmarks.rounds import alternate, seconds_a_call, warm_heap
from benchmarks.rows import Rows, channels_first, plain
from benchmarks.tables import Table, report
from halgan_rl.ddpg import make_agent
from halgan_rl.experiment import make_buffer
from halgan_rl.models.agents import Actor, Critic, Downsample
from recipes.ddpg_navigate import Config

Update = Callable[[], object]
Counts = tuple[int, ...]
"""Numbers of parameters of actor and critic."""


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """DDPG updates a second, side by side."""

    rounds: int = 7
    """Alternating rounds; the median is reported."""
    updates: int = 5
    """Updates a round."""
    rows: int = 5_000
    """Rows in the buffers."""
    batch_sizes: tuple[int, ...] = (32, 128)
    """Rows an update."""
    downsamples: tuple[Downsample, ...] = ("stride", "max_pool")
    """How the convolutions halve the image, in all three."""


def ours(config: Config, rows: TensorDict) -> tuple[Update, Counts]:
    """Return the recipe's update, and the numbers of parameters."""
    buffer = make_buffer(config, None)
    buffer.extend(plain(rows))
    agent = make_agent(config, Bounded(-1.0, 1.0, (2,)))
    return lambda: agent.update(buffer.sample()), count_parameters(agent.network, agent.loss.value_network)


class ContiguousActor(Actor):
    """Our actor on images uint8 ``[N, 3, 64, 64]``, in PyTorch's default memory format."""

    def forward(self, pixels: Tensor) -> Tensor:
        """Return actions ``[N, A]``."""
        return self.head(self.vision.layers(pixels.float() / 127.5 - 1)).tanh()


class ContiguousCritic(Critic):
    """Our critic on images uint8 ``[N, 3, 64, 64]``, in PyTorch's default memory format."""

    def forward(self, pixels: Tensor, action: Tensor) -> Tensor:
        """Return values ``[N, 1]``."""
        return self.head(torch.cat([self.vision.layers(pixels.float() / 127.5 - 1), action], -1))


def torchrl_loop(config: Config, rows: TensorDict) -> tuple[Update, Counts]:
    """Return TorchRL's plain update, and the numbers of parameters."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), batch_size=config.batch_size)
    buffer.extend(plain(rows).update({"pixels": channels_first(rows["pixels"])}).update(_next_channels_first(rows)))
    networks = ContiguousActor(downsample=config.downsample), ContiguousCritic(downsample=config.downsample)
    nets: list[nn.Module] = [network.to(memory_format=torch.contiguous_format) for network in networks]
    actor = TensorDictModule(nets[0], in_keys=["pixels"], out_keys=["action"])
    critic = TensorDictModule(nets[1], in_keys=["pixels", "action"], out_keys=["state_action_value"])
    loss = DDPGLoss(actor, critic, delay_actor=True, delay_value=True)
    loss.make_value_estimator(ValueEstimators.TD0, gamma=config.discount)
    optimizers = [
        torch.optim.Adam(loss.actor_network_params.values(True, True), lr=config.actor_learning_rate),
        torch.optim.Adam(loss.value_network_params.values(True, True), lr=config.critic_learning_rate),
    ]
    target_updater = SoftUpdate(loss, tau=config.target_rate)
    return partial(_torchrl_update, buffer, loss, optimizers, target_updater), count_parameters(actor, critic)


def _next_channels_first(rows: TensorDict) -> dict[str, dict[str, Tensor]]:
    return {"next": {"pixels": channels_first(rows["next", "pixels"])}}


def _torchrl_update(
    buffer: TensorDictReplayBuffer, loss: DDPGLoss, optimizers: list[torch.optim.Adam], target_updater: SoftUpdate
) -> None:
    losses = loss(buffer.sample())
    (losses["loss_actor"] + losses["loss_value"]).backward()
    for optimizer in optimizers:
        optimizer.step()
        optimizer.zero_grad()
    target_updater.step()


def sb3(config: Config, rows: TensorDict) -> tuple[Update, Counts]:
    """Return Stable-Baselines3's update, and the numbers of parameters."""
    return sb3_peers.make_update(
        rows,
        config.batch_size,
        downsample=config.downsample,
        learning_rate=config.critic_learning_rate,
        discount=config.discount,
        target_rate=config.target_rate,
    )


def count_parameters(*networks: nn.Module) -> Counts:
    """Return the number of parameters of each."""
    return tuple(sum(parameter.numel() for parameter in network.parameters()) for network in networks)


VARIANTS = {"ours": ours, "SB3 DDPG.train": sb3, "torchrl plain loop": torchrl_loop}


def make_updates(config: Config, rows: TensorDict) -> dict[str, Update]:
    """Return an update of each; their networks have the same numbers of parameters.

    Raises:
        RuntimeError: if they do not.
    """
    made = {name: variant(config, rows) for name, variant in VARIANTS.items()}
    counts = {name: parameters for name, (_, parameters) in made.items()}
    if len(set(counts.values())) != 1:
        raise RuntimeError(f"the networks differ, this would compare apples with pears: {counts}")
    return {name: run for name, (run, _) in made.items()}


Case = tuple[str, int, str]
"""Down-sampling, batch size, variant."""


def measure(benchmark: Benchmark) -> dict[Case, float]:
    """Return medians of the time of an update [s], all taken by turns."""
    rows = Rows(64).take(benchmark.rows)
    default = Config(hindsight="none", replay_capacity=benchmark.rows)
    measures = {}
    for downsample, size in itertools.product(benchmark.downsamples, benchmark.batch_sizes):
        config = dataclasses.replace(default, batch_size=size, downsample=downsample)
        for name, run in make_updates(config, rows).items():
            measures[downsample, size, name] = partial(seconds_a_call, run, benchmark.updates)
    return alternate(measures, benchmark.rounds)


def main(benchmark: Benchmark) -> None:
    """Print and save the table."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    torchrl_logger.setLevel("WARNING")
    warm_heap()
    seconds = measure(benchmark)
    title = (
        f"DDPG updates, one thread, medians of {benchmark.rounds} alternating rounds of {benchmark.updates}, processor "
        "time. The factors tell how many times as fast ours is: with the same networks, and with strides."
    )
    header = ("networks", "batch", "variant", "ms an update", "updates/s", "ours, same networks", "ours, strides")
    lines = [
        [downsample, str(size), name, f"{value * 1e3:.1f}", f"{1 / value:.0f}"]
        + [f"{value / seconds[other, size, 'ours']:.2f}" for other in (downsample, benchmark.downsamples[0])]
        for (downsample, size, name), value in seconds.items()
    ]
    report("updates", [Table(title, header, lines)])


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
