"""The siblings of the first recipe train all parameters, repeat themselves, and can be played."""

import dataclasses
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from halgan_rl.experiment.config import HindsightConfig
from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run_folder import read_metrics
from recipes import ddpg_pick_place, ddqn_pebble, play
from tests.recipes import without_pictures

TINY = {
    "total_frames": 96,
    "warmup_frames": 64,
    "max_distance": 32,
    "batch_size": 8,
    "replay_capacity": 200,
    "frames_per_update": 4,
    "evaluate_every": 48,
    "evaluation_starts": 1,
    "film_starts": 1,
    "bank": False,
    "background_evaluation": False,
}
RECIPES: dict[str, tuple[HindsightConfig, Callable[[Any], None]]] = {
    "pick & place": (ddpg_pick_place.Config(), ddpg_pick_place.main),
    "pebble": (ddqn_pebble.Config(), ddqn_pebble.main),
}
Run = Callable[..., Path]


@pytest.fixture(scope="module", params=RECIPES)
def run(request: pytest.FixtureRequest) -> Run:
    """Runs one of the recipes into a folder."""
    config, main = RECIPES[request.param]

    def run(out: Path, *, pictures: bool = False, **changes: Any) -> Path:
        with nullcontext() if pictures else without_pictures():
            main(dataclasses.replace(config, **(TINY | changes), out=out))
        return out

    return run


@pytest.fixture(scope="module")
def halgan_run(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(tmp_path_factory.mktemp("runs") / "halgan", pictures=True)


def policy(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "policy.safetensors")


def test_every_parameter_of_the_policy_is_updated(run: Run, halgan_run: Path, tmp_path: Path) -> None:
    untrained, trained = policy(run(tmp_path / "untrained", total_frames=48)), policy(halgan_run)
    assert not [name for name in trained if torch.equal(trained[name], untrained[name])]


def test_a_run_repeats_itself_bit_for_bit_and_another_method_does_not(
    run: Run, halgan_run: Path, tmp_path: Path
) -> None:
    first, again = policy(halgan_run), policy(run(tmp_path / "again"))
    assert all(torch.equal(first[name], again[name]) for name in first)
    none = policy(run(tmp_path / "none", hindsight="none"))
    assert not any(torch.equal(first[name], none[name]) for name in first)


def test_pictures_are_drawn_and_the_saved_policy_plays(halgan_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert {path.name for path in halgan_run.iterdir()} >= {"agent.gif", "curve.png", "hallucinations.png"}
    play.main(play.Config(run=halgan_run, starts=1))
    assert "success rate" in capsys.readouterr().out


def test_the_share_of_pick_ups_is_reported(tmp_path: Path) -> None:
    config = dataclasses.replace(ddpg_pick_place.Config(), **TINY, hindsight="none", out=tmp_path / "run")
    with without_pictures():
        ddpg_pick_place.main(config)
    assert read_metrics(tmp_path / "run" / "metrics.csv")["eval/held"] == [0, 0]


def test_an_environment_with_other_actions_is_refused(tmp_path: Path) -> None:
    config = ddqn_pebble.Config(environment="navigate-2m", hindsight="none", out=tmp_path / "run")
    with pytest.raises(ValueError, match=r"navigate-2m has continuous actions.*ddpg"):
        ddqn_pebble.main(config)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("recipe", [ddpg_pick_place, ddqn_pebble])
def test_the_paper_is_one_flag_away(recipe: Any) -> None:
    assert parse_config(recipe.PRESETS, [], description=None) == recipe.Config()
    paper = parse_config(recipe.PRESETS, ["--preset", "paper"], description=None)
    assert (paper.discount, paper.max_distance, paper.bank, paper.policy_average) == (0.99, 16, False, 0.0)
    assert paper.target_rate == 1e-3
