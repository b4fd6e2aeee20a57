"""What every agent of the registry does; a new one is tested by its line there."""

import copy
import json
import math
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torchrl.data import Bounded, OneHot, TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type

from halgan_rl.agents import registry
from halgan_rl.agents.agent import Agent, AgentConfig
from halgan_rl.agents.fast_cpu import accelerate
from halgan_rl.agents.registry import AGENTS, policy_of
from halgan_rl.keys import Keys
from halgan_rl.transforms.annealing import Annealing
from tests.agents.rows import frames, make_rows

SHAPES = [(84, 84, 3), (64, 64, 1), (64, 64, 12)]
SPECS: tuple[TensorSpec, ...] = (
    Bounded(torch.tensor([-1.0, 0.0, -3.0]), torch.tensor([1.0, 5.0, 3.0]), (3,)),
    OneHot(5, dtype=torch.int64),
)
"""One of these fits an agent."""


def spec_for(name: str) -> TensorSpec:
    """Returns the actions that an agent accepts."""
    for spec in SPECS:
        try:
            AGENTS[name].make_agent(AGENTS[name].config(), action_spec=spec, image_shape=(64, 64, 3))
        except ValueError:
            continue
        return spec
    raise AssertionError(f"no actions fit {name}")


def make(name: str, image_shape: tuple[int, int, int] = (64, 64, 3), keys: Keys = Keys()) -> tuple[Agent, TensorSpec]:
    """Returns an agent with its default values, and its actions."""
    torch.manual_seed(0)
    spec, config = spec_for(name), AGENTS[name].config()
    return registry.make_agent(config, action_spec=spec, image_shape=image_shape, keys=keys), spec


def state_of(agent: Agent, *, targets: bool) -> dict[str, torch.Tensor]:
    """Returns copies of the parameters that are learned, or of the targets."""
    learned = {name for name, parameter in agent.loss.named_parameters() if parameter.requires_grad}
    names = {f"target_{name}" for name in learned} if targets else learned
    return {name: value.detach().clone() for name, value in agent.loss.state_dict().items() if name in names}


every_agent = pytest.mark.parametrize("name", AGENTS)
plain_and_fast = pytest.mark.parametrize("fast", [False, True], ids=["plain", "fast"])


@plain_and_fast
@pytest.mark.parametrize("image_shape", SHAPES)
@every_agent
def test_an_update_changes_all_parameters_and_moves_all_targets(
    name: str, image_shape: tuple[int, int, int], fast: bool
) -> None:
    agent, spec = make(name, image_shape)
    if fast:
        accelerate(agent)
    learned, targets = state_of(agent, targets=False), state_of(agent, targets=True)
    losses = agent.update(make_rows(spec, image_shape))
    assert all(torch.isfinite(value).all() for value in losses.values())
    assert not any(torch.equal(value, learned[key]) for key, value in state_of(agent, targets=False).items())
    assert learned
    assert targets
    assert not any(torch.equal(value, targets[key]) for key, value in state_of(agent, targets=True).items())


@pytest.mark.parametrize("image_shape", SHAPES)
@every_agent
def test_actions_are_the_environments(name: str, image_shape: tuple[int, int, int]) -> None:
    agent, spec = make(name, image_shape)
    for policy in (agent.explorer, agent.make_policy(agent.network)):
        actions = policy(TensorDict({"pixels": frames(40, image_shape=image_shape)}, [40]))["action"]
        assert spec.is_in(actions.to(spec.dtype))


@every_agent
def test_the_policy_that_is_judged_does_not_draw(name: str) -> None:
    agent, _ = make(name)
    policy, rows = agent.make_policy(agent.network), TensorDict({"pixels": frames(4)}, [4])
    with set_exploration_type(ExplorationType.RANDOM):
        assert torch.equal(policy(rows.clone())["action"], policy(rows.clone())["action"])


@pytest.mark.parametrize("image_shape", SHAPES)
@every_agent
def test_a_saved_policy_is_rebuilt_by_its_kind(name: str, image_shape: tuple[int, int, int], tmp_path: Path) -> None:
    agent, spec = make(name, image_shape)
    agent.update(make_rows(spec, image_shape))
    save_file(agent.network.state_dict(), tmp_path / "policy.safetensors")
    manifest = json.loads(json.dumps({"kind": agent.network.kind, "arguments": agent.network.arguments}))
    algorithm = policy_of(manifest["kind"])
    network = algorithm.network(**manifest["arguments"])
    network.load_state_dict(load_file(tmp_path / "policy.safetensors"))
    rows = TensorDict({"pixels": frames(4, image_shape=image_shape)}, [4])
    assert algorithm is AGENTS[name]
    rebuilt = algorithm.make_policy(network, keys=Keys())(rows.clone())["action"]
    assert torch.equal(rebuilt, agent.make_policy(agent.network)(rows)["action"])


@plain_and_fast
@every_agent
def test_rows_may_have_other_keys(name: str, fast: bool) -> None:
    keys = Keys(pixels=("camera", "rgb"), action="control", reward="gain", done="over", terminated="won")
    agent, spec = make(name, keys=keys)
    same, _ = make(name)
    for one in (agent, same):
        if fast:
            accelerate(one)
    torch.manual_seed(1)
    rows = make_rows(spec, keys=keys)
    usual = {Keys().__dict__[field]: getattr(keys, field) for field in ("pixels", "action")}
    renamed = TensorDict({key: rows[other] for key, other in usual.items()}, [6])
    for field in ("pixels", "reward", "done", "terminated"):
        renamed[Keys().next(field)] = rows[keys.next(field)]
    torch.manual_seed(2)
    losses = agent.update(rows)
    torch.manual_seed(2)
    for key, value in same.update(renamed).items():
        assert torch.equal(losses[key], value), key
    assert agent.make_policy(agent.network)(rows.select(keys.pixels))["control"].shape == (6, *spec.shape)


@every_agent
def test_images_of_another_shape_are_refused_before_an_update(name: str) -> None:
    agent, spec = make(name)
    for shape in ((64, 64, 12), (3, 64, 64), (4, 64, 64, 3)):
        rows = make_rows(spec, shape)
        with pytest.raises(ValueError, match=r"pixels of a row is \[.*the agent was made for \[64, 64, 3\]"):
            agent.update(rows)


@every_agent
def test_frames_anneal_what_the_agent_anneals(name: str) -> None:
    spec = spec_for(name)
    config = replace(AGENTS[name].config(), epsilon=Annealing(0.8, 0.2, 10))
    agent = registry.make_agent(config, action_spec=spec, image_shape=(64, 64, 3))
    before = agent.epsilon
    agent.step(5)
    assert math.isnan(before) or (before, agent.epsilon) == (pytest.approx(0.8), pytest.approx(0.5))


@every_agent
def test_every_metric_is_among_the_losses_outputs(name: str) -> None:
    agent, spec = make(name)
    assert set(agent.metrics) <= set(agent.update(make_rows(spec)).keys())


@every_agent
def test_an_explorer_reaches_another_process(name: str) -> None:
    agent, _ = make(name)
    accelerate(agent)
    rows = TensorDict({"pixels": frames(4)}, [4])
    expected = agent.make_policy(agent.network)(rows.clone())["action"]
    for copied in (
        pickle.loads(pickle.dumps(agent.make_policy(agent.network))),
        copy.deepcopy(agent).make_policy(agent.network),
    ):
        assert torch.equal(copied(rows.clone())["action"], expected)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(pickle.loads(pickle.dumps(agent.explorer))(rows)["action"], expected)


def test_a_configuration_without_algorithm_is_refused() -> None:
    with pytest.raises(ValueError, match=r"AgentConfig belongs to no algorithm: choose one of .*DDPGConfig"):
        registry.make_agent(AgentConfig(), action_spec=SPECS[0], image_shape=(64, 64, 3))


def test_a_policy_of_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match=r"kind 'coordinates' is unknown: choose one of actor, "):
        policy_of("coordinates")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"discount": 1.1}, r"discount must lie in \[0, 1\], got 1.1"),
        ({"tau": 0.0}, r"tau must lie in \(0, 1\], got 0.0"),
        ({"epsilon": Annealing(0.1, 0.5, 10)}, r"must not grow, got 0.1 to 0.5"),
        ({"epsilon": Annealing(1.5, 0.5, 10)}, r"is a fraction .* got 1.5"),
    ],
)
@every_agent
def test_values_out_of_range_are_refused(name: str, values: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AGENTS[name].config(**values)
