"""A generator's training on a user's own frames, without a simulator: compared, drawn, stopped and resumed."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from halgan_rl.experiment import generator_run
from halgan_rl.experiment.domain import Domain
from halgan_rl.experiment.generator_run import COLUMNS, GeneratorRunConfig
from halgan_rl.experiment.run_folder import read_metrics
from halgan_rl.hallucination.training.adversarial import AdversarialConfig
from halgan_rl.hallucination.training.matte_regression import MatteConfig
from halgan_rl.hallucination.training.paper import PaperTrainingConfig
from halgan_rl.hallucination.training.steps import GeneratorTrainingConfig
from halgan_rl.hallucination.weights import load_generator
from tests import synthetic

NOT_ADVERSARIAL = AdversarialConfig(steps=0)
SHAPE = (64, 64, 3)
DATA = {"near_goal": synthetic.near_goal(16, image_shape=SHAPE), "failed": synthetic.failed(16, image_shape=SHAPE)}
DOMAIN = Domain("mine", make=None, action_spec=None, image_shape=SHAPE)  # type: ignore[arg-type]
STAGES = GeneratorTrainingConfig(
    MatteConfig(steps=2, batch_size=4),
    AdversarialConfig(steps=2, batch_size=4),
    PaperTrainingConfig(steps=2, batch_size=4, critic_steps=1),
)


def test_frames_of_any_shape_without_a_simulator_make_a_generator(tmp_path: Path) -> None:
    """A user's domain: no truth to compare with, no fingerprint, grey frames of 48 x 32 pixels."""
    shape = (48, 32, 1)
    domain = Domain("mine", make=None, action_spec=None, image_shape=shape)  # type: ignore[arg-type]
    training = GeneratorTrainingConfig(MatteConfig(steps=2, batch_size=4), NOT_ADVERSARIAL)
    config = GeneratorRunConfig(environment="mine", out=tmp_path / "run", training=training)
    data = {"near_goal": synthetic.near_goal(16, image_shape=shape), "failed": synthetic.failed(16, image_shape=shape)}
    assert math.isnan(generator_run.run(config, domain, **data)["truth/mask_overlap"])
    path = tmp_path / "run" / "generator.safetensors"
    assert load_generator(path, fingerprint={}, poses=domain.poses, image_shape=shape).image_shape == shape


def test_stacked_grey_frames_are_compared_with_the_truth_and_drawn(tmp_path: Path) -> None:
    shape: dict[str, Any] = {"image_shape": (48, 32, 2), "frame_stack": 2}
    domain = Domain("mine", make=None, action_spec=None, **shape)  # type: ignore[arg-type]
    training = GeneratorTrainingConfig(MatteConfig(steps=1, batch_size=4), NOT_ADVERSARIAL)
    config = GeneratorRunConfig(environment="mine", out=tmp_path / "run", training=training)
    near_goal = synthetic.near_goal(16, **shape)
    held_out = near_goal | {"pixels": near_goal["empty"], "truth": near_goal["pixels"]}
    data = {"near_goal": near_goal, "failed": synthetic.failed(16, **shape)}
    assert generator_run.run(config, domain, **data, held_out=held_out)["truth/mask_overlap"] >= 0
    assert (tmp_path / "run" / "hallucinations.png").exists()
    with pytest.raises(ValueError, match=r"held_out\['truth'\] is torch.float32"):
        generator_run.run(config, domain, **data, held_out=held_out | {"truth": held_out["truth"] / 255})


def test_a_resumed_run_ends_as_if_it_had_never_stopped(tmp_path: Path) -> None:
    """It stops after every step, within each stage and between them."""
    whole = GeneratorRunConfig(environment="mine", out=tmp_path / "whole", training=STAGES, evaluate_every=1)
    parts = dataclasses.replace(whole, out=tmp_path / "parts")
    generator_run.run(whole, DOMAIN, **DATA)
    generator_run.run(dataclasses.replace(parts, minutes=1e-6), DOMAIN, **DATA)
    assert read_metrics(parts.out / "metrics.csv")["steps"] == [1]
    for steps in range(2, 7):
        with (parts.out / "metrics.csv").open("a") as file:  # a row of a step that is not in the state
            file.write(",".join([str(steps)] * len(COLUMNS)) + "\n")
        metrics = generator_run.run(dataclasses.replace(parts, minutes=1e-6, resume=True), DOMAIN, **DATA)
        assert read_metrics(parts.out / "metrics.csv")["steps"] == list(range(1, steps + 1))
    weights = [load_file(config.out / "generator.safetensors") for config in (whole, parts)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])

    # Nothing is left to do.
    before = (parts.out / "metrics.csv").read_text()
    again = generator_run.run(dataclasses.replace(parts, resume=True), DOMAIN, **DATA)
    assert again["paper/change"] == metrics["paper/change"]
    assert (parts.out / "metrics.csv").read_text() == before


def test_a_run_is_not_resumed_with_another_configuration(tmp_path: Path) -> None:
    config = GeneratorRunConfig(environment="mine", out=tmp_path / "run", training=STAGES, minutes=1e-6)
    generator_run.run(config, DOMAIN, **DATA)
    with pytest.raises(ValueError, match="cannot be resumed with other values of seed, evaluate_every"):
        generator_run.run(dataclasses.replace(config, resume=True, evaluate_every=7, seed=1), DOMAIN, **DATA)
