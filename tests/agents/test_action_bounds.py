"""Continuous actions keep the environment's bounds, whatever they are."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec, Unbounded

from halgan_rl.agents import ddpg
from halgan_rl.agents.action_bounds import ActionScale, bounds_of
from halgan_rl.agents.agent import Agent
from halgan_rl.transforms.annealing import Annealing
from tests.agents.rows import frames

BOUNDS = {
    "unit": ([-1.0, -1.0], [1.0, 1.0]),
    "fractions": ([0.0, 0.0], [1.0, 1.0]),
    "wide": ([-2.0, -2.0], [2.0, 2.0]),
    "each its own": ([-1.0, 0.0], [1.0, 5.0]),
}


def spec_of(name: str) -> Bounded:
    low, high = (torch.tensor(bound) for bound in BOUNDS[name])
    return Bounded(low, high, (2,))


def make_agent(spec: TensorSpec, **config: Any) -> Agent:
    return ddpg.make_agent(ddpg.DDPGConfig(**config), action_spec=spec, image_shape=(16, 16, 1))


@pytest.mark.parametrize("name", BOUNDS)
def test_a_policy_reaches_its_bounds_and_goes_no_further(name: str) -> None:
    torch.manual_seed(0)
    spec = spec_of(name)
    agent = make_agent(spec)
    nn.init.normal_(agent.network.head[-1].weight, std=200.0)
    rows = TensorDict({"pixels": frames(64, image_shape=(16, 16, 1))}, [64])
    actions = agent.make_policy(agent.network)(rows)["action"]
    assert spec.is_in(actions)
    for sign, bound in ((1.0, spec.space.high), (-1.0, spec.space.low)):
        nn.init.constant_(agent.network.head[-1].bias, 1e6 * sign)
        torch.testing.assert_close(agent.make_policy(agent.network)(rows)["action"], bound.expand(64, 2))


@pytest.mark.parametrize("name", BOUNDS)
def test_noise_is_a_fraction_of_half_the_range(name: str) -> None:
    torch.manual_seed(0)
    spec = spec_of(name)
    agent = make_agent(spec, noise=0.1, epsilon=Annealing(0.0, 0.0, 1))
    actions = agent.explorer(TensorDict({"pixels": frames(2_000, image_shape=(16, 16, 1))}, [2_000]))["action"]
    half = (spec.space.high - spec.space.low) / 2
    torch.testing.assert_close(actions.std(0) / half, torch.full((2,), 0.1), rtol=0.1, atol=0.0)
    torch.testing.assert_close(actions.mean(0), (spec.space.high + spec.space.low) / 2, rtol=0.0, atol=0.05)


@pytest.mark.parametrize("name", BOUNDS)
def test_random_actions_are_uniform_within_the_bounds(name: str) -> None:
    torch.manual_seed(0)
    spec = spec_of(name)
    agent = make_agent(spec, epsilon=Annealing(1.0, 1.0, 1))
    actions = agent.explorer(TensorDict({"pixels": frames(2_000, image_shape=(16, 16, 1))}, [2_000]))["action"]
    unit = (actions - spec.space.low) / (spec.space.high - spec.space.low)
    assert spec.is_in(actions)
    torch.testing.assert_close(
        unit.quantile(torch.tensor([0.25, 0.75]), 0)[:, 0], torch.tensor([0.25, 0.75]), rtol=0.0, atol=0.05
    )


def test_the_critic_sees_actions_scaled_to_unit_ones() -> None:
    torch.manual_seed(0)
    unit, scaled = (ddpg.Critic(low=low, high=high) for low, high in (BOUNDS["unit"], BOUNDS["each its own"]))
    scaled.load_state_dict(unit.state_dict())
    pixels, action = frames(3), torch.tensor([[-1.0, -1.0], [0.0, 0.0], [0.5, 1.0]])
    low, high = (torch.tensor(bound) for bound in BOUNDS["each its own"])
    torch.testing.assert_close(scaled(pixels, low + (action + 1) / 2 * (high - low)), unit(pixels, action))


def test_unit_bounds_change_no_bit() -> None:
    action, scale = torch.rand(100, 2) * 2 - 1, ActionScale(*BOUNDS["unit"])
    assert scale.from_unit(action) is action
    assert scale.to_unit(action) is action
    assert list(scale.buffers()) == []


@pytest.mark.parametrize("name", BOUNDS)
def test_scaling_there_and_back_is_the_identity(name: str) -> None:
    action, scale = torch.rand(100, 2) * 2 - 1, ActionScale(*BOUNDS[name])
    torch.testing.assert_close(scale.to_unit(scale.from_unit(action)), action)


@pytest.mark.parametrize(
    "spec",
    [OneHot(4), Categorical(4), Unbounded((2,)), Bounded(0, 3, (2,), dtype=torch.int64)],
    ids=["one-hot", "categorical", "unbounded", "integers"],
)
def test_actions_without_continuous_bounds_are_refused(spec: TensorSpec) -> None:
    with pytest.raises(ValueError, match=r"DDPG needs continuous actions with bounds, got .* with DDQN .*agents.ddqn"):
        make_agent(spec)


@pytest.mark.parametrize("high", [[1.0, float("inf")], [1.0, torch.finfo(torch.float32).max], [1.0, -1.0]])
def test_bounds_that_bound_nothing_are_refused(high: list[float]) -> None:
    with pytest.raises(ValueError, match=r"finite bounds .* for entry 1: bound the environment's action spec"):
        bounds_of(Bounded(torch.tensor([-1.0, -1.0]), torch.tensor(high), (2,)), "DDPG")


def test_the_spec_of_several_environments_is_refused() -> None:
    with pytest.raises(ValueError, match=r"needs actions \[A\], got \[3, 2\].*action_spec_unbatched"):
        bounds_of(Bounded(-1.0, 1.0, (3, 2)), "DDPG")


def test_actions_of_double_precision_are_learned_from() -> None:
    spec = Bounded(-1.0, 1.0, (2,), dtype=torch.float64)
    critic = ddpg.Critic()
    assert critic(frames(3), spec.rand((3,))).dtype == torch.float32
