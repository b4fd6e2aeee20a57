"""Every method in the registry makes a pipeline that replays, relabels if it should, and trains an agent."""

from pathlib import Path

import pytest
import torch

from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.methods import METHODS, make_hindsight
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import Run, make_agent, make_buffer
from halgan_rl.experiment.run_folder import read_metrics
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.weights import save_weights
from tests.recipes import TINY
from tests.room import goal_renderer, room_domain


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    generator = CoordinateGenerator(opacity=0.5)
    path = tmp_path_factory.mktemp("weights") / "generator.safetensors"
    save_weights(path, generator, {"kind": "coordinates", "arguments": generator.arguments})
    return path


def tiny(method: str, weights: Path, out: Path) -> RunConfig:
    return changed(RunConfig(method=method, out=out), {**TINY, "painter.weights": weights})


@pytest.mark.parametrize("method", METHODS)
def test_a_method_trains_an_agent_in_a_domain_that_is_not_ours(method: str, weights: Path, tmp_path: Path) -> None:
    config, domain = tiny(method, weights, tmp_path / "run"), room_domain(goal_renderer=goal_renderer)
    torch.manual_seed(0)
    agent = make_agent(config, domain)
    before = [parameter.clone() for parameter in agent.network.parameters()]
    hindsight = make_hindsight(config, domain)
    buffer = make_buffer(config.training, hindsight, seed=0)
    with Run(config, domain, agent, buffer, hindsight) as run:
        run.train()
    run.draw()
    assert not any(map(torch.equal, before, agent.network.parameters()))
    relabelled = read_metrics(tmp_path / "run" / "metrics.csv")["train/hallucinated_fraction"][-1]
    assert (relabelled > 0.05) == (method != "none")
    assert (tmp_path / "run" / "agent.gif").exists()
    assert (tmp_path / "run" / "hallucinations.png").exists() == (method in ("halgan", "oracle"))


def test_the_oracle_is_refused_without_a_goal_renderer(weights: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"method='oracle' needs a goal_renderer, which the domain 'room' lacks"):
        make_hindsight(tiny("oracle", weights, tmp_path), room_domain())


def test_making_a_method_does_not_change_what_is_drawn_next(weights: Path, tmp_path: Path) -> None:
    drawn = []
    for method in METHODS:
        torch.manual_seed(0)
        make_hindsight(tiny(method, weights, tmp_path), room_domain(goal_renderer=goal_renderer))
        drawn.append(float(torch.rand(())))
    assert len(set(drawn)) == 1
