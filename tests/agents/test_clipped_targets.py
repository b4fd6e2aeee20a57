"""Targets stay inside the range of a return, and are discounted as often as a row has steps."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, OneHot, TensorSpec
from torchrl.objectives import DDPGLoss

from halgan_rl.agents import registry
from halgan_rl.agents.agent import AgentConfig
from halgan_rl.agents.clipped_targets import ClippedTD0Estimator
from halgan_rl.agents.ddpg import DDPGConfig
from halgan_rl.agents.ddqn import DDQNConfig
from halgan_rl.agents.fast_cpu import accelerate
from tests.agents.rows import make_rows


class Sum(nn.Module):
    """A critic whose value is known: the observation times a weight, plus the action."""

    def __init__(self, weight: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(weight))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.weight * observation + action


def make_loss() -> DDPGLoss:
    actor = TensorDictModule(nn.Linear(1, 1), in_keys=["observation"], out_keys=["action"])
    nn.init.zeros_(actor.module.weight)
    nn.init.zeros_(actor.module.bias)
    critic = TensorDictModule(Sum(1.0), in_keys=["observation", "action"], out_keys=["state_action_value"])
    return DDPGLoss(actor, critic, delay_actor=True, delay_value=True)


def make_batch() -> TensorDict:
    """Returns rows whose unclipped targets are 0.1 + 0.5 * (10, -10, 0.4, 10), the last one terminated."""
    next_observation = torch.tensor([[10.0], [-10.0], [0.4], [10.0]])
    terminated = torch.tensor([[False], [False], [False], [True]])
    following = {"observation": next_observation, "reward": torch.full((4, 1), 0.1)}
    following |= {"done": terminated, "terminated": terminated}
    return TensorDict({"observation": torch.zeros(4, 1), "action": torch.zeros(4, 1), "next": following}, [4])


def test_targets_are_clipped_and_inner_ones_kept() -> None:
    loss = make_loss()
    estimator = ClippedTD0Estimator(low=-1.0, high=1.0, gamma=0.5, value_network=loss.actor_critic)
    estimator.set_keys(value="state_action_value")
    loss.make_value_estimator(estimator)
    target = loss(make_batch())["target_value"]
    torch.testing.assert_close(target, torch.tensor([1.0, -1.0, 0.3, 0.1]))


def test_bounds_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(ValueError, match=r"low=1.0 must be below high=-1.0"):
        ClippedTD0Estimator(low=1.0, high=-1.0, gamma=0.5, value_network=make_loss().actor_critic)


CONTINUOUS, DISCRETE = Bounded(-1.0, 1.0, (2,)), OneHot(4, dtype=torch.int64)


@pytest.mark.parametrize("fast", [False, True], ids=["plain", "fast"])
@pytest.mark.parametrize("clip", [True, False], ids=["clipped", "not clipped"])
@pytest.mark.parametrize(
    ("config", "spec"), [(DDPGConfig(), CONTINUOUS), (DDQNConfig(), DISCRETE)], ids=["DDPG", "DDQN"]
)
def test_rows_of_several_steps_are_discounted_as_often(
    config: AgentConfig, spec: TensorSpec, clip: bool, fast: bool
) -> None:
    torch.manual_seed(0)
    config = type(config)(discount=0.5, clip_targets=clip)
    agent = registry.make_agent(config, action_spec=spec, image_shape=(64, 64, 3))
    if fast:
        accelerate(agent)
    with torch.no_grad():
        for name, value in agent.loss.state_dict().items():
            if ("head" in name and name.endswith("2_sep_bias")) or name.endswith("head.2.bias"):
                value.fill_(0.8)  # far from zero, that the discount shows
    rows = make_rows(spec)
    rows["next", "reward"] = torch.full((6, 1), 0.1)
    rows["next", "terminated"] = rows["next", "done"] = torch.zeros(6, 1, dtype=torch.bool)
    errors = {}
    for steps in (1, 2, 3):
        rows["steps_to_next_obs"] = torch.full((6, 1), steps)
        agent.loss(rows)
        errors[steps] = rows["td_error"].sqrt().flatten()  # |value - (0.1 + 0.5 ** steps * next value)|
    rows.pop("steps_to_next_obs")
    agent.loss(rows)
    torch.testing.assert_close(rows["td_error"].sqrt().flatten(), errors[1])
    assert (errors[3] - errors[1]).abs().min() > 0.05
    torch.testing.assert_close((errors[2] - errors[1]) * 1.5, errors[3] - errors[1], rtol=1e-3, atol=1e-4)
