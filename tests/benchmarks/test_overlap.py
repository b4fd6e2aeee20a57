"""The time of a training is read from its metrics, for each way of running it."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import overlap, tables
from benchmarks.overlap import WAYS, Benchmark, milliseconds_a_frame
from recipes import ddpg_navigate
from tests.recipes import TINY


@pytest.mark.slow
def test_a_training_is_timed() -> None:
    assert milliseconds_a_frame(ddpg_navigate, Benchmark(frames=160), TINY) > 0


def test_ways_are_compared_by_medians(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    times = iter([12.0, 8.0, 6.0] + [100.0] * 3 + [12.0, 8.0, 6.0])
    asked: list[dict[str, Any]] = []

    def timed(recipe: Any, benchmark: Benchmark, changes: dict[str, bool]) -> float:
        asked.append(changes)
        return next(times)

    monkeypatch.setattr(overlap, "milliseconds_a_frame", timed)
    monkeypatch.setattr(overlap, "RECIPES", {"navigate": ddpg_navigate})
    monkeypatch.setattr(overlap, "report", lambda name, found: tables.report(name, found, tmp_path))
    overlap.main(Benchmark(rounds=3))
    (table,) = json.loads((tmp_path / "overlap.json").read_text())["tables"]
    assert [row[2:] for row in table["rows"]] == [["12.0", "1.00"], ["8.0", "1.50"], ["6.0", "2.00"]]
    assert asked == list(WAYS.values()) * 3
