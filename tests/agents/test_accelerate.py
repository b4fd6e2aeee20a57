"""One call makes an agent fast in place: what it learns, its optimizer and its state stay what they are."""

import copy
import logging
import multiprocessing
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.optim.swa_utils import AveragedModel
from torchrl.data import Bounded, OneHot, TensorSpec

from halgan_rl.agents import registry
from halgan_rl.agents.agent import Agent, AgentConfig
from halgan_rl.agents.ddpg import DDPGConfig
from halgan_rl.agents.ddqn import DDQNConfig
from halgan_rl.agents.encoder import Encoder
from halgan_rl.agents.fast_cpu import accelerate
from halgan_rl.agents.fast_cpu.block_encoder import BlockEncoder
from tests.agents.rows import frames, make_rows

CASES = {
    "DDPG": (DDPGConfig(), Bounded(-1.0, 1.0, (2,))),
    "DDPG, pooled": (DDPGConfig(downsample="max_pool"), Bounded(-2.0, 3.0, (2,))),
    "DDQN": (DDQNConfig(), OneHot(4, dtype=torch.int64)),
}
every_case = pytest.mark.parametrize(("config", "spec"), CASES.values(), ids=CASES)
ALL = ("loss", "encoder", "target update")


def make(config: AgentConfig, spec: TensorSpec, image_shape: tuple[int, int, int] = (64, 64, 3)) -> Agent:
    torch.manual_seed(0)
    return registry.make_agent(config, action_spec=spec, image_shape=image_shape)


def learn(agent: Agent, spec: TensorSpec, updates: int = 3) -> list[dict[str, torch.Tensor]]:
    torch.manual_seed(1)
    batches = [make_rows(spec, agent.image_shape, seed=seed) for seed in range(updates)]
    return [{name: agent.update(batch)[name].detach() for name in agent.metrics} for batch in batches]


@every_case
def test_a_fast_agent_learns_what_a_plain_one_does(config: AgentConfig, spec: TensorSpec) -> None:
    plain, fast = make(config, spec), make(config, spec)
    assert accelerate(fast) == ALL
    for one, other in zip(learn(plain, spec), learn(fast, spec), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)
    for name, value in plain.loss.state_dict().items():
        torch.testing.assert_close(fast.loss.state_dict()[name], value, rtol=1e-2, atol=3e-3, msg=name)


@every_case
def test_parameters_and_optimizer_stay_the_same_objects(config: AgentConfig, spec: TensorSpec) -> None:
    agent = make(config, spec)
    learn(agent, spec, 1)
    optimizer, state = agent.optimizer, dict(agent.optimizer.state)
    before = {name: value.data_ptr() for name, value in agent.loss.state_dict().items()}
    network = dict(agent.network.named_parameters())
    accelerate(agent)
    assert agent.optimizer is optimizer
    assert dict(agent.optimizer.state) == state
    assert {name: value.data_ptr() for name, value in agent.loss.state_dict().items()} == before
    assert all(parameter is network[name] for name, parameter in agent.network.named_parameters())


@every_case
def test_accelerating_draws_nothing_and_may_be_repeated(config: AgentConfig, spec: TensorSpec) -> None:
    agent = make(config, spec)
    state = torch.get_rng_state()
    assert accelerate(agent) == ALL == accelerate(agent)
    assert torch.equal(torch.get_rng_state(), state)


def encoders(module: nn.Module) -> set[type]:
    return {type(part) for part in module.modules() if isinstance(part, Encoder)}


@every_case
def test_policies_that_are_copied_later_are_fast(config: AgentConfig, spec: TensorSpec) -> None:
    agent = make(config, spec)
    assert encoders(agent.explorer) == {Encoder}
    accelerate(agent)
    average = AveragedModel(agent.network)
    for policy in (agent.explorer, agent.make_policy(average.module), copy.deepcopy(agent.make_policy(agent.network))):
        assert encoders(policy) == {BlockEncoder}


@pytest.mark.parametrize("image_shape", [(84, 84, 3), (64, 72, 1)])
@every_case
def test_an_agent_whose_images_do_not_fit_stays_plain(
    config: AgentConfig, spec: TensorSpec, image_shape: tuple[int, int, int], caplog: pytest.LogCaptureFixture
) -> None:
    agent = make(config, spec, image_shape)
    loss = type(agent.loss)
    with caplog.at_level(logging.INFO):
        assert accelerate(agent) == ("target update",)
    assert "fast on a CPU: target update; plain: loss, encoder" in caplog.text
    assert encoders(agent.explorer) == {Encoder}
    assert type(agent.loss) is loss


def test_an_agent_with_another_activation_keeps_it() -> None:
    agent = make(*CASES["DDPG"])
    agent.network.encoder.layers[1] = nn.Tanh()
    rows = TensorDict({"pixels": frames(2)}, [2])
    before = agent.make_policy(agent.network)(rows.clone())["action"]
    assert accelerate(agent) == ("target update",)
    assert torch.equal(agent.make_policy(agent.network)(rows)["action"], before)


def _act(policy: Any, rows: TensorDict) -> tuple[bool, list[list[float]]]:
    return encoders(policy) == {BlockEncoder}, policy(rows)["action"].tolist()


def test_a_fast_policy_reaches_a_spawned_process() -> None:
    agent = make(*CASES["DDPG"])
    accelerate(agent)
    policy, rows = agent.make_policy(agent.network).requires_grad_(False), TensorDict({"pixels": frames(2)}, [2])
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        fast, actions = pool.apply(_act, (policy, rows))
    assert fast
    torch.testing.assert_close(torch.tensor(actions), policy(rows)["action"])
