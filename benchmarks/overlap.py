"""Wall time of whole trainings: evaluating and collecting here, or beside learning in processes of their own.

Usage::

    python -m benchmarks.overlap   # ten minutes; needs two processors with nothing else to do

Runs each recipe in its default configuration, but short, in all three ways by turns, and takes the time from its first
evaluation to its last. That is early in a training, when the episodes that are evaluated are longest. With
``background_evaluation`` nothing that is learned or measured changes; with ``background_collection`` the exploring
policy is a batch older.
"""

import dataclasses
import statistics
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import torch
import tyro

from benchmarks.frame_time import RECIPES
from benchmarks.tables import Table, report
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run_folder import read_metrics

WAYS: dict[str, dict[str, bool]] = {
    "all in one process": {"evaluation.background": False, "training.background_collection": False},
    "evaluation beside": {"evaluation.background": True, "training.background_collection": False},
    "evaluation and collection beside": {"evaluation.background": True, "training.background_collection": True},
}


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """Wall time of whole trainings."""

    rounds: int = 1
    """Trainings of each kind, by turns; the median is reported."""
    frames: int = 4_000
    """Frames of a training, of which the first evaluation's are not timed."""


def milliseconds_a_frame(recipe: ModuleType, benchmark: Benchmark, changes: dict[str, Any]) -> float:
    """Train once; return the wall time of a frame [ms], from the first evaluation to the last."""
    with TemporaryDirectory() as folder:
        tiny = {"total_frames": benchmark.frames, "out": Path(folder, "run"), "evaluation.film_starts": 1}
        config = changed(recipe.DEFAULT, tiny | changes)
        recipe.main(config)
        metrics = read_metrics(config.out / "metrics.csv")
    frames, seconds = ([values[0], values[-1]] for values in (metrics["frames"], metrics["seconds"]))
    return 1e3 * (seconds[1] - seconds[0]) / (frames[1] - frames[0])


def main(benchmark: Benchmark) -> None:
    """Print and save the table."""
    torch.set_num_threads(1)
    lines = []
    for name, recipe in RECIPES.items():
        time_of = partial(milliseconds_a_frame, recipe, benchmark)
        rounds = [{way: time_of(changes) for way, changes in WAYS.items()} for _ in range(benchmark.rounds)]
        medians = {way: statistics.median(times[way] for times in rounds) for way in WAYS}
        slowest = medians["all in one process"]
        lines += [[name, way, f"{value:.1f}", f"{slowest / value:.2f}"] for way, value in medians.items()]
    title = (
        "A frame of a training, hindsight by HALGAN, wall time with two processors for one training; trainings of each "
        f"kind: {benchmark.rounds}."
    )
    header = ("recipe", "where", "ms a frame", "times as fast")
    report("overlap", [Table(title, header, lines)])


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))
