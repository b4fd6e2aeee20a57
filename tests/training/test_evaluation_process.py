"""A process of its own gives the metrics that evaluation here and now gives, of the policy that was handed over."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn

from halgan_rl.training.evaluation import evaluate
from halgan_rl.training.evaluation_process import EvaluationProcess, ProcessEndedError, evaluate_at_once
from tests.training.test_evaluation import Corridor

SEEDS = [2, 1, 0]


def make_policy(speed: float) -> TensorDictModule:
    """Return a policy that goes on at one speed."""
    layer = nn.Linear(1, 1)
    nn.init.zeros_(layer.weight)
    nn.init.constant_(layer.bias, speed)
    return TensorDictModule(layer, in_keys=["position"], out_keys=["action"])


def unmakeable() -> Corridor:
    """Stand for an environment that cannot be made."""
    raise OSError("no display")


@pytest.fixture(scope="module")
def process() -> Iterator[EvaluationProcess]:
    """One process for all tests that leave it running."""
    with EvaluationProcess(Corridor, seeds=SEEDS) as process:
        yield process


def test_policies_are_evaluated_in_order_as_they_were_when_handed_over(process: EvaluationProcess) -> None:
    fast, slow = (
        evaluate(Corridor(), make_policy(1.0), seeds=SEEDS),
        evaluate(Corridor(), make_policy(0.1), seeds=SEEDS),
    )
    assert fast != slow
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


def test_what_evaluation_raises_arrives_with_its_traceback(process: EvaluationProcess) -> None:
    with pytest.raises(OSError, match="lost") as caught:
        process(Unplugged()).result(timeout=60)
    assert "in forward" in "".join(caught.value.__notes__)


class Unplugged(nn.Module):
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise OSError("lost")


def test_an_error_that_cannot_be_sent_arrives_as_text(process: EvaluationProcess) -> None:
    with pytest.raises(RuntimeError, match="Unsendable: 1 and 2"):
        process(Faulty()).result(timeout=60)


class Unsendable(Exception):
    def __init__(self, one: int, other: int) -> None:
        super().__init__(f"{one} and {other}")


class Faulty(nn.Module):
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        raise Unsendable(1, 2)


def test_a_process_that_cannot_start_is_reported_with_reason_and_remedy_before_training_begins() -> None:
    process = EvaluationProcess(unmakeable, seeds=SEEDS)
    with pytest.raises(RuntimeError, match=r"no display.*--evaluation.no-background"):
        process.__enter__()
    assert not is_alive(process.pid)


@pytest.mark.parametrize(
    ("signal_number", "said"), [(signal.SIGKILL, "SIGKILL.*out of memory"), (signal.SIGSEGV, "ended by SIGSEGV")]
)
def test_a_process_that_is_killed_is_reported_with_the_signal(signal_number: int, said: str) -> None:
    process = EvaluationProcess(Corridor, seeds=SEEDS)
    os.kill(process.pid, signal_number)
    with pytest.raises(ProcessEndedError, match=f"{said}.*--evaluation.no-background"):
        process.__enter__()


def test_a_process_that_ends_is_reported_with_its_exit_code_to_all_who_wait_for_it() -> None:
    with EvaluationProcess(Corridor, seeds=SEEDS) as process:
        for evaluation in (process(Exiting()), process(make_policy(1.0))):
            with pytest.raises(ProcessEndedError, match=r"exit code 3.*--evaluation.no-background"):
                evaluation.result(timeout=60)


class Exiting(nn.Module):
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        os._exit(3)
        return tensordict


def test_an_evaluation_that_takes_too_long_is_given_up_and_its_process_ended() -> None:
    with EvaluationProcess(Corridor, seeds=SEEDS) as process:
        process._timeout = 0.5
        with pytest.raises(ProcessEndedError, match=r"longer than 0.5 s.*--evaluation.no-background"):
            process(Endless()).result(timeout=60)
        process._process.join(10)
        assert not is_alive(process.pid)


def test_a_start_that_takes_too_long_is_given_up() -> None:
    process = EvaluationProcess(unhurried, seeds=SEEDS, timeout=0.5)
    with pytest.raises(ProcessEndedError, match=r"longer than 0.5 s"):
        process.__enter__()
    assert not is_alive(process.pid)


def unhurried() -> Corridor:
    time.sleep(60)
    return Corridor()


class Endless(nn.Module):
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        time.sleep(60)
        return tensordict


def test_at_the_end_what_goes_on_is_waited_for_and_the_rest_is_dropped() -> None:
    with EvaluationProcess(Corridor, seeds=SEEDS) as process:
        first, second, third = process(Pausing(make_policy(1.0))), process(make_policy(0.1)), process(make_policy(0.1))
        while not first.running():
            time.sleep(0.01)
    assert first.result(timeout=0) == evaluate(Corridor(), make_policy(1.0), seeds=SEEDS)
    assert second.cancelled()
    assert third.cancelled()
    assert not is_alive(process.pid)


class Pausing(nn.Module):
    """Takes its time over the first step."""

    def __init__(self, policy: TensorDictModule) -> None:
        super().__init__()
        self.policy, self.pause = policy, 1.0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        time.sleep(self.pause)
        self.pause = 0.0
        return self.policy(tensordict)


def test_after_an_error_in_training_nothing_is_waited_for() -> None:
    with pytest.raises(ValueError, match="lost"), EvaluationProcess(Corridor, seeds=SEEDS) as process:
        train_in_vain(process)
    assert not is_alive(process.pid)


def train_in_vain(process: EvaluationProcess) -> None:
    evaluation = process(Endless())
    while not evaluation.running():
        time.sleep(0.01)
    raise ValueError("lost")


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended but was not waited for does not."""
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"
