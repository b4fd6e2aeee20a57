"""A process of its own gives the figures that evaluation here and now gives, of the policy that was handed over."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from halgan_rl.evaluation import evaluate
from halgan_rl.evaluation_process import EvaluationProcess, evaluate_at_once
from tests.test_evaluation import Corridor

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


def test_a_process_that_cannot_start_is_told_with_the_remedy() -> None:
    with (
        pytest.raises(RuntimeError, match="--no-background-evaluation"),
        EvaluationProcess(unmakeable, seeds=SEEDS) as process,
    ):
        process(make_policy(1.0)).result(timeout=60)
