"""The loop that all agents share: collect, replay with hindsight, update, evaluate."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import TensorDictReplayBuffer
from tqdm import tqdm

from halgan_rl.agents.agent import Agent
from halgan_rl.keys import Keys
from halgan_rl.training.evaluation import Evaluation
from halgan_rl.training.metrics import Means, Report
from halgan_rl.transforms.pipelines import Hindsight, check_sampler

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
"""What :func:`train` writes whatever the loss; the agent's own metrics come beside them."""


@dataclass(frozen=True)
class TrainingConfig:
    """How an agent is trained, whatever its algorithm."""

    replay_capacity: int = 100_000
    """Rows of the replay buffer."""
    warmup_frames: int = 2_000
    """Frames collected with random actions before the first update."""
    batch_size: int = 32
    """Rows an update."""
    frames_per_update: int = 1
    """Environment steps for each update."""
    frames_per_batch: int = 16
    """Environment steps collected at a time."""
    policy_average: float = 0.998
    """Decay of the moving average of the policy's weights, which is evaluated and saved; 0 takes the last ones."""
    background_collection: bool = False
    """Collect in a process of its own while the agent is updated, by a policy that is a batch older."""

    def __post_init__(self) -> None:
        """Refuses values that would fail only later."""
        for name in ("replay_capacity", "warmup_frames", "batch_size", "frames_per_update", "frames_per_batch"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 <= self.policy_average < 1:
            raise ValueError(f"policy_average must lie in [0, 1), got {self.policy_average}")

    def updates_due(self, frames: int) -> int:
        """Returns how many updates there should have been after so many frames."""
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
    hindsight: Hindsight,
    config: TrainingConfig,
    *,
    total_frames: int,
    evaluate_every: int,
    evaluate: Callable[[TensorDictModuleBase], Future[Evaluation]],
    report: Report,
    save: Callable[[nn.Module], None],
    keys: Keys = Keys(),
    label: str = "",
) -> TensorDictModuleBase:
    """Trains an agent, with a progress bar; reports metrics and saves weights at each evaluation.

    Args:
        agent: learns, in place.
        collector: yields transitions ``[T]``, ``total_frames`` in all.
        buffer: keeps them; its samples come with hindsight.
        hindsight: the buffer's pipeline, which this anneals.
        config: how.
        total_frames: environment frames.
        evaluate_every: frames from one evaluation to the next.
        evaluate: judges a policy as it is when handed over, at once or beside training.
        report: gets a row of metrics for each evaluation; all are written when this returns.
        save: keeps the averaged network at each evaluation.
        keys: where rows keep what.
        label: heads the progress bar.

    Returns:
        The policy of the averaged network, on the CPU.
    """
    check_sampler(buffer)
    average = AveragedModel(agent.network, multi_avg_fn=get_ema_multi_avg_fn(config.policy_average))
    policy = agent.make_policy(average.module)
    means = Means()
    frames = updates = 0
    progress = tqdm(total=total_frames, unit="frame", desc=label, dynamic_ncols=True)
    for rollout in collector:
        # Collect.
        buffer.extend(rollout)
        before, frames = frames, frames + rollout.numel()
        agent.step(rollout.numel())
        hindsight.step(rollout.numel())
        if (done := rollout[keys.next("done")]).any():
            means.add(success_rate=rollout[keys.next("terminated")][done].float().mean())

        # Replay and update.
        for batch in draw_batches(buffer, config.updates_due(frames) - updates, config.batch_size):
            losses = agent.update(batch)
            average.update_parameters(agent.network)
            updates += 1
            metrics = {shown: losses[name] for name, shown in agent.metrics.items()}
            means.add(hallucinated_fraction=hindsight.relabelled(batch).float().mean(), **metrics)
        agent.act_on_latest()

        # Evaluate and save.
        if before // evaluate_every < frames // evaluate_every or frames >= total_frames:
            row = {"frames": frames, "train/epsilon": agent.epsilon}
            row |= {f"train/{name}": value for name, value in means.pop().items()}
            report.add(row, evaluate(policy))
            save(average.module)
        report.write()
        progress.update(rollout.numel())
        progress.set_postfix(success=report.shown_success, updates=updates, refresh=False)
    report.write(wait=True)
    progress.set_postfix(success=report.shown_success, updates=updates)
    progress.close()
    return policy.cpu()
