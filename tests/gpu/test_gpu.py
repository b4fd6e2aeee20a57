"""What needs a GPU; `make gpu-check` runs it. Nothing here needs the simulator to render on the GPU."""

import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, OneHot, TensorSpec

from halgan_rl.agents.agent import Algorithm
from halgan_rl.agents.registry import AGENTS
from halgan_rl.experiment.config import RunConfig
from halgan_rl.experiment.methods import make_hindsight
from halgan_rl.experiment.presets import changed
from halgan_rl.experiment.run import Run, make_agent, make_buffer
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from tests.recipes import TINY
from tests.room import goal_renderer, room_domain

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU"),
]


SPECS: tuple[TensorSpec, ...] = (Bounded(-1.0, 1.0, (2,)), OneHot(4, dtype=torch.int64))


def action_spec_of(algorithm: Algorithm) -> TensorSpec:
    """Return actions that an algorithm accepts."""
    for spec in SPECS:
        try:
            algorithm.make_agent(algorithm.config(), action_spec=spec, image_shape=(64, 64, 3))
        except ValueError:
            continue
        return spec
    raise AssertionError("no actions fit")


def rows(spec: TensorSpec, count: int = 32) -> TensorDict:
    """Return what a buffer gives, root unlike next."""
    rng = torch.Generator().manual_seed(0)
    frames = torch.randint(256, (2, count, 64, 64, 3), generator=rng).to(torch.uint8)
    flags = {name: torch.zeros(count, 1, dtype=torch.bool) for name in ("done", "terminated")}
    after = {"pixels": frames[1], "reward": torch.rand(count, 1, generator=rng), **flags}
    return TensorDict({"pixels": frames[0], "action": spec.rand((count,)), "next": after}, batch_size=[count])


@pytest.mark.parametrize("algorithm", AGENTS.values(), ids=AGENTS)
def test_an_update_on_the_gpu_gives_finite_losses_there_and_hands_the_policy_back(algorithm: Algorithm) -> None:
    spec = action_spec_of(algorithm)
    agent = algorithm.make_agent(algorithm.config(), action_spec=spec, image_shape=(64, 64, 3), device="cuda")
    before = [parameter.clone() for parameter in agent.acting.parameters()]
    for _ in range(3):
        losses = agent.update(rows(spec))
    agent.act_on_latest()
    assert {value.device.type for value in losses.values()} == {"cuda"}
    assert all(math.isfinite(float(value.sum())) for value in losses.values())
    assert not any(map(torch.equal, before, agent.acting.parameters()))
    assert agent.explorer(rows(spec))["action"].device.type == "cpu"


@pytest.mark.parametrize("name", ["ddpg", "ddqn"])
def test_the_first_losses_on_the_gpu_are_those_on_the_cpu(name: str) -> None:
    algorithm, losses = AGENTS[name], []
    spec = action_spec_of(algorithm)
    batch = rows(spec)
    for device in ("cpu", "cuda"):
        torch.manual_seed(0)
        agent = algorithm.make_agent(algorithm.config(), action_spec=spec, image_shape=(64, 64, 3), device=device)
        losses.append(agent.update(batch.clone()).select(*agent.metrics).cpu())
    for metric, value in losses[0].items():
        torch.testing.assert_close(value, losses[1][metric], rtol=1e-3, atol=1e-4)


def test_a_loss_compiled_into_cuda_graphs_updates() -> None:
    algorithm = AGENTS["ddpg"]
    spec = action_spec_of(algorithm)
    agent = algorithm.make_agent(algorithm.config(), action_spec=spec, image_shape=(64, 64, 3), device="cuda")
    agent.loss.compile(mode="reduce-overhead")
    for _ in range(4):
        losses = agent.update(rows(spec))
    assert math.isfinite(float(losses["loss_value"]))


def test_a_generator_paints_the_same_on_the_gpu() -> None:
    torch.manual_seed(0)
    generator = CoordinateGenerator().eval()
    features, latent = torch.randn(8, generator.encoding.size), torch.randn(8, generator.latent_size)
    with torch.no_grad():
        on_cpu = generator(features, latent)
        on_gpu = generator.cuda()(features.cuda(), latent.cuda())
    torch.testing.assert_close(on_cpu, on_gpu.cpu(), rtol=1e-3, atol=1e-3)


def test_a_run_learns_on_the_gpu(tmp_path: Path) -> None:
    config = changed(RunConfig(method="oracle", device="cuda", out=tmp_path / "run"), TINY)
    domain = room_domain(goal_renderer=goal_renderer)
    agent = make_agent(config, domain)
    before = [parameter.clone() for parameter in agent.network.parameters()]
    hindsight = make_hindsight(config, domain)
    with Run(config, domain, agent, make_buffer(config.training, hindsight, seed=0), hindsight) as run:
        run.train()
    assert not any(map(torch.equal, before, agent.network.parameters()))
    assert next(agent.network.parameters()).is_cuda
