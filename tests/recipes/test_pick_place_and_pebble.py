"""The siblings of the first recipe train all parameters, repeat themselves, and can be played."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

import tests.recipes
from halgan_rl.experiment.presets import changed, parse_config
from halgan_rl.experiment.run_folder import read_metrics
from recipes import ddpg_pick_place, ddqn_pebble, play
from tests.recipes import without_pictures

TINY = tests.recipes.TINY | {"total_frames": 96, "training.frames_per_update": 4, "evaluation.every": 48}
RECIPES = {"pick & place": ddpg_pick_place, "pebble": ddqn_pebble}
Run = Callable[..., Path]


@pytest.fixture(scope="module", params=RECIPES)
def run(request: pytest.FixtureRequest) -> Run:
    """Runs one of the recipes into a folder."""
    recipe = RECIPES[request.param]

    def run(out: Path, *, pictures: bool = False, **changes: Any) -> Path:
        with nullcontext() if pictures else without_pictures():
            recipe.main(changed(recipe.DEFAULT, TINY | changes | {"out": out}))
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
    none = policy(run(tmp_path / "none", method="none"))
    assert not any(torch.equal(first[name], none[name]) for name in first)


def test_pictures_are_drawn_and_the_saved_policy_plays(halgan_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert {path.name for path in halgan_run.iterdir()} >= {"agent.gif", "curve.png", "hallucinations.png"}
    play.main(play.Config(run=halgan_run, starts=1))
    assert "success rate" in capsys.readouterr().out


def test_the_fraction_of_pick_ups_is_reported(tmp_path: Path) -> None:
    config = changed(ddpg_pick_place.DEFAULT, TINY | {"method": "none", "out": tmp_path / "run"})
    with without_pictures():
        ddpg_pick_place.main(config)
    assert read_metrics(tmp_path / "run" / "metrics.csv")["eval/held"] == [0, 0]


def test_an_environment_with_other_actions_is_refused(tmp_path: Path) -> None:
    changes = {"environment": "navigate-2m", "method": "none", "out": tmp_path / "run"}
    with pytest.raises(ValueError, match=r"continuous.*[Dd][Dd][Pp][Gg]"):
        ddqn_pebble.main(changed(ddqn_pebble.DEFAULT, changes))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("recipe", [ddpg_pick_place, ddqn_pebble])
def test_the_paper_is_one_flag_away(recipe: Any) -> None:
    assert parse_config(recipe.PRESETS, [], description=None) == recipe.DEFAULT
    paper = parse_config(recipe.PRESETS, ["--preset", "paper"], description=None)
    assert (paper.agent.discount, paper.agent.tau, paper.hindsight.max_distance) == (0.99, 1e-3, 16)
    assert (paper.painter.bank, paper.training.policy_average) == (False, 0.0)
