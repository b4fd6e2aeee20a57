"""The report tells the truth from nothing painted, and refuses bad input first."""

import dataclasses
import json
import math
from pathlib import Path

import pytest

from recipes import evaluate_generator
from recipes.evaluate_generator import Config, main

TINY = Config(frames=100, probe_frames=150, probe_steps=60)


@pytest.mark.parametrize("bank", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_shipped_weights_are_near_the_truth(bank: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(dataclasses.replace(TINY, bank=bank, out=tmp_path / "report"))
    report = json.loads((tmp_path / "report" / "fidelity.json").read_text())
    assert report["mask"]["within 1 m"]["overlap"] > 0.6
    assert report["no_op"]["out_of_view"] < 1
    assert report["probe"]["truth"]["bearing_degrees"] > 0
    assert set(report["consistency"]) == {"real", "truth", "hallucinated"}
    assert (tmp_path / "report" / "fidelity.png").stat().st_size > 1000
    assert "mask overlap" in capsys.readouterr().out


@pytest.mark.slow
def test_goals_that_never_stay_in_view_have_no_scatter_and_all_else(tmp_path: Path) -> None:
    main(dataclasses.replace(TINY, environment="pebble", out=tmp_path / "report"))
    report = json.loads((tmp_path / "report" / "fidelity.json").read_text())
    assert all(math.isnan(value) for value in report["consistency"].values())
    assert report["mask"]["within 1 m"]["frames"] > 0
    assert report["no_op"]["out_of_view"] < 1


def test_nothing_painted_is_no_overlap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluate_generator, "GeneratorHallucinator", lambda *_, **__: lambda pixels, pose, goal: pixels)
    main(dataclasses.replace(TINY, out=tmp_path / "report"))
    report = json.loads((tmp_path / "report" / "fidelity.json").read_text())
    assert report["mask"]["all"]["overlap"] == 0
    assert report["no_op"]["outside_the_mask"] == 0


def test_a_folder_that_holds_a_report_is_refused_first(tmp_path: Path) -> None:
    (tmp_path / "fidelity.json").write_text("precious")
    with pytest.raises(FileExistsError, match="already holds a run"):
        main(dataclasses.replace(TINY, out=tmp_path))
