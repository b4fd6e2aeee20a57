"""Where a training's time goes: milliseconds a frame and shares, for each of the recipes.

Usage::

    python -m benchmarks.frame_time

Runs the loop of ``halgan_rl.training.loop`` on the parts that ``halgan_rl.experiment.run`` makes for a recipe's default
configuration, past the warm-up, and times each part without those within it: rendering is not counted as physics.
Collecting, all together, bounds what collecting at the same time as learning could save. The loop's own part is the
moving average of the weights, and the metrics; files and pictures are left out. One thread, medians of processor time
in alternating rounds.

Evaluation is done at once here, not beside training, and spread over the frames between two of them. The agent of a
benchmark is untrained, its episodes run out of time; they are counted at a share of that, for over a training they get
shorter.
"""

import dataclasses
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
import tyro
from torchrl.data import TensorDictReplayBuffer

import halgan_envs
from benchmarks.rounds import take_turns, warm_heap
from benchmarks.tables import Table, report
from halgan_envs.adapters.torchrl_env import ComposerEnv
from halgan_rl.agents.agent import Agent
from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import EVALUATION_SEED, make_agent, make_buffer, make_collector
from halgan_rl.training.evaluation_process import evaluate_at_once
from halgan_rl.training.loop import COLUMNS, train
from halgan_rl.training.metrics import Report
from recipes import ddpg_navigate, ddpg_pick_place, ddqn_pebble

RECIPES = {
    "navigate-2m, DDPG": ddpg_navigate,
    "pick-and-place-2m, DDPG": ddpg_pick_place,
    "pebble, DDQN": ddqn_pebble,
}
ENDLESS = 1_000_000_000
"""Frames, more than anyone waits for."""

PHYSICS = "collecting: physics and task"
RENDERING = "collecting: rendering"
COLLECTOR = "collecting: TorchRL's environment and collector, policy"
WRITING = "writing rows, with their future poses"
SAMPLING = "sampling with hindsight"
UPDATE = "update"
LOOP = "the loop itself"
EVALUATION_RENDERING = "evaluation: rendering"
EVALUATION = "evaluation: all else"
PARTS = (PHYSICS, RENDERING, COLLECTOR, WRITING, SAMPLING, UPDATE, LOOP, EVALUATION_RENDERING, EVALUATION)
SUMS = {
    "together: collecting": (PHYSICS, RENDERING, COLLECTOR),
    "together: rendering": (RENDERING, EVALUATION_RENDERING),
    "together: a frame": PARTS,
}


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Where a training's time goes."""

    rounds: int = 5
    """Alternating rounds; medians are reported."""
    frames: int = 320
    """Frames a round."""
    rows: int = 1_008
    """Frames that are collected before, with random actions."""
    starts: int = 2
    """Fixed starts of the evaluation that ends a round; its time is scaled to those of the recipe."""
    episode_share: float = 0.5
    """How long an evaluated episode is taken to last, as a share of an untrained agent's: a mean over a training, which
    is 0.46 in `results/navigate-2m/halgan-seed0.csv`."""


class Stopwatch:
    """Times parts of a program, each without the parts that are called within it.

    Args:
        first: the part that goes on outside of all others.
        clock: tells the time [s].

    Attributes:
        seconds: by part.
    """

    def __init__(self, first: str, clock: Callable[[], float] = time.process_time) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._clock, self._part, self._since = clock, first, clock()

    def switch(self, part: str) -> str:
        """Time this part from now on; return the one before."""
        now, before = self._clock(), self._part
        self.seconds[before] += now - self._since
        self._part, self._since = part, now
        return before

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose calls are timed as this part."""

        def call(*args: Any, **kwargs: Any) -> Any:
            before = self.switch(part)
            try:
                return function(*args, **kwargs)
            finally:
                self.switch(before)

        return call

    def time_method(self, part: str, owner: Any, name: str) -> None:
        """Time an object's method as this part, from now on."""
        setattr(owner, name, self.timed(part, getattr(owner, name)))

    def restart(self) -> None:
        """Forget what was timed."""
        self.switch(self._part)
        self.seconds.clear()


Round = Callable[[], Mapping[str, float]]


def make_round(recipe: Any, benchmark: Benchmark, out: Path, changes: Mapping[str, Any]) -> Round:
    """Return what goes on with a training for a round, and tells the time of each part [s a frame].

    Args:
        recipe: the module; its default configuration is taken.
        benchmark: how long a round is.
        out: an unused folder, for metrics that nobody reads.
        changes: of the configuration.
    """
    values = {"training.warmup_frames": benchmark.rows, "total_frames": ENDLESS, "out": out}
    config = changed(recipe.DEFAULT, values | dict(changes))
    domain = halgan_envs.domain(config.environment)
    agent = make_agent(config, domain)
    hindsight = make_hindsight(config, domain)
    buffer = make_buffer(config.training, hindsight, seed=config.seed)
    env, evaluation_env = domain.make(seed=config.seed), domain.make()
    collector = iter(make_collector(config, domain, agent.explorer, env=env))
    while len(buffer) < benchmark.rows:
        buffer.extend(next(collector))

    watch = Stopwatch(LOOP)
    watch_parts(watch, env, evaluation_env, buffer, agent)
    collect = watch.timed(COLLECTOR, partial(next, collector))
    starts = range(EVALUATION_SEED, EVALUATION_SEED + benchmark.starts)
    run = partial(
        train,
        agent,
        buffer=buffer,
        hindsight=hindsight,
        config=dataclasses.replace(config.training, warmup_frames=1),
        total_frames=benchmark.frames,
        evaluate_every=benchmark.frames,
        evaluate=watch.timed(EVALUATION, partial(evaluate_at_once, evaluation_env, seeds=starts)),
        report=Report(COLUMNS, lambda row: None),
        save=lambda network: None,
        label=config.environment,
    )

    def go_on() -> Mapping[str, float]:
        watch.restart()
        run(collector=(collect() for _ in range(benchmark.frames // config.training.frames_per_batch)))
        watch.switch(LOOP)
        return a_frame(watch.seconds, config, benchmark)

    return go_on


def watch_parts(
    watch: Stopwatch, env: ComposerEnv, evaluation_env: ComposerEnv, buffer: TensorDictReplayBuffer, agent: Agent
) -> None:
    """Time what a training's parts do when the loop calls them."""
    for name in ("step", "reset"):
        watch.time_method(PHYSICS, env.environment, name)
    watch.time_method(RENDERING, env.robot.camera, "render")
    evaluation_env.reset()  # which opens its camera
    watch.time_method(EVALUATION_RENDERING, evaluation_env.robot.camera, "render")
    watch.time_method(WRITING, buffer, "extend")
    watch.time_method(SAMPLING, buffer, "sample")
    watch.time_method(UPDATE, agent, "update")


def a_frame(seconds: Mapping[str, float], config: RunConfig, benchmark: Benchmark) -> dict[str, float]:
    """Return times of a frame [s] for those of a round."""
    per_frame = {part: seconds[part] / benchmark.frames for part in PARTS}
    episodes = config.evaluation.starts / benchmark.starts * benchmark.episode_share
    for part in (EVALUATION_RENDERING, EVALUATION):
        per_frame[part] = seconds[part] * episodes / config.evaluation.every
    return per_frame


def describe(times: Mapping[str, Mapping[str, float]]) -> list[list[str]]:
    """Return the table's lines for the times of parts [s a frame], by recipe."""
    lines = []
    for name, parts in ({part: (part,) for part in PARTS} | SUMS).items():
        line = [name]
        for seconds in times.values():
            value = sum(seconds[part] for part in parts)
            line += [f"{value * 1e3:.2f}", f"{value / sum(seconds.values()):.1%}"]
        lines.append(line)
    return lines


def main(benchmark: Benchmark) -> None:
    """Print and save the table."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    warm_heap()
    with TemporaryDirectory() as folder:
        runs = {name: make_round(recipe, benchmark, Path(folder, name), {}) for name, recipe in RECIPES.items()}
        rounds = take_turns(runs, benchmark.rounds)
    times = {
        name: {part: statistics.median(values[part] for values in taken) for part in PARTS}
        for name, taken in rounds.items()
    }
    title = (
        f"A frame of a training past its warm-up, hindsight by HALGAN, one thread, medians of {benchmark.rounds} "
        f"alternating rounds of {benchmark.frames} frames, processor time. Evaluated episodes are taken to last "
        f"{benchmark.episode_share:.0%} of an untrained agent's."
    )
    header = ("part", *(column for name in times for column in (f"{name} [ms a frame]", "share")))
    report("frame_time", [Table(title, header, describe(times))])


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
