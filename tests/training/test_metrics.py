"""Rows are written in order, each as soon as its evaluation and those before it are done."""

import math
from concurrent.futures import Future
from pathlib import Path

import pytest

from halgan_rl.experiment.run_folder import RunFolder, read_metrics
from halgan_rl.training.evaluation import Evaluation
from halgan_rl.training.metrics import Report

COLUMNS = ("frames", "seconds", "eval/success_rate", "train/loss", "train/unheard_of")


def evaluation(success: float) -> Evaluation:
    return Evaluation(success, episode_return=0.0, episode_length=1.0)


class Log:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.told: dict[tuple[str, int], float] = {}

    def log_scalar(self, name: str, value: float, step: int) -> None:
        self.told[name, step] = value


def test_a_row_waits_for_its_evaluation_and_for_those_before_it(tmp_path: Path) -> None:
    folder, log = RunFolder(tmp_path / "run", columns=COLUMNS), Log()
    report = Report(folder.columns, folder.write_metrics, log)
    first, second = Future(), Future()
    report.add({"frames": 10, "train/loss": 2.0}, first)
    report.add({"frames": 20}, second)
    second.set_result(evaluation(0.5))
    report.write()
    assert read_metrics(folder.file("metrics.csv")) == {}
    assert math.isnan(report.success)
    assert report.shown_success == "-"

    first.set_result(evaluation(0.25))
    report.write()
    metrics = read_metrics(folder.file("metrics.csv"))
    assert (metrics["frames"], metrics["eval/success_rate"], report.success) == ([10, 20], [0.25, 0.5], 0.5)
    assert metrics["train/loss"][0] == 2.0
    assert math.isnan(metrics["train/loss"][1])
    assert log.told["eval/success_rate", 10] == 0.25
    assert all(seconds > 0 for seconds in metrics["seconds"])


def test_waiting_writes_all_and_raises_what_an_evaluation_raised(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", columns=COLUMNS)
    report = Report(folder.columns, folder.write_metrics)
    good, bad = Future(), Future()
    good.set_result(evaluation(1.0))
    bad.set_exception(ValueError("lost"))
    report.add({"frames": 10}, good)
    report.add({"frames": 20}, bad)
    with pytest.raises(ValueError, match="lost"):
        report.write(wait=True)
    assert read_metrics(folder.file("metrics.csv"))["frames"] == [10]
