"""What hallucination costs a DDPG update, in one run on one machine.

Usage::

    python -m benchmarks.update_cost   # the recipe's batch

Times updates of the recipe (sample, loss, backward, both optimizer steps, target update), sampled sixteen at once as
in a training (:func:`halgan_rl.training.loop.draw_batches`): with no hindsight, with goals that are drawn and
rewarded but not painted, with HALGAN looked up in the bank, with its generator itself, and with the simulator as
oracle. A goal is drawn for the fraction of rows at the start of the recipe, and for its mean over a run. All of these
rows are painted; about half show nothing of their goal and are not relabelled in the end. Medians of processor time in
alternating rounds; quote the ratios, machines are noisy.
"""

import dataclasses
import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
import tyro
from tensordict import TensorDict
from torch import Tensor

import halgan_envs
from benchmarks.rounds import ratio, seconds_a_call, take_turns, warm_heap
from benchmarks.tables import Table, report
from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.methods import make_hindsight, relabelling
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import make_agent, make_buffer
from halgan_rl.training.loop import draw_batches
from halgan_rl.transforms import pipelines
from halgan_rl.transforms.pipelines import Hindsight
from recipes.ddpg_navigate import DEFAULT

NONE = {"method": "none"}
PAINTERS: dict[str, dict[str, Any]] = {
    "bank": {"painter.bank": True},
    "generator": {"painter.bank": False},
    "oracle": {"method": "oracle"},
}
"""Who paints, as changes of the recipe's configuration."""


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """What hallucination costs a DDPG update."""

    rounds: int = 21
    """Alternating rounds; the median is reported."""
    updates: int = 32
    """Updates a round."""
    rows: int = 2_000
    """Random transitions in the buffer."""


def make_updates(config: RunConfig, rollout: TensorDict, hindsight: Hindsight, count: int) -> Callable[[], None]:
    """Return updates of the recipe on a buffer of its own."""
    domain = halgan_envs.domain(config.environment)
    buffer = make_buffer(changed(config, {"training.replay_capacity": len(rollout)}).training, hindsight, seed=0)
    buffer.extend(rollout.clone())
    agent = make_agent(config, domain)

    def run() -> None:
        for batch in draw_batches(buffer, count, config.training.batch_size):
            agent.update(batch)

    return run


def paint_nothing(pixels: Tensor, pose: Tensor, goal_pose: Tensor) -> Tensor:
    """Return the pixels as they are: what hindsight costs without its pictures."""
    del pose, goal_pose
    return pixels


def main(benchmark: Benchmark) -> None:
    """Print the table."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    warm_heap()
    default = DEFAULT
    domain = halgan_envs.domain(default.environment)
    env = domain.make(seed=0)
    rollout = env.rollout(benchmark.rows, break_when_any_done=False)
    env.close()
    start = default.hindsight.probability.start
    mean = (start + default.hindsight.probability.at(default.total_frames)) / 2
    updates = {
        "none": make_updates(default, rollout, make_hindsight(changed(default, NONE), domain), benchmark.updates)
    }
    for fraction in (start, mean):
        config = changed(default, {"hindsight.probability.start": fraction})
        unpainted = pipelines.halgan(paint_nothing, **relabelling(config, domain))
        updates[f"not painted, {fraction:.1%} drawn"] = make_updates(config, rollout, unpainted, benchmark.updates)
        for name, changes in PAINTERS.items():
            hindsight = make_hindsight(changed(config, changes), domain)
            updates[f"{name}, {fraction:.1%} drawn"] = make_updates(config, rollout, hindsight, benchmark.updates)
    measures = {name: partial(seconds_a_call, run, 1) for name, run in updates.items()}
    seconds = take_turns(measures, benchmark.rounds)
    title = (
        f"Hallucination in a DDPG update, batch {default.training.batch_size}, one thread, medians of "
        f"{benchmark.rounds} alternating rounds of {benchmark.updates}, processor time; ratios are medians of those of "
        "each round."
    )
    lines = [
        [
            name,
            f"{statistics.median(value) / benchmark.updates * 1e3:.1f}",
            f"{1 - ratio(seconds['none'], value):.1%}",
            f"{ratio(value, seconds['none']):.2f}",
        ]
        for name, value in seconds.items()
    ]
    report("update_cost", [Table(title, ("painter", "ms an update", "fraction of it", "ratio to none"), lines)])


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
