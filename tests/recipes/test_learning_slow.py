"""The claim of the whole library, on the real environment; about ten minutes. `make test-slow` runs it."""

from pathlib import Path

import pytest

from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run_folder import read_metrics
from recipes.ddpg_navigate import DEFAULT, main


def success_rates(out: Path, method: str) -> list[float]:
    main(changed(DEFAULT, {"method": method, "total_frames": 10_000, "out": out, "evaluation.film_starts": 1}))
    return read_metrics(out / "metrics.csv")["eval/success_rate"]


@pytest.mark.slow
def test_an_agent_learns_with_hallucinations_and_not_without(tmp_path: Path) -> None:
    assert max(success_rates(tmp_path / "halgan", "halgan")) >= 0.8
    assert max(success_rates(tmp_path / "none", "none")) <= 0.05
