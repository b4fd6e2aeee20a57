"""The recipe learns something, repeats itself, and refuses bad input before any work is done."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

import halgan_envs
import tests.recipes
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import changed, parse_config
from halgan_rl.experiment.run_folder import read_metrics
from halgan_rl.transforms.annealing import Annealing
from recipes import play
from recipes.ddpg_navigate import DEFAULT, PRESETS, main
from tests.recipes import without_pictures

TINY = changed(DEFAULT, tests.recipes.TINY)


def run(out: Path, changes: dict[str, Any] | None = None) -> dict[str, torch.Tensor]:
    """Run the recipe without its pictures; return the policy that it saved."""
    with without_pictures():
        main(changed(TINY, {"out": out, **(changes or {})}))
    return load_file(out / "policy.safetensors")


def differ(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> set[str]:
    """Return the names of the parameters in which two policies differ."""
    return {name for name in one if not torch.equal(one[name], other[name])}


@pytest.fixture(scope="module")
def halgan_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "halgan"
    main(changed(TINY, {"out": out}))
    return out


def test_every_parameter_of_the_policy_is_updated(halgan_run: Path, tmp_path: Path) -> None:
    untrained = run(tmp_path / "untrained", {"total_frames": 48, "evaluation.every": 48})
    trained = load_file(halgan_run / "policy.safetensors")
    assert differ(trained, untrained) == set(trained)


def test_the_average_of_the_policy_is_saved_not_the_last_one(halgan_run: Path, tmp_path: Path) -> None:
    last = run(tmp_path / "last", {"training.policy_average": 0.0})
    assert differ(load_file(halgan_run / "policy.safetensors"), last) == set(last)


def test_all_methods_start_from_the_same_agent(tmp_path: Path) -> None:
    untrained = [
        run(tmp_path / method, {"method": method, "total_frames": 48, "evaluation.every": 48})
        for method in ("halgan", "none")
    ]
    assert differ(*untrained) == set()


def test_everything_promised_is_written(halgan_run: Path) -> None:
    written = {path.name for path in halgan_run.iterdir()}
    assert written == {
        "agent.gif",
        "config.json",
        "curve.png",
        "hallucinations.png",
        "metrics.csv",
        "policy.json",
        "policy.safetensors",
    }
    metrics = read_metrics(halgan_run / "metrics.csv")
    assert metrics["frames"] == [80, 160]
    assert 0.05 < metrics["train/hallucinated_fraction"][-1] < 0.5
    assert json.loads((halgan_run / "config.json").read_text())["config"]["method"] == "halgan"


def test_a_run_repeats_itself_bit_for_bit(halgan_run: Path, tmp_path: Path) -> None:
    again = run(tmp_path / "again")
    assert differ(load_file(halgan_run / "policy.safetensors"), again) == set()
    first, second = (read_metrics(path / "metrics.csv") for path in (halgan_run, tmp_path / "again"))
    assert first.pop("seconds") != second.pop("seconds")
    assert repr(first) == repr(second)  # NaN, where no episode ended, is equal to itself as text only


def test_evaluation_in_the_background_changes_nothing(halgan_run: Path, tmp_path: Path) -> None:
    beside = run(tmp_path / "beside", {"evaluation.background": True})
    assert differ(load_file(halgan_run / "policy.safetensors"), beside) == set()
    at_once, later = (read_metrics(path / "metrics.csv") for path in (halgan_run, tmp_path / "beside"))
    assert at_once.pop("seconds") != later.pop("seconds")
    assert repr(at_once) == repr(later)
    assert len(set(at_once["eval/return"])) == 2  # the two policies that were handed over can be told apart


@pytest.mark.slow  # tests/training/test_background_collector.py has the quick one
def test_collection_in_the_background_repeats_itself_a_batch_behind(halgan_run: Path, tmp_path: Path) -> None:
    one, other = (run(tmp_path / name, {"training.background_collection": True}) for name in ("one", "other"))
    assert differ(one, other) == set()
    assert differ(one, load_file(halgan_run / "policy.safetensors")) == set(one)
    metrics = read_metrics(tmp_path / "one" / "metrics.csv")
    assert metrics["frames"] == [80, 160]
    assert 0.05 < metrics["train/hallucinated_fraction"][-1] < 0.5


FAILING = """
import pathlib, sys
from halgan_rl.agents.agent import Agent
from recipes.ddpg_navigate import main
from halgan_rl.experiment.presets import changed
from tests.recipes.test_ddpg_navigate import TINY

def fail(agent, batch):
    raise ValueError("lost")

if __name__ == "__main__":
    Agent.update = fail
    both = {"training.background_collection": True, "evaluation.background": True}
    main(changed(TINY, {**both, "out": pathlib.Path(sys.argv[1], "run")}))
"""


def test_an_error_in_training_ends_the_processes_beside_it(tmp_path: Path) -> None:
    (tmp_path / "failing.py").write_text(FAILING)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, str(tmp_path / "failing.py"), str(tmp_path)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert ended.returncode == 1
    assert "ValueError: lost" in ended.stderr


def test_seed_and_method_change_what_is_learned(halgan_run: Path, tmp_path: Path) -> None:
    trained = load_file(halgan_run / "policy.safetensors")
    for name, changes in {
        "seed": {"seed": 1},
        "oracle": {"method": "oracle"},
        "none": {"method": "none"},
    }.items():
        assert differ(trained, run(tmp_path / name, changes)) == set(trained), name
    assert not (tmp_path / "none" / "hallucinations.png").exists()
    assert read_metrics(tmp_path / "none" / "metrics.csv")["train/hallucinated_fraction"][-1] == 0


def test_the_saved_policy_plays(halgan_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    play.main(play.Config(run=halgan_run, starts=2, gif=tmp_path / "film.gif"))
    assert "success rate" in capsys.readouterr().out
    assert (tmp_path / "film.gif").stat().st_size > 1000


def test_what_a_run_is_told_of_goals_reaches_its_hindsight() -> None:
    domain = halgan_envs.domain("pick-and-place-2m")
    config = changed(TINY, {"method": "oracle", "hindsight.nearness": 3.0})
    stamp, draw, paint, reward = make_hindsight(config, domain).transforms
    assert (stamp.max_distance, draw.nearness, paint.pursue_unseen) == (32, 3.0, False)
    assert stamp.poses == draw.poses == reward.poses == domain.poses
    assert domain.poses.flags == ("held",)


def test_a_run_builds_one_environment_each_to_train_to_evaluate_and_to_film(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    halgan_envs.domain("navigate-2m")  # builds the goal renderer's, once in a process
    built, initialise = [], halgan_envs.Environment.__init__

    def count(self: halgan_envs.Environment, *args: Any, **kwargs: Any) -> None:
        built.append(self)
        initialise(self, *args, **kwargs)

    monkeypatch.setattr(halgan_envs.Environment, "__init__", count)
    main(changed(TINY, {"out": tmp_path / "run"}))
    assert len(built) == 3


def test_a_folder_that_holds_a_run_is_refused_first(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("precious")
    with pytest.raises(FileExistsError, match="already holds a run"):
        main(changed(TINY, {"out": tmp_path}))
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]


def test_an_unknown_environment_is_refused_before_the_folder_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'moon'.*navigate-2m"):
        main(changed(TINY, {"environment": "moon", "method": "none", "out": tmp_path / "run"}))
    assert not (tmp_path / "run").exists()


def test_an_environment_with_other_actions_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"DDPG needs continuous actions.*DDQN"):
        main(changed(TINY, {"environment": "pebble", "method": "none", "out": tmp_path / "run"}))
    assert not (tmp_path / "run").exists()


def test_weights_for_another_room_are_refused_before_the_folder_is_made(tmp_path: Path) -> None:
    other = Path(__file__).parents[2] / "halgan_rl" / "hallucination" / "shipped" / "navigate-4m.safetensors"
    with pytest.raises(ValueError, match=r"navigate-4m.*navigate-2m"):
        main(changed(TINY, {"out": tmp_path / "run", "painter.weights": other}))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("args", [["--no-such-flag", "1"], ["--agent.tau", "magic"], ["--preset", "nature"]])
def test_unknown_flags_and_values_are_refused(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        parse_config(PRESETS, args, description=None)
    assert exit_.value.code == 2
    assert args[1] in (printed := "".join(capsys.readouterr())) or args[0] in printed


def test_an_unknown_method_is_refused_before_the_folder_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"method='magic' is unknown: choose one of halgan, her, oracle, none"):
        main(changed(TINY, {"method": "magic", "out": tmp_path / "run"}))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("training.warmup_frames", 16),
        ("training.batch_size", 0),
        ("training.frames_per_batch", 0),
        ("evaluation.starts", 0),
        ("agent.tau", 0.0),
    ],
)
def test_values_that_cannot_work_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name.rpartition(".")[2]):
        changed(DEFAULT, {name: value})


def test_the_preset_chooses_the_defaults_and_flags_win() -> None:
    assert parse_config(PRESETS, [], description=None) == PRESETS["default"]
    assert not PRESETS["default"].hindsight.pursue_unseen
    assert parse_config(PRESETS, ["--preset", "paper"], description=None) == PRESETS["paper"]
    config = parse_config(PRESETS, ["--preset", "paper", "--training.batch-size", "16"], description=None)
    assert config == changed(PRESETS["paper"], {"training.batch_size": 16})


def test_the_paper_preset_is_the_papers_table() -> None:
    paper = PRESETS["paper"]
    agent, hindsight, training = paper.agent, paper.hindsight, paper.training
    assert (training.replay_capacity, training.warmup_frames, training.batch_size) == (100_000, 10_000, 32)
    assert training.frames_per_update == 1
    assert (agent.actor_learning_rate, agent.critic_learning_rate, agent.tau) == (1e-5, 1e-4, 1e-3)
    assert agent.epsilon == Annealing(1.0, 0.5, 100_000)
    assert (agent.discount, agent.noise, agent.clip_targets, agent.downsample) == (0.99, 0.1, False, "max_pool")
    assert hindsight.probability == Annealing(0.3, 0.0, 100_000)
    assert (hindsight.max_distance, hindsight.pursue_unseen, hindsight.nearness) == (32, True, 1.0)
    assert (paper.painter.bank, paper.painter.share_latent) == (False, False)
