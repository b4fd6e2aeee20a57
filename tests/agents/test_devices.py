"""Agents learn on a device of their own, act on the CPU. Without a GPU the "meta" device stands for one: it has shapes
only, and refuses to be mixed with the CPU."""

import copy
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDict
from torchrl.data import Bounded, OneHot, TensorSpec

from halgan_rl.agents import ddpg, ddqn
from halgan_rl.experiment.config import HindsightConfig
from halgan_rl.experiment.run import check_device
from recipes import ddpg_navigate, ddqn_pebble
from tests.recipes import without_pictures
from tests.recipes.test_ddpg_navigate import TINY

ALGORITHMS: dict[str, tuple[Any, HindsightConfig, TensorSpec]] = {
    "DDPG": (ddpg, ddpg_navigate.Config(), Bounded(-1.0, 1.0, (2,))),
    "DDQN": (ddqn, ddqn_pebble.Config(), OneHot(4, dtype=torch.int64)),
}


def rows(actions: TensorSpec, count: int = 8) -> TensorDict:
    """Return what a buffer gives, and an entry that no loss reads."""
    flags = {name: torch.zeros(count, 1, dtype=torch.bool) for name in ("done", "terminated")}
    after = {"pixels": torch.zeros(count, 64, 64, 3, dtype=torch.uint8), "reward": torch.ones(count, 1), **flags}
    before = {"pixels": torch.zeros(count, 64, 64, 3, dtype=torch.uint8), "action": actions.rand((count,))}
    return TensorDict({**before, "pose": torch.zeros(count, 3), "next": after}, batch_size=[count])


@pytest.mark.parametrize(("module", "config", "actions"), ALGORITHMS.values(), ids=ALGORITHMS)
def test_an_update_is_made_on_the_learners_device(
    module: Any, config: HindsightConfig, actions: TensorSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    acting = module.make_agent(config, actions).acting
    monkeypatch.setattr(module, "on_cpu", lambda network: acting)  # of a meta tensor there is nothing to copy
    monkeypatch.setattr(torch.Tensor, "is_set_to", lambda one, other: one is other)  # which meta tensors lack
    agent = module.make_agent(dataclasses.replace(config, device="meta"), actions)
    parameters = [parameter for parameter in agent.loss.parameters() if parameter.requires_grad]
    agent.optimizer = torch.optim.SGD(parameters, lr=0.1)  # a fused Adam knows no meta tensors
    before = rows(actions)
    losses = agent.update(before)
    assert {value.device.type for value in losses.values()} == {"meta"}
    assert before["pixels"].device.type == "cpu"
    assert agent.explorer(before)["action"].device.type == "cpu"
    with pytest.raises(RuntimeError, match="meta"):
        agent.loss(rows(actions))


@pytest.mark.parametrize(("module", "config", "actions"), ALGORITHMS.values(), ids=ALGORITHMS)
def test_the_acting_copy_is_brought_up_to_date(
    module: Any, config: HindsightConfig, actions: TensorSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "on_cpu", copy.deepcopy)
    agent = module.make_agent(config, actions)
    agent.update(rows(actions))
    learned, acting = (dict(network.named_parameters()) for network in (agent.network, agent.acting))
    assert not any(torch.equal(learned[name], acting[name]) for name in learned)
    agent.act_on_latest()
    assert all(torch.equal(learned[name], acting[name]) for name in learned)


def test_acting_on_a_copy_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = dataclasses.replace(TINY, hindsight="none", epsilon_start=0.3)  # so that the copy matters
    policies = []
    for name in ("itself", "copy"):
        if name == "copy":
            monkeypatch.setattr(ddpg, "on_cpu", copy.deepcopy)
        with without_pictures():
            ddpg_navigate.main(dataclasses.replace(config, out=tmp_path / name))
        policies.append(load_file(tmp_path / name / "policy.safetensors"))
    assert all(torch.equal(value, policies[1][name]) for name, value in policies[0].items())


def test_on_the_cpu_the_network_itself_acts() -> None:
    for module, config, actions in ALGORITHMS.values():
        agent = module.make_agent(config, actions)
        assert agent.acting is agent.network


@pytest.mark.parametrize("device", ["moon", "cuda:99", "meta", "privateuseone"])
def test_a_device_that_is_not_there_is_refused(device: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"device='{device}' cannot be used here.*choose 'cpu'"):
        ddpg_navigate.main(ddpg_navigate.Config(device=device, out=tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    check_device("cpu")


@pytest.mark.slow
def test_a_compiled_loss_learns_the_same_but_for_rounding() -> None:
    module, config, actions = ALGORITHMS["DDPG"]
    learned = []
    for compiled in (False, True):
        torch.manual_seed(0)
        agent = module.make_agent(config, actions)
        if compiled:
            torch._dynamo.utils.counters.clear()
            agent.loss.compile(mode="default")
        learned.append([agent.update(rows(actions)).select("loss_actor", "loss_value").detach() for _ in range(3)])
    for plain, fast in zip(*learned, strict=True):
        torch.testing.assert_close(plain.to_dict(), fast.to_dict(), rtol=1e-4, atol=1e-5)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] > 0
