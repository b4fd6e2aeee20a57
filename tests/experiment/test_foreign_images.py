"""A user's images, of other sizes and channels, from their data to a trained agent."""

from pathlib import Path

import pytest
import torch

from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import Run, make_agent, make_buffer
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.hallucinators import GeneratorHallucinator
from halgan_rl.hallucination.judging.fidelity import changed as changed_pixels
from halgan_rl.hallucination.training.matte_regression import MatteConfig, MatteRegression
from halgan_rl.hallucination.weights import save_weights
from tests.recipes import TINY
from tests.room import POSES, draw, failed, near_goal, room_domain

SHAPES = [((84, 84, 3), 1), ((64, 64, 1), 1), ((64, 64, 12), 4)]


@pytest.mark.parametrize(("image_shape", "frame_stack"), SHAPES, ids=["84x84x3", "64x64x1", "64x64x12"])
def test_images_of_any_shape_go_through_generator_buffer_pipeline_and_update(
    image_shape: tuple[int, int, int], frame_stack: int, tmp_path: Path
) -> None:
    domain = room_domain(image_shape, frame_stack)

    # Train a generator on the user's own near-goal and failed frames, and save it.
    torch.manual_seed(0)
    data = near_goal(domain)
    generator = CoordinateGenerator(image_shape=image_shape, frame_stack=frame_stack)
    generator.encoding.standardise(generator.encoding.labels(data["pose"], data["goal_pose"]))
    rng = torch.Generator().manual_seed(0)
    config = MatteConfig(steps=250, batch_size=32, pixels=256)
    data = {"near_goal": data, "failed": failed(domain)}
    regression = MatteRegression(generator, **data, rng=rng, config=config, poses=POSES)
    losses = [float(regression.step()["loss"]) for _ in range(config.steps)]
    assert losses[-1] < 0.5 * losses[0]
    save_weights(tmp_path / "generator.safetensors", generator, {"kind": "coordinates", **vars_of(generator)})
    assert overlap_of_last_frame(generator, image_shape, frame_stack) > 0.4

    # Train an agent with it.
    tiny = {**TINY, "painter.weights": tmp_path / "generator.safetensors", "painter.bank": False}
    run_config = changed(RunConfig(out=tmp_path / "run"), tiny)
    agent = make_agent(run_config, domain)
    before = [parameter.clone() for parameter in agent.network.parameters()]
    hindsight = make_hindsight(run_config, domain)
    buffer = make_buffer(run_config.training, hindsight, seed=0)
    with Run(run_config, domain, agent, buffer, hindsight) as run:
        run.train()
    run.draw()
    assert not any(map(torch.equal, before, agent.network.parameters()))
    batch = buffer.sample(64)
    assert batch["pixels"].shape == (64, *image_shape)
    assert batch["goal", "mask"].any()
    assert (tmp_path / "run" / "hallucinations.png").exists()


def vars_of(generator: CoordinateGenerator) -> dict:
    return {"arguments": generator.arguments}


def overlap_of_last_frame(generator: CoordinateGenerator, image_shape: tuple[int, int, int], frame_stack: int) -> float:
    """Return the mean overlap, in the newest frame, of what is painted and what would be seen, on held-out poses."""
    domain = room_domain(image_shape, frame_stack)
    data, channels = near_goal(domain, 6, seed=7), image_shape[2] // frame_stack
    empty = torch.stack([draw(pose, None, (*image_shape[:2], channels)) for pose in data["pose"]])
    hallucinate = GeneratorHallucinator(generator, rng=torch.Generator().manual_seed(0))
    pixels = empty.repeat(1, 1, 1, frame_stack)
    painted = hallucinate(*(each.unsqueeze(1) for each in (pixels, data["pose"], data["goal_pose"]))).squeeze(1)
    true, mask = (changed_pixels(empty, each[..., -channels:]) for each in (data["pixels"], painted))
    return float(((true & mask).sum((1, 2)) / (true | mask).sum((1, 2)).clamp_min(1)).mean())
