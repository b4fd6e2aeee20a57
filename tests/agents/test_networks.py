from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.objectives import DQNLoss

from halgan_rl.agents import networks as agents
from halgan_rl.agents.fast_cpu.block_convolutions import PLAIN, Downsample, halve
from halgan_rl.agents.networks import Actor, Critic, QNetwork, Vision, deterministic_policy, greedy_policy, see
from halgan_rl.transforms.pixels import to_float

NETWORKS = {"actor": (Actor, 33_642), "critic": (Critic, 33_673), "ddqn": (QNetwork, 33_708)}


def frames(*leading: int, seed: int = 0) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (*leading, 64, 64, 3), dtype=torch.uint8, generator=rng)


def call(network: nn.Module, pixels: Tensor) -> Tensor:
    action = torch.linspace(-1, 1, 2).expand(*pixels.shape[:-3], 2)
    return network(pixels, action) if isinstance(network, Critic) else network(pixels)


@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
@pytest.mark.parametrize("name", NETWORKS)
def test_parameters_are_counted_as_in_the_paper(name: str, downsample: Downsample) -> None:
    network, count = NETWORKS[name]
    assert sum(p.numel() for p in network(downsample=downsample).parameters()) == count


@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
@pytest.mark.parametrize("name", NETWORKS)
def test_any_leading_dimensions_give_the_same_values(name: str, downsample: Downsample) -> None:
    network = NETWORKS[name][0](downsample=downsample)
    pixels = frames(2, 3)
    values = call(network, pixels)
    assert values.shape[:-1] == (2, 3)
    torch.testing.assert_close(values[1, 2], call(network, pixels[1, 2]))
    torch.testing.assert_close(values[0], call(network, pixels[0]))


def test_an_untrained_actor_asks_for_the_middle_of_all_actions_unless_told_otherwise() -> None:
    torch.manual_seed(0)
    small, large = (Actor(small_output=small_output)(frames(8)).abs().max() for small_output in (True, False))
    assert small < 0.01 < 0.1 < large


@pytest.mark.parametrize("learn", [True, False])
@pytest.mark.parametrize("networks", [1, 3])
@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_activations_stay_channels_last(
    downsample: Downsample, networks: int, learn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, conv2d = [], F.conv2d

    def spy(images: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        halved = conv2d(images, *args, **kwargs)
        seen.extend([images, halved])
        return halved

    monkeypatch.setattr(F, "conv2d", spy)
    with torch.set_grad_enabled(learn):
        see(frames(2), [Vision(downsample) for _ in range(networks)])
    assert [images.is_contiguous(memory_format=torch.channels_last) for images in seen] == 8 * [True]


@pytest.mark.parametrize("learn", [True, False])
@pytest.mark.parametrize("networks", [1, 2, 3])
@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_networks_see_together_what_each_sees_and_what_plain_layers_see(
    downsample: Downsample, networks: int, learn: bool
) -> None:
    torch.manual_seed(0)
    visions = [Vision(downsample) for _ in range(networks)]
    pixels = frames(2, 3)
    pixels[0, :, :32] = 200  # where all is the same, pooled outputs are, too
    with torch.set_grad_enabled(learn):
        together = see(pixels, visions)
        for vision, seen in zip(visions, together, strict=True):
            assert seen.shape == (6, 512)
            torch.testing.assert_close(vision(pixels), seen)
            torch.testing.assert_close(vision.layers(to_float(pixels)), seen)


@pytest.mark.parametrize("networks", [1, 2])
@pytest.mark.parametrize("downsample", ["stride", "max_pool"])
def test_networks_learn_together_what_plain_layers_learn(downsample: Downsample, networks: int) -> None:
    torch.manual_seed(0)
    visions = [Vision(downsample) for _ in range(networks)]
    pixels = frames(6)
    pixels[:, :32] = 200
    together = torch.cat(see(pixels, visions))
    plain = torch.cat([vision.layers(to_float(pixels)) for vision in visions])
    parameters = [parameter for vision in visions for parameter in vision.parameters()]
    weights = torch.randn_like(plain)
    got, wanted = (torch.autograd.grad((features * weights).sum(), parameters) for features in (together, plain))
    for one, other in zip(got, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)


def test_layouts_are_chosen_for_what_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def spy(images: Tensor, networks: Any, layouts: Any, activation: Any) -> Tensor:
        asked.append(tuple(layouts))
        return halve(images, networks, layouts, activation)

    monkeypatch.setattr(agents, "halve", spy)
    visions = [Vision(), Vision()]
    for networks in (visions[:1], visions):
        see(frames(2), networks)
        with torch.no_grad():
            see(frames(2), networks)
    assert len(set(asked)) == 4
    asked.clear()
    torch.compile(visions[0], fullgraph=True, backend="eager")(frames(2))
    see(frames(2).to("meta"), [Vision().to("meta")])
    assert set(asked) == {4 * (PLAIN,)}


def test_actions_stay_in_range_and_depend_on_the_image() -> None:
    torch.manual_seed(0)
    actor = Actor()
    nn.init.normal_(actor.head[-1].weight, std=5.0)
    pixels = TensorDict({"pixels": frames(8)}, batch_size=[8])
    actions = deterministic_policy(actor)(pixels)["action"]
    assert actions.abs().max() <= 1
    assert actions.std(0).min() > 0


def test_the_critic_hears_of_the_action() -> None:
    critic, pixels = Critic(), frames(1)
    assert not torch.equal(critic(pixels, torch.tensor([[1.0, 0.0]])), critic(pixels, torch.tensor([[0.0, 1.0]])))


@pytest.mark.parametrize("pixels", [torch.zeros(2, 3, 64, 64, dtype=torch.uint8), torch.zeros(2, 64, 64, 3)])
def test_images_of_another_layout_or_type_are_refused(pixels: Tensor) -> None:
    with pytest.raises(ValueError, match="pixels must be uint8"):
        Actor()(pixels)


def test_an_unknown_downsampling_is_refused() -> None:
    with pytest.raises(ValueError, match="average"):
        Actor(downsample="average")  # type: ignore[arg-type]


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
