"""DDPG: its networks, its loss, and how it explores."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.objectives import DDPGLoss

from halgan_rl.agents.ddpg import Actor, Critic, UnsaturatedDDPGLoss, deterministic_policy
from halgan_rl.agents.encoder import Downsample
from tests.agents.rows import frames
from tests.agents.test_clipped_targets import Sum, make_batch


@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_parameters_are_counted_as_in_the_paper(downsample: Downsample) -> None:
    counts = [sum(p.numel() for p in network(downsample=downsample).parameters()) for network in (Actor, Critic)]
    assert counts == [33_642, 33_673]


@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_any_leading_dimensions_give_the_same_values(downsample: Downsample) -> None:
    actor, critic = Actor(downsample=downsample), Critic(downsample=downsample)
    pixels, action = frames(2, 3), torch.linspace(-1, 1, 2).expand(2, 3, 2)
    preactivations, values = actor(pixels), critic(pixels, action)
    assert (preactivations.shape, values.shape) == ((2, 3, 2), (2, 3, 1))
    torch.testing.assert_close(preactivations[1, 2], actor(pixels[1, 2]))
    torch.testing.assert_close(values[0], critic(pixels[0], action[0]))
    torch.testing.assert_close(values[1, 2], critic(pixels[1, 2], action[1, 2]))


def test_an_untrained_actor_gives_the_middle_of_all_actions_unless_configured_otherwise() -> None:
    torch.manual_seed(0)
    small, large = (Actor(small_output=small_output)(frames(8)).abs().max() for small_output in (True, False))
    assert small < 0.01 < 0.1 < large


def test_actions_depend_on_the_image() -> None:
    torch.manual_seed(0)
    actor = Actor()
    nn.init.normal_(actor.head[-1].weight, std=5.0)
    actions = deterministic_policy(actor)(TensorDict({"pixels": frames(8)}, batch_size=[8]))["action"]
    assert actions.std(0).min() > 0


def test_values_depend_on_the_action() -> None:
    critic, pixels = Critic(), frames(1)
    assert not torch.equal(critic(pixels, torch.tensor([[1.0, 0.0]])), critic(pixels, torch.tensor([[0.0, 1.0]])))


def make_unsaturated(weight: float) -> UnsaturatedDDPGLoss:
    """Returns the loss of an actor whose pre-activation is far out (3), before a critic that asks for more."""
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


def test_the_penalty_is_the_weighted_square_of_the_preactivation() -> None:
    free, penalised = (make_unsaturated(weight)(make_batch())["loss_actor"] for weight in (0.0, 0.1))
    torch.testing.assert_close(free, torch.tensor(-3.0).tanh())
    torch.testing.assert_close(penalised - free, torch.tensor(0.1 * 9))


def test_the_penalty_leads_out_of_saturation_and_never_reaches_the_critic() -> None:
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


def test_a_negative_penalty_weight_is_refused() -> None:
    with pytest.raises(ValueError, match="must not be negative, got -1"):
        make_unsaturated(-1.0)
