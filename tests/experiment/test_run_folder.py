"""A run's folder never overwrites, never leaves partial files."""

import json
from pathlib import Path

import pytest

from halgan_rl.experiment.run_folder import RunFolder, read_metrics, write_json


def test_a_folder_that_holds_a_run_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("precious")
    with pytest.raises(FileExistsError, match=r"already holds a run; choose another --out"):
        RunFolder(tmp_path, columns=("frames",))
    assert (tmp_path / "metrics.csv").read_text() == "precious"


def test_an_empty_folder_is_accepted(tmp_path: Path) -> None:
    RunFolder(tmp_path, columns=("frames",))
    assert (tmp_path / "metrics.csv").read_text().strip() == "frames"


def test_metrics_come_back_in_their_columns(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "new" / "run", columns=("frames", "eval/success_rate"))
    folder.write_metrics({"eval/success_rate": 0.25, "frames": 2000.0, "ignored": 1.0})
    folder.write_metrics({"eval/success_rate": 0.5, "frames": 4000.0})
    assert read_metrics(folder.file("metrics.csv")) == {"frames": [2000.0, 4000.0], "eval/success_rate": [0.25, 0.5]}


def test_large_numbers_of_frames_keep_all_their_digits(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", columns=("frames", "train/loss"))
    folder.write_metrics({"frames": 1_234_567, "train/loss": 0.123456789})
    assert folder.file("metrics.csv").read_text().splitlines()[1] == "1234567,0.123457"


def test_a_missing_column_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="frames"):
        RunFolder(tmp_path / "run", columns=("frames",)).write_metrics({"seconds": 1.0})


def test_the_configuration_names_the_versions(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run", columns=("frames",))
    folder.write_config({"seed": 3, "out": Path("x")})
    written = json.loads(folder.file("config.json").read_text())
    assert written["config"] == {"seed": 3, "out": "x"}
    assert {"python", "halgan-rl", "torch", "torchrl", "mujoco"} <= written["versions"].keys()


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {("no", "key"): 1})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": 1}
