"""The recipe trains both networks, repeats itself, and refuses bad input before any work is done."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import halgan_envs
import pytest
import torch
from safetensors.torch import load_file

from halgan_rl.experiment.presets import parse_config
from halgan_rl.experiment.run_folder import read_metrics
from halgan_rl.hallucination.hallucinators import GanHallucinator
from halgan_rl.hallucination.training.adversarial import GanSettings
from halgan_rl.hallucination.weights import load_generator
from recipes.train_halgan import PRESETS, Config, main

TINY = dataclasses.replace(
    Config(),
    iterations=2,
    warm_start_steps=2,
    near_goal_frames=40,
    failed_frames=40,
    held_out_frames=4,
    evaluate_every=2,
    game=GanSettings(batch_size=4, critic_steps=1, mirror=True, bandwidth=0.1),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "halgan"
    main(dataclasses.replace(TINY, out=out))
    return out


def test_everything_promised_is_written(run: Path) -> None:
    assert {path.name for path in run.iterdir()} == {
        "config.json",
        "generator.json",
        "generator.safetensors",
        "hallucinations.png",
        "metrics.csv",
    }
    metrics = read_metrics(run / "metrics.csv")
    assert metrics["steps"] == [2, 4]
    assert not math.isnan(metrics["game/critic_distance"][-1])
    manifest = json.loads((run / "generator.json").read_text())
    assert manifest["config"]["near_goal_frames"] == 40
    assert {"command", "golden_frame", "mujoco", "versions"} <= set(manifest)


def test_the_weights_paint(run: Path) -> None:
    generator = load_generator(run / "generator.safetensors", expected=halgan_envs.fingerprint("navigate-2m"))
    hallucinate = GanHallucinator(generator, rng=torch.Generator().manual_seed(0))
    pixels = torch.zeros(1, 2, 64, 64, 3, dtype=torch.uint8)
    assert hallucinate(pixels, torch.zeros(1, 2, 3), torch.ones(1, 1, 3)).shape == pixels.shape


def test_a_run_repeats_itself_and_every_weight_is_trained(run: Path, tmp_path: Path) -> None:
    weights = {"first": load_file(run / "generator.safetensors")}
    for name, changes in {"again": {}, "warm": {"iterations": 0}, "seed": {"seed": 1}}.items():
        main(dataclasses.replace(TINY, out=tmp_path / name, **changes))
        weights[name] = load_file(tmp_path / name / "generator.safetensors")
    trained = [name for name in weights["first"] if not name.startswith("encoding")]
    assert all(torch.equal(weights["first"][name], weights["again"][name]) for name in weights["first"])
    for other in ("warm", "seed"):
        assert not any(torch.equal(weights["first"][name], weights[other][name]) for name in trained), other


def test_training_ends_when_its_minutes_are_over_and_keeps_what_it_has(tmp_path: Path) -> None:
    main(dataclasses.replace(TINY, out=tmp_path / "run", minutes=1e-6, evaluate_every=100))
    metrics = read_metrics(tmp_path / "run" / "metrics.csv")
    assert metrics["steps"] == [1]
    load_generator(tmp_path / "run" / "generator.safetensors", expected=halgan_envs.fingerprint("navigate-2m"))


@pytest.mark.parametrize("composition", ["dimming", "difference"])
def test_the_papers_generator_composes_as_it_is_told(tmp_path: Path, composition: str) -> None:
    changes = {"generator": "paper", "warm_start_steps": 0, "iterations": 1, "composition": composition}
    main(dataclasses.replace(TINY, out=tmp_path / "run", **changes))  # type: ignore[arg-type]
    generator = load_generator(
        tmp_path / "run" / "generator.safetensors", expected=halgan_envs.fingerprint("navigate-2m")
    )
    grey = torch.full((1, 3, 64, 64), 0.5)
    assert torch.equal(generator.compose(grey, torch.zeros_like(grey)), grey) == (composition == "difference")


def test_a_folder_that_holds_a_run_is_refused_first(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("precious")
    with pytest.raises(FileExistsError, match="already holds a run"):
        main(dataclasses.replace(TINY, out=tmp_path))
    assert (tmp_path / "metrics.csv").read_text() == "precious"


@pytest.mark.parametrize("args", [["--no-such-flag", "1"], ["--generator", "moon"], ["--preset", "nature"]])
def test_unknown_flags_and_names_are_refused(args: list[str]) -> None:
    with pytest.raises(SystemExit):
        parse_config(PRESETS, args, description=None)


def test_an_unknown_environment_is_refused_with_those_there_are_before_the_folder_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'moon'.*navigate-2m"):
        main(dataclasses.replace(TINY, environment="moon", out=tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "changes",
    [{"near_goal_frames": 0}, {"iterations": -1}, {"minutes": 0}, {"generator": "paper"}, {"latent_noise": 2.0}],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        dataclasses.replace(Config(), **changes)


def test_the_preset_chooses_the_defaults_and_flags_win() -> None:
    assert parse_config(PRESETS, [], description=None) == PRESETS["default"]
    config = parse_config(PRESETS, ["--preset", "paper", "--game.critic-steps", "2"], description=None)
    paper = PRESETS["paper"]
    assert config == dataclasses.replace(paper, game=dataclasses.replace(paper.game, critic_steps=2))
