"""Timing by turns: what else the machine does falls on all variants alike."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import torch

Name = TypeVar("Name")
Value = TypeVar("Value")


def warm_heap(size: int = 32 << 20) -> None:
    """Take and give back a block of memory.

    From then on glibc keeps what tensors of up to this size [bytes] give back, as it does in a training, instead of
    returning it to the system and faulting it in again at each sample.
    """
    torch.empty(size - (1 << 16), dtype=torch.uint8).fill_(0)


def seconds_a_call(run: Callable[[], object], calls: int) -> float:
    """Return processor time [s] of one call, a mean over some; on one thread it is wall time less others' share."""
    started = time.process_time()
    for _ in range(calls):
        run()
    return (time.process_time() - started) / calls


def take_turns(measures: Mapping[Name, Callable[[], Value]], rounds: int) -> dict[Name, list[Value]]:
    """Take each measure by turns, in ``rounds`` rounds after one to warm up; return all but that one's values."""
    values: dict[Name, list[Value]] = {name: [] for name in measures}
    for _ in range(rounds + 1):
        for name, measure in measures.items():
            values[name].append(measure())
    return {name: measured[1:] for name, measured in values.items()}


def ratio(values: Sequence[float], others: Sequence[float]) -> float:
    """Return the median of the rounds' ratios: a spell in which the machine is slow falls on both sides of each."""
    return statistics.median(value / other for value, other in zip(values, others, strict=True))
