"""Agents learn on a device of their own, act on the CPU. Without a GPU the "meta" device stands for one: it has shapes
only, and refuses to be mixed with the CPU."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import TensorSpec

from halgan_rl.agents import agent as agents
from halgan_rl.agents import registry
from halgan_rl.agents.agent import Agent
from halgan_rl.agents.encoder import Encoder
from halgan_rl.agents.fast_cpu import accelerate
from halgan_rl.agents.fast_cpu.block_encoder import BlockEncoder
from halgan_rl.agents.registry import AGENTS
from tests.agents.rows import make_rows
from tests.agents.test_every_agent import spec_for

every_agent = pytest.mark.parametrize("name", AGENTS)
plain_and_fast = pytest.mark.parametrize("fast", [False, True], ids=["plain", "fast"])


def module_of(name: str) -> Any:
    """Returns the module in which an algorithm stands."""
    return __import__(AGENTS[name].make_agent.__module__, fromlist=["make_agent"])


def make(name: str, *, device: str = "cpu") -> tuple[Agent, TensorSpec]:
    torch.manual_seed(0)
    spec = spec_for(name)
    return registry.make_agent(AGENTS[name].config(), action_spec=spec, image_shape=(64, 64, 3), device=device), spec


def on_meta(name: str, monkeypatch: pytest.MonkeyPatch, *, fast: bool) -> tuple[Agent, TensorSpec]:
    """Returns an agent that learns on the "meta" device and acts on the CPU."""
    acting = make(name)[0].acting
    monkeypatch.setattr(module_of(name), "on_cpu", lambda network: acting)  # of a meta tensor there is nothing to copy
    monkeypatch.setattr(torch.Tensor, "is_set_to", lambda one, other: one is other)  # which meta tensors lack
    agent, spec = make(name, device="meta")
    if fast:
        accelerate(agent)
    parameters = [parameter for parameter in agent.loss.parameters() if parameter.requires_grad]
    agent.optimizer = torch.optim.SGD(parameters, lr=0.1)  # a fused Adam knows no meta tensors
    return agent, spec


@contextmanager
def skip_if_values_are_read() -> Iterator[None]:
    """Skips a test if the loss reads the value of a tensor, as TorchRL's TanhNormal does: meta tensors have none."""
    try:
        yield
    except RuntimeError as error:
        if "cannot be called on meta tensors" not in str(error):
            raise
        pytest.skip(f"the loss needs values: {error}")


@plain_and_fast
@every_agent
def test_an_update_is_made_on_the_learners_device(name: str, fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    agent, spec = on_meta(name, monkeypatch, fast=fast)
    rows = make_rows(spec).set("pose", torch.zeros(6, 3))
    with skip_if_values_are_read():
        losses = agent.update(rows)
    assert {value.device.type for value in losses.values()} == {"meta"}
    assert rows["pixels"].device.type == "cpu"
    assert agent.explorer(rows)["action"].device.type == "cpu"
    with pytest.raises(RuntimeError, match="meta"):
        agent.loss(make_rows(spec))


@every_agent
def test_only_what_acts_on_the_cpu_becomes_fast_beside_a_learner_elsewhere(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, _ = on_meta(name, monkeypatch, fast=False)
    loss = type(agent.loss)
    assert accelerate(agent) == ("encoder", "target update")
    assert type(agent.loss) is loss
    assert all(type(part) is BlockEncoder for part in agent.explorer.modules() if isinstance(part, Encoder))


@every_agent
def test_what_a_loss_reads_beside_its_keys_reaches_the_learners_device(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module_of(name), "on_cpu", copy.deepcopy)
    agent, spec = make(name)
    same, _ = make(name)
    monkeypatch.setattr(same, "acting", same.network)
    rows = make_rows(spec)
    rows["steps_to_next_obs"] = torch.full((6, 1), 3)
    rows["priority_weight"] = torch.rand(6)
    losses = []
    for one, batch in ((agent, rows), (same, rows.clone())):
        torch.manual_seed(1)
        losses.append(one.update(batch))
        assert batch[one.loss.tensor_keys.priority].shape[0] == 6
    for key, value in losses[0].items():
        assert torch.equal(losses[1][key], value), key


@every_agent
def test_the_acting_copy_is_brought_up_to_date(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module_of(name), "on_cpu", copy.deepcopy)
    agent, spec = make(name)
    agent.update(make_rows(spec))
    learned, acting = (dict(network.named_parameters()) for network in (agent.network, agent.acting))
    assert not any(torch.equal(learned[key], acting[key]) for key in learned)
    agent.act_on_latest()
    assert all(torch.equal(learned[key], acting[key]) for key in learned)


@every_agent
def test_on_the_cpu_the_network_itself_acts(name: str) -> None:
    agent, _ = make(name)
    assert agent.acting is agent.network
    assert agents.on_cpu(agent.network) is agent.network


@pytest.mark.slow
@plain_and_fast
@every_agent
def test_a_compiled_loss_learns_the_same_except_for_rounding(name: str, fast: bool) -> None:
    learned = []
    for compiled in (False, True):
        agent, spec = make(name)
        if fast:
            accelerate(agent)
        if compiled:
            torch._dynamo.reset()
            torch._dynamo.utils.counters.clear()
            agent.loss.compile(mode="default")
        rows = TensorDict({**make_rows(spec)}, batch_size=[6])
        learned.append([agent.update(rows.clone()).select(*agent.metrics).detach() for _ in range(3)])
    for plain, compiled_losses in zip(*learned, strict=True):
        torch.testing.assert_close(plain.to_dict(), compiled_losses.to_dict(), rtol=1e-4, atol=1e-5)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] > 0
