"""What hallucination costs a DDPG update, in one run on one machine.

Usage::

    python -m benchmarks.update_cost   # one thread, the recipe's batch

Times one update of the recipe (sample, loss, backward, both optimizer steps, target update) with no hindsight, with
HALGAN looked up in the bank, with its generator itself and with the simulator as oracle, at the share of relabelled
rows that the recipe starts from and at its mean over a run. Medians of alternating rounds; quote the ratios, machines
are noisy.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
import tyro
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import envs
from recipes.ddpg_navigate import (
    Config,
    make_agent,
    make_hallucinator,
    make_hindsight,
    make_loss,
    make_optimizer,
    update,
)

PAINTERS: dict[str, dict[str, Any]] = {
    "bank": {"bank": True},
    "generator": {"bank": False},
    "oracle": {"hindsight": "oracle"},
}
"""Who paints, as changes of the recipe's configuration."""


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """What hallucination costs a DDPG update."""

    threads: int = 1
    """Threads of PyTorch."""
    rounds: int = 7
    """Alternating rounds; the median is reported."""
    updates: int = 20
    """Updates a round."""
    rows: int = 2_000
    """Random transitions in the buffer."""


def make_update(config: Config, rollout: TensorDict) -> Callable[[], object]:
    """Return one update of the recipe on a buffer of its own."""
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(rollout)),
        batch_size=config.batch_size,
        transform=make_hindsight(config, make_hallucinator(config)),
        generator=torch.Generator().manual_seed(0),
    )
    buffer.extend(rollout.clone())
    loss, updater = make_loss(config, *make_agent(config, action_size=2))
    optimizer = make_optimizer(config, loss)
    return lambda: update(buffer.sample(), loss, optimizer, updater)


def median_milliseconds(updates: dict[str, Callable[[], object]], benchmark: Benchmark) -> dict[str, float]:
    """Time all updates in alternating rounds."""
    times: dict[str, list[float]] = {name: [] for name in updates}
    for _ in range(benchmark.rounds + 1):
        for name, run in updates.items():
            started = time.perf_counter()
            for _ in range(benchmark.updates):
                run()
            times[name].append((time.perf_counter() - started) / benchmark.updates * 1e3)
    return {name: statistics.median(values[1:]) for name, values in times.items()}  # the first round warms up


def main(benchmark: Benchmark) -> None:
    """Print the table."""
    torch.set_num_threads(benchmark.threads)
    torch.manual_seed(0)
    default = Config()
    env = envs.make(default.environment, seed=0)
    rollout = env.rollout(benchmark.rows, break_when_any_done=False)
    env.close()
    mean_share = default.hallucination_start * (1 - default.total_frames / default.hallucination_frames / 2)
    updates = {"none": make_update(dataclasses.replace(default, hindsight="none"), rollout)}
    for name, changes in PAINTERS.items():
        for share in (default.hallucination_start, mean_share):
            config = dataclasses.replace(default, hallucination_start=share, **changes)
            updates[f"{name}, {share:.1%} relabelled"] = make_update(config, rollout)
    milliseconds = median_milliseconds(updates, benchmark)
    print(f"batch {default.batch_size}, {benchmark.threads} thread(s), medians of {benchmark.rounds} rounds")
    print(f"{'':28s} {'ms an update':>12s} {'share of it':>12s} {'ratio':>7s}")
    for name, value in milliseconds.items():
        print(f"{name:28s} {value:12.1f} {1 - milliseconds['none'] / value:12.1%} {value / milliseconds['none']:7.2f}")


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
