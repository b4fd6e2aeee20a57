"""Double DQN: its network, and how it chooses."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec
from torchrl.objectives import DQNLoss

from halgan_rl.agents.ddqn import DDQNConfig, QNetwork, greedy_policy, make_agent
from halgan_rl.agents.encoder import Downsample
from tests.agents.rows import frames, make_rows


@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_parameters_are_counted_as_in_the_paper(downsample: Downsample) -> None:
    assert sum(p.numel() for p in QNetwork(downsample=downsample).parameters()) == 33_708


def test_any_leading_dimensions_give_the_same_values() -> None:
    network, pixels = QNetwork(actions=3), frames(2, 3)
    values = network(pixels)
    assert values.shape == (2, 3, 3)
    torch.testing.assert_close(values[1, 2], network(pixels[1, 2]))


@pytest.mark.parametrize("actions", [2, 7])
def test_any_number_of_actions_is_learned(actions: int) -> None:
    spec = OneHot(actions, dtype=torch.int64)
    agent = make_agent(DDQNConfig(), action_spec=spec, image_shape=(64, 64, 3))
    assert torch.isfinite(agent.update(make_rows(spec))["loss"])
    chosen = agent.make_policy(agent.network)(TensorDict({"pixels": frames(5)}, batch_size=[5]))["action"]
    assert chosen.sum(-1).tolist() == [1] * 5
    assert chosen.shape == (5, actions)


@pytest.mark.parametrize(
    "spec",
    [Bounded(-1.0, 1.0, (2,)), Categorical(4), OneHot(4, (3, 4))],
    ids=["continuous", "categorical", "several environments"],
)
def test_actions_that_are_not_one_hot_are_refused(spec: TensorSpec) -> None:
    with pytest.raises(ValueError, match=r"DDQN needs discrete, one-hot actions \[A\], got .* with DDPG"):
        make_agent(DDQNConfig(), action_spec=spec, image_shape=(64, 64, 3))


@pytest.mark.parametrize("double", [True, False])
def test_of_equally_good_actions_the_first_is_chosen_and_valued_once(double: bool) -> None:
    network = QNetwork(actions=3)
    with torch.no_grad():
        network.head[-1].weight.zero_()
        network.head[-1].bias.copy_(torch.tensor([0.1, 0.4, 0.4]))
    policy = greedy_policy(network)
    pixels = torch.zeros(2, 64, 64, 3, dtype=torch.uint8)
    chosen = policy(TensorDict({"pixels": pixels}, batch_size=[2]))
    assert chosen["action"].tolist() == [[0, 1, 0]] * 2
    loss = DQNLoss(policy, delay_value=True, double_dqn=double, action_space="one_hot")
    loss.make_value_estimator(gamma=0.5)
    going_on = torch.zeros(2, 1, dtype=torch.bool)
    after = {"pixels": pixels, "reward": torch.zeros(2, 1), "done": going_on, "terminated": going_on}
    rows = TensorDict({"pixels": pixels, "action": chosen["action"], "next": after}, batch_size=[2])
    expected = nn.functional.mse_loss(torch.tensor(0.4), 0.5 * torch.tensor(0.4))
    torch.testing.assert_close(loss(rows)["loss"].detach(), expected)
