"""Every variant of the ablation changes what its name says, and trains."""

import dataclasses
import json
from pathlib import Path

import pytest

from benchmarks import halgan_ablation
from benchmarks.halgan_ablation import PAPER, REGRESSION, VARIANTS, Ablation, make_config
from recipes import train_generator


def test_variants_differ_from_each_other_and_leave_the_paper_alone() -> None:
    configs = [make_config(name, Ablation(), Path("out")) for name in VARIANTS]
    assert len({json.dumps(dataclasses.asdict(config), default=str) for config in configs}) == len(VARIANTS)
    paper = dataclasses.asdict(make_config(PAPER, Ablation(), Path("out")))
    changed = {
        name for name, value in dataclasses.asdict(train_generator.PRESETS["paper"]).items() if paper[name] != value
    }
    assert changed == {"minutes", "evaluate_every", "out"}


@pytest.mark.slow
def test_the_table_has_a_line_for_each_variant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = {f"data.{name}": 40 for name in ("near_goal_frames", "failed_frames")}
    tiny |= {"data.held_out_frames": 4, "evaluate_every": 1}
    monkeypatch.setattr(halgan_ablation, "VARIANTS", {REGRESSION: ("default", tiny), PAPER: ("paper", tiny)})
    ablation = Ablation(out=tmp_path / "table", minutes=1e-6, paper_minutes=1e-6, only=(REGRESSION, PAPER))
    halgan_ablation.main(ablation)
    table = json.loads((tmp_path / "table" / "ablation.json").read_text())["tables"][0]
    assert [row[0] for row in table["rows"]] == [REGRESSION, PAPER]
    assert {path.suffix for path in (tmp_path / "table").iterdir()} == {".csv", ".json", ".png"}
    monkeypatch.setattr(halgan_ablation, "train", None)  # what is there already is not trained again
    halgan_ablation.main(ablation)


def test_unknown_variants_are_refused_first(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown variants"):
        halgan_ablation.main(Ablation(out=tmp_path / "table", only=("magic",)))
    assert not (tmp_path / "table").exists()
