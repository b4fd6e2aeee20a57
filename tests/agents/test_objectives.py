"""Targets stay inside the range of a return."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.objectives import DDPGLoss

from halgan_rl.agents.objectives import ClippedTD0Estimator, UnsaturatedDDPGLoss


class Sum(nn.Module):
    """A critic whose value is known: the observation times a weight, plus the action."""

    def __init__(self, weight: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor(weight))

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.weight * observation + action


def make_loss() -> DDPGLoss:
    actor = TensorDictModule(nn.Linear(1, 1), in_keys=["observation"], out_keys=["action"])
    nn.init.zeros_(actor.module.weight)
    nn.init.zeros_(actor.module.bias)
    critic = TensorDictModule(Sum(1.0), in_keys=["observation", "action"], out_keys=["state_action_value"])
    return DDPGLoss(actor, critic, delay_actor=True, delay_value=True)


def make_batch() -> TensorDict:
    """Rows whose unclipped targets are 0.1 + 0.5 * (10, -10, 0.4, 10), the last one terminated."""
    next_observation = torch.tensor([[10.0], [-10.0], [0.4], [10.0]])
    terminated = torch.tensor([[False], [False], [False], [True]])
    return TensorDict(
        {
            "observation": torch.zeros(4, 1),
            "action": torch.zeros(4, 1),
            "next": {
                "observation": next_observation,
                "reward": torch.full((4, 1), 0.1),
                "done": terminated,
                "terminated": terminated,
            },
        },
        batch_size=[4],
    )


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


def make_unsaturated(weight: float) -> UnsaturatedDDPGLoss:
    """An actor whose pre-activation is far out (3), before a critic that asks for more."""
    linear = nn.Linear(1, 1)
    nn.init.zeros_(linear.weight)
    nn.init.constant_(linear.bias, 3.0)
    actor = TensorDictSequential(
        TensorDictModule(linear, in_keys=["observation"], out_keys=["preactivation"]),
        TensorDictModule(nn.Tanh(), in_keys=["preactivation"], out_keys=["action"]),
    )
    critic = TensorDictModule(Sum(1.0), in_keys=["observation", "action"], out_keys=["state_action_value"])
    loss = UnsaturatedDDPGLoss(actor, critic, delay_actor=True, delay_value=True, preactivation_weight=weight)
    loss.make_value_estimator(gamma=0.5)
    return loss


def test_the_price_is_the_weighted_square_of_the_preactivation() -> None:
    free, priced = (make_unsaturated(weight)(make_batch())["loss_actor"] for weight in (0.0, 0.1))
    torch.testing.assert_close(free, torch.tensor(-3.0).tanh())
    torch.testing.assert_close(priced - free, torch.tensor(0.1 * 9))


def test_the_price_leads_out_of_saturation_and_never_reaches_the_critic() -> None:
    for weight, sign in ((0.0, -1), (0.1, 1)):
        loss = make_unsaturated(weight)
        loss(make_batch())["loss_actor"].backward()
        assert loss.actor_network_params["module", "0", "module", "bias"].grad.sign().item() == sign
        assert all(parameter.grad is None for parameter in loss.value_network_params.values(True, True))


def test_weight_zero_is_torchrls_own_loss() -> None:
    ours = make_unsaturated(0.0)
    theirs = DDPGLoss(ours.actor_network, ours.value_network, delay_actor=True, delay_value=True)
    theirs.make_value_estimator(gamma=0.5)
    theirs.load_state_dict(ours.state_dict())
    for name in ("loss_actor", "loss_value"):
        torch.testing.assert_close(ours(make_batch())[name], theirs(make_batch())[name])


def test_a_negative_price_is_refused() -> None:
    with pytest.raises(ValueError, match="must not be negative, got -1"):
        make_unsaturated(-1.0)
