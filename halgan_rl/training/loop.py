"""The loop that all agents share: collect, replay with hindsight, update, evaluate."""

import copy
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Compose
from torchrl.modules import EGreedyModule
from torchrl.objectives import LossModule, TargetNetUpdater
from tqdm import tqdm

from halgan_rl.experiment.metrics import Means, Report
from halgan_rl.training.evaluation import Evaluation

COLUMNS = (
    "frames",
    "seconds",
    "eval/success_rate",
    "eval/return",
    "eval/episode_length",
    "train/success_rate",
    "train/hallucinated_fraction",
    "train/epsilon",
)
"""What :func:`train` writes whatever the loss; its own entries come beside them."""


@dataclass
class Agent:
    """An agent that learns.

    Attributes:
        network: chooses the actions; what is averaged, evaluated and saved. It learns on whatever device it is on.
        acting: the same network where the environment is, on the CPU: see :func:`on_cpu`.
        make_policy: wraps the network, or an average of it, as a deterministic policy.
        explorer: the acting network with its exploration; what collects.
        epsilon: the part of the explorer that acts at random, less and less.
        loss: TorchRL's loss.
        optimizer: of all parameters of the loss.
        target_updater: moves the target networks.
        figures: which of the loss's outputs to report, and as what: under ``train/`` and these names.
    """

    network: nn.Module
    acting: nn.Module
    make_policy: Callable[..., TensorDictModuleBase]
    explorer: TensorDictModuleBase
    epsilon: EGreedyModule
    loss: LossModule
    optimizer: torch.optim.Optimizer
    target_updater: TargetNetUpdater
    figures: Mapping[str, str]

    def update(self, batch: TensorDictBase) -> TensorDictBase:
        """Make one update; return the loss module's output, which stays on the network's device."""
        if self.acting is not self.network:
            device = next(self.network.parameters()).device
            batch = batch.select(*self.loss.in_keys, strict=False).to(device, non_blocking=True)
        losses = self.loss(batch)
        sum(value for name, value in losses.items() if name.startswith("loss")).backward()
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.target_updater.step()
        return losses

    def act_on_latest(self) -> None:
        """Let the acting network have what the other has learned."""
        if self.acting is not self.network:
            self.acting.load_state_dict(self.network.state_dict())


Network = TypeVar("Network", bound=nn.Module)


def on_cpu(network: Network) -> Network:
    """Return a network itself if it is on the CPU, or else a copy there: for one frame the way to a GPU is too long."""
    return network if next(network.parameters()).device.type == "cpu" else copy.deepcopy(network).cpu()


@dataclass(frozen=True)
class Schedule:
    """When what happens, in environment frames.

    Attributes:
        total_frames: how long training lasts.
        warmup_frames: frames before the first update.
        frames_per_update: frames for each update.
        evaluate_every: frames from one evaluation to the next.
    """

    total_frames: int
    warmup_frames: int
    frames_per_update: int
    evaluate_every: int

    def updates_due(self, frames: int) -> int:
        """Return how many updates there should have been after so many frames."""
        return max(frames - self.warmup_frames, 0) // self.frames_per_update


AT_ONCE = 16
"""Batches sampled together: hindsight costs little more than its memory traffic then; more would only take memory."""


def draw_batches(buffer: TensorDictReplayBuffer, count: int, size: int) -> Iterator[TensorDictBase]:
    """Yield so many batches of so many rows of a buffer, to which nothing is added between them.

    They are sampled together. Most of what hindsight costs is its number of operations on small tensors: on sixteen
    batches at once they cost hardly more than on one. What updates write, such as priorities, counts from the next
    sixteen on.

    Raises:
        ValueError: if the buffer gives another number of rows than it is asked for.
    """
    for first in range(0, count, AT_ONCE):
        asked = min(AT_ONCE, count - first) * size
        rows = buffer.sample(asked)
        if len(rows) != asked:
            raise ValueError(
                f"asked for {asked} rows, the replay buffer gave {len(rows)}: use a sampler with replacement, and no "
                "prefetch, which gives the number that was asked for before"
            )
        yield from rows.split(size)


def train(
    agent: Agent,
    collector: Iterable[TensorDictBase],
    buffer: TensorDictReplayBuffer,
    *,
    hindsight: Compose | None,
    schedule: Schedule,
    batch_size: int,
    policy_average: float,
    evaluate: Callable[[TensorDictModuleBase], Future[Evaluation]],
    report: Report,
    save: Callable[[nn.Module], None],
    label: str = "",
) -> TensorDictModuleBase:
    """Train an agent, with a progress bar; report metrics and save weights at each evaluation.

    Args:
        agent: what learns, in place.
        collector: yields transitions ``[T]``, in all as many as the schedule has frames.
        buffer: where they go; samples come with hindsight.
        hindsight: the buffer's pipeline, see :mod:`halgan_rl.transforms.pipelines`, whose probability this anneals; None for none.
        schedule: when what happens.
        batch_size: rows an update.
        policy_average: decay of the moving average of the network's weights, which is evaluated and saved; 0 takes the
            last weights.
        evaluate: judges a policy as it is when handed over, at once or beside training.
        report: gets a row of metrics for each evaluation; all are written when this returns.
        save: keeps the averaged network at each evaluation.
        label: what the progress bar is headed with.

    Returns:
        The policy of the averaged network, on the CPU.
    """
    average = AveragedModel(agent.network, multi_avg_fn=get_ema_multi_avg_fn(policy_average))
    policy = agent.make_policy(average.module)
    means = Means()
    frames, updates, next_evaluation = 0, 0, schedule.evaluate_every
    progress = tqdm(total=schedule.total_frames, unit="frame", desc=label, dynamic_ncols=True)
    for rollout in collector:
        buffer.extend(rollout)
        frames += rollout.numel()
        agent.epsilon.step(rollout.numel())
        if hindsight is not None:
            hindsight[1].step(rollout.numel())
        if (done := rollout["next", "done"]).any():
            means.add(success_rate=rollout["next", "terminated"][done].float().mean())

        for batch in draw_batches(buffer, schedule.updates_due(frames) - updates, batch_size):
            losses = agent.update(batch)
            average.update_parameters(agent.network)
            updates += 1
            relabelled = batch["goal", "mask"].float().mean() if hindsight is not None else torch.zeros(())
            figures = {shown: losses[name] for name, shown in agent.figures.items()}
            means.add(hallucinated_fraction=relabelled, **figures)
        agent.act_on_latest()

        if frames >= next_evaluation or frames >= schedule.total_frames:
            next_evaluation += schedule.evaluate_every
            metrics = {"frames": frames, "train/epsilon": float(agent.epsilon.eps)}
            metrics |= {f"train/{name}": value for name, value in means.pop().items()}
            report.add(metrics, evaluate(policy))
            save(average.module)
        report.write()
        progress.update(rollout.numel())
        progress.set_postfix(success=f"{report.success:.0%}", updates=updates, refresh=False)
    report.write(wait=True)
    progress.set_postfix(success=f"{report.success:.0%}", updates=updates)
    progress.close()
    return policy.cpu()
