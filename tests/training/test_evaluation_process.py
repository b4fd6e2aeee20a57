"""A process of its own gives the figures that evaluation here and now gives, of the policy that was handed over."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn

from halgan_rl.training.evaluation import evaluate
from halgan_rl.training.evaluation_process import EvaluationProcess, evaluate_at_once
from tests.training.test_evaluation import Corridor

SEEDS = [2, 1, 0]
ROOT = Path(__file__).parents[2]


def make_policy(speed: float) -> TensorDictModule:
    """Return a policy that goes on at one speed."""
    layer = nn.Linear(1, 1)
    nn.init.zeros_(layer.weight)
    nn.init.constant_(layer.bias, speed)
    return TensorDictModule(layer, in_keys=["position"], out_keys=["action"])


def unmakeable() -> Corridor:
    """Stand for an environment that cannot be made."""
    raise OSError("no display")


def test_policies_are_evaluated_in_order_as_they_were_when_handed_over() -> None:
    fast, slow = (
        evaluate(Corridor(), make_policy(1.0), seeds=SEEDS),
        evaluate(Corridor(), make_policy(0.1), seeds=SEEDS),
    )
    assert fast != slow
    with EvaluationProcess(Corridor, seeds=SEEDS) as process:
        policy = make_policy(1.0)
        first = process(policy)
        with torch.no_grad():
            policy.module.bias.fill_(0.1)
        second = process(policy)
        assert (first.result(timeout=60), second.result(timeout=60)) == (fast, slow)


def test_at_once_it_is_done_when_it_returns() -> None:
    future = evaluate_at_once(Corridor(), make_policy(1.0), seeds=SEEDS)
    assert future.done()
    assert future.result() == evaluate(Corridor(), make_policy(1.0), seeds=SEEDS)


def test_what_evaluation_raises_arrives() -> None:
    with EvaluationProcess(Corridor, seeds=[]) as process, pytest.raises(ValueError, match="seeds is empty"):
        process(make_policy(1.0)).result(timeout=60)


def test_a_process_that_cannot_start_is_told_with_the_remedy_before_training_begins() -> None:
    process = EvaluationProcess(unmakeable, seeds=SEEDS)
    with pytest.raises(RuntimeError, match="--no-background-evaluation"):
        process.__enter__()


def test_a_process_that_dies_is_told_with_the_remedy() -> None:
    with pytest.raises(RuntimeError, match="has died"), EvaluationProcess(Corridor, seeds=SEEDS) as process:
        process(Suicide()).result(timeout=60)


class Suicide(nn.Module):
    """Stands for whatever the system kills."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        os.kill(os.getpid(), signal.SIGKILL)
        return tensordict


def test_after_an_error_in_training_nothing_is_waited_for() -> None:
    started = time.monotonic()
    with pytest.raises(ValueError, match="lost"), EvaluationProcess(Slow, seeds=SEEDS) as process:
        train_in_vain(process)
    assert time.monotonic() - started < 30


def train_in_vain(process: EvaluationProcess) -> None:
    process(make_policy(1.0))
    raise ValueError("lost")


class Slow(Corridor):
    """A minute a reset."""

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        time.sleep(60)
        return super()._reset(tensordict)


PARENT = """
import os, time
from halgan_rl.training.evaluation_process import EvaluationProcess
from tests.training.test_evaluation import Corridor
if __name__ == "__main__":
    with EvaluationProcess(Corridor, seeds=[1]) as process:
        print(process._started.result(), flush=True)
        time.sleep(60)
"""


def test_the_process_ends_with_its_parent_however_that_ends(tmp_path: Path) -> None:
    (tmp_path / "parent.py").write_text(PARENT)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(tmp_path / "parent.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as parent:
        child = int(parent.stdout.readline())
        assert is_alive(child)
        parent.kill()
    deadline = time.monotonic() + 10
    while is_alive(child) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not is_alive(child)


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended but was not waited for does not."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"
