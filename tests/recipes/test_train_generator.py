"""The recipe trains both networks, repeats itself, and refuses bad input before any work is done."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from safetensors.torch import load_file

import halgan_envs
from halgan_rl.experiment.generator_run import DataConfig, GeneratorRunConfig
from halgan_rl.experiment.presets import changed, parse_config
from halgan_rl.experiment.run_folder import read_metrics
from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.training.adversarial import AdversarialConfig
from halgan_rl.hallucination.training.matte_regression import MatteConfig
from halgan_rl.hallucination.training.steps import GeneratorTrainingConfig
from halgan_rl.hallucination.weights import load_generator
from recipes.train_generator import PRESETS, main

TINY = GeneratorRunConfig(
    evaluate_every=2,
    data=DataConfig(near_goal_frames=40, failed_frames=40, held_out_frames=4),
    training=GeneratorTrainingConfig(mattes=MatteConfig(steps=2), adversarial=AdversarialConfig(steps=2, batch_size=4)),
)


def load(run: Path) -> HallucinationGenerator:
    domain = halgan_envs.domain("navigate-2m")
    return load_generator(run / "generator.safetensors", fingerprint=domain.fingerprint, poses=domain.poses)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "generator"
    main(dataclasses.replace(TINY, out=out))
    return out


def test_everything_promised_is_written(run: Path) -> None:
    assert {path.name for path in run.iterdir()} == {
        "config.json",
        "generator.json",
        "generator.safetensors",
        "hallucinations.png",
        "metrics.csv",
        "state.safetensors",
    }
    metrics = read_metrics(run / "metrics.csv")
    assert metrics["steps"] == [2, 4]
    assert not math.isnan(metrics["adversarial/critic_gap"][-1])
    manifest = json.loads((run / "generator.json").read_text())
    assert manifest["config"]["data"]["near_goal_frames"] == 40
    assert {"command", "golden_frame", "mujoco", "versions"} <= set(manifest)


def test_the_weights_paint(run: Path) -> None:
    hallucinate = GeneratorHallucinator(load(run), rng=torch.Generator().manual_seed(0))
    pixels = torch.zeros(1, 2, 64, 64, 3, dtype=torch.uint8)
    assert hallucinate(pixels, torch.zeros(1, 2, 3), torch.ones(1, 1, 3)).shape == pixels.shape


def test_a_run_repeats_itself_and_every_weight_is_trained(run: Path, tmp_path: Path) -> None:
    weights = {"first": load_file(run / "generator.safetensors")}
    changes: dict[str, dict[str, Any]] = {
        "again": {},
        "regression": {"training": changed(TINY.training, {"adversarial.steps": 0})},
        "seed": {"seed": 1},
    }
    for name, change in changes.items():
        main(dataclasses.replace(TINY, out=tmp_path / name, **change))
        weights[name] = load_file(tmp_path / name / "generator.safetensors")
    trained = [name for name in weights["first"] if not name.startswith("encoding")]
    assert all(torch.equal(weights["first"][name], weights["again"][name]) for name in weights["first"])
    for other in ("regression", "seed"):
        assert not any(torch.equal(weights["first"][name], weights[other][name]) for name in trained), other


def test_training_ends_when_its_minutes_are_over_and_keeps_what_it_has(tmp_path: Path) -> None:
    main(dataclasses.replace(TINY, out=tmp_path / "run", minutes=1e-6, evaluate_every=100))
    metrics = read_metrics(tmp_path / "run" / "metrics.csv")
    assert metrics["steps"] == [1]
    load(tmp_path / "run")


@pytest.mark.parametrize("composition", ["dimming", "difference"])
def test_the_papers_generator_composes_as_configured(
    tmp_path: Path, composition: Literal["dimming", "difference"]
) -> None:
    changes = {"out": tmp_path / "run", "training.mattes.steps": 0, "generator.kind": "paper"}
    main(changed(TINY, changes | {"generator.composition": composition}))
    grey = torch.full((1, 3, 64, 64), 0.5)
    composed = load(tmp_path / "run").compose(grey, torch.zeros_like(grey))
    assert torch.equal(composed, grey) == (composition == "difference")


def test_there_must_be_something_to_resume(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="nothing to go on from"):
        main(dataclasses.replace(TINY, out=tmp_path / "run", resume=True))
    assert not (tmp_path / "run").exists()


def test_a_folder_that_holds_a_run_is_refused_first(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("precious")
    with pytest.raises(FileExistsError, match="already holds a run"):
        main(dataclasses.replace(TINY, out=tmp_path))
    assert (tmp_path / "metrics.csv").read_text() == "precious"


@pytest.mark.parametrize("args", [["--no-such-flag", "1"], ["--generator.kind", "moon"], ["--preset", "nature"]])
def test_unknown_flags_and_names_are_refused(args: list[str]) -> None:
    with pytest.raises(SystemExit):
        parse_config(PRESETS, args, description=None)


def test_an_unknown_environment_is_refused_with_those_there_are_before_the_folder_is_made(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'moon'.*navigate-2m"):
        main(dataclasses.replace(TINY, environment="moon", out=tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"data.near_goal_frames": 0}, "near_goal_frames"),
        ({"data.steps_before_goal": -1}, "steps_before_goal"),
        ({"minutes": 0}, "minutes"),
        ({"evaluate_every": 0}, "evaluate_every"),
        ({"generator.kind": "paper", "training.mattes.steps": 1}, "--training.mattes.steps 0"),
        ({"training.mattes.steps": 0, "training.adversarial.steps": 0}, "nothing to train"),
    ],
)
def test_values_that_cannot_work_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        changed(TINY, changes)


def test_the_preset_chooses_the_defaults_and_flags_win() -> None:
    assert parse_config(PRESETS, [], description=None) == PRESETS["default"]
    config = parse_config(PRESETS, ["--preset", "paper", "--training.paper.critic-steps", "2"], description=None)
    assert config == changed(PRESETS["paper"], {"training.paper.critic_steps": 2})
