"""The losses that share passes through convolutions are TorchRL's."""

import copy
import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import DDPGLoss, DQNLoss, LossModule, SoftUpdate

from halgan_rl.agents.clipped_targets import ClippedTD0Estimator
from halgan_rl.agents.ddpg import Actor, Critic, UnsaturatedDDPGLoss, deterministic_policy
from halgan_rl.agents.ddqn import QNetwork, greedy_policy
from halgan_rl.agents.fast_cpu.fused_soft_update import FusedSoftUpdate
from halgan_rl.agents.fast_cpu.one_pass_losses import OnePassDDPGLoss, OnePassDQNLoss, share_passes


@dataclasses.dataclass
class Pair:
    """A loss of ours, TorchRL's with the same parameters, and rows for them."""

    ours: LossModule
    theirs: LossModule
    rows: TensorDict


def make_rows(shape: tuple[int, ...], action: torch.Tensor) -> TensorDict:
    pixels = torch.randint(0, 256, (2, *shape, 64, 64, 3), dtype=torch.uint8)
    ended = torch.rand(*shape, 1) < 0.3
    after = {"pixels": pixels[1], "reward": torch.randn(*shape, 1), "done": ended, "terminated": ended}
    return TensorDict({"pixels": pixels[0], "action": action, "next": after}, batch_size=shape)


def make_pair(make_loss: Callable[[], LossModule], rows: TensorDict) -> Pair:
    """Returns a loss made twice, with the same parameters, one of which shares passes."""
    ours, theirs = make_loss(), make_loss()
    theirs.load_state_dict(ours.state_dict())
    assert share_passes(ours)
    assert isinstance(ours, OnePassDDPGLoss | OnePassDQNLoss)
    return Pair(ours, theirs, rows)


def make_ddpg_loss(actor: nn.Module, critic: nn.Module, **options: Any) -> UnsaturatedDDPGLoss:
    judge = TensorDictModule(critic, ["pixels", "action"], ["state_action_value"])
    return UnsaturatedDDPGLoss(deterministic_policy(actor), judge, delay_actor=True, delay_value=True, **options)


BOUNDS = {"low": [0.0, -3.0], "high": [1.0, 5.0]}


def ddpg(shape: tuple[int, ...] = (6,), downsample: Any = "stride", bounds: Any = None, **options: Any) -> Pair:
    def make_loss() -> LossModule:
        made = {"downsample": downsample, **(bounds or {})}
        return make_ddpg_loss(Actor(small_output=False, **made), Critic(**made), **options)

    return make_pair(make_loss, make_rows(shape, torch.rand(*shape, 2)))


def dqn(shape: tuple[int, ...] = (6,), downsample: Any = "stride", double: bool = True, **options: Any) -> Pair:
    def make_loss() -> LossModule:
        policy = greedy_policy(QNetwork(downsample=downsample))
        return DQNLoss(policy, delay_value=True, double_dqn=double, action_space="one_hot", **options)

    return make_pair(make_loss, make_rows(shape, nn.functional.one_hot(torch.randint(4, shape), 4)))


CASES: dict[str, Callable[[], Pair]] = {
    "DDPG": ddpg,
    "DDPG, pooled": lambda: ddpg(downsample="max_pool"),
    "DDPG, two batch dimensions": lambda: ddpg((2, 3)),
    "DDPG, other bounds": lambda: ddpg(bounds=BOUNDS),
    "DDPG, heavy penalty": lambda: ddpg(preactivation_weight=1.0),
    "DDPG, each row's loss": lambda: ddpg(reduction="none", loss_function="l1"),
    "DDQN": dqn,
    "DDQN, pooled": lambda: dqn(downsample="max_pool"),
    "DDQN, two batch dimensions": lambda: dqn((2, 3)),
    "DQN, not double": lambda: dqn(double=False),
    "DDQN, each row's loss": lambda: dqn(reduction="none", loss_function="l1"),
}


def learned(loss: LossModule) -> list[str]:
    """Returns the names of what is learned; the scale of actions is not."""
    return sorted(name for name, _ in loss.named_parameters() if not name.startswith("target_"))


@pytest.fixture(params=CASES)
def pair(request: pytest.FixtureRequest) -> Pair:
    """Losses with targets that are another network's, so that it shows which one is used."""
    torch.manual_seed(0)
    made = CASES[request.param]()
    for loss in (made.ours, made.theirs):
        loss.make_value_estimator(gamma=0.9)
    others = [made.ours.state_dict()[f"target_{name}"] for name in learned(made.ours)]
    SoftUpdate(made.theirs, tau=0.1), FusedSoftUpdate(made.ours, tau=0.1)
    for value in others:
        value.add_(0.05 * torch.randn_like(value))
    made.theirs.load_state_dict(made.ours.state_dict())
    return made


def gradients(loss: LossModule, rows: TensorDict, name: str) -> dict[str, torch.Tensor]:
    """Returns the gradients of one of the losses, without those that are zero."""
    loss.zero_grad()
    loss(rows)[name].sum().backward()
    found = {key: parameter.grad for key, parameter in loss.named_parameters()}
    return {key: gradient for key, gradient in found.items() if gradient is not None and gradient.any()}


def test_losses_and_figures_are_torchrls(pair: Pair) -> None:
    ours, theirs = pair.ours(pair.rows), pair.theirs(pair.rows.clone())
    assert set(ours.keys()) == set(theirs.keys())
    for name, value in theirs.items():
        torch.testing.assert_close(ours[name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_gradients_are_torchrls_loss_by_loss(pair: Pair) -> None:
    names = [name for name in pair.theirs(pair.rows.clone()).keys() if name.startswith("loss")]  # noqa: SIM118
    for name in names:
        ours, theirs = (gradients(loss, pair.rows.clone(), name) for loss in (pair.ours, pair.theirs))
        assert ours.keys() == theirs.keys() != set()
        for key, gradient in theirs.items():
            torch.testing.assert_close(ours[key], gradient, rtol=1e-3, atol=1e-5 * gradient.abs().max().item() + 1e-7)


def test_priorities_are_written_as_by_torchrl(pair: Pair) -> None:
    ours, theirs = pair.rows.clone(), pair.rows.clone()
    pair.ours(ours)
    pair.theirs(theirs)
    torch.testing.assert_close(ours["td_error"], theirs["td_error"], rtol=1e-4, atol=1e-5)


def test_priority_weights_are_heeded(pair: Pair) -> None:
    rows = pair.rows.clone().set("priority_weight", torch.rand(pair.rows.shape))
    assert_heeded(pair, rows)


def assert_heeded(pair: Pair, rows: TensorDict) -> None:
    """Asserts that both losses make the same of an entry of the rows, and not the same as without it."""
    losses, without = pair.ours(rows.clone()), pair.ours(pair.rows.clone())
    for name, value in pair.theirs(rows).items():
        torch.testing.assert_close(losses[name], value, rtol=1e-4, atol=1e-5, msg=name)
        if name.startswith("loss"):
            assert losses[name].shape != without[name].shape or not torch.allclose(losses[name], without[name])


def learn(loss: LossModule, updater: SoftUpdate, rows: TensorDict) -> torch.Tensor:
    """Makes three updates, big ones; return the sum of the losses after each."""
    optimizer = torch.optim.SGD([parameter for parameter in loss.parameters() if parameter.requires_grad], lr=0.1)
    sums = []
    for _ in range(3):
        sums.append(sum(value.sum() for name, value in loss(rows).items() if name.startswith("loss")))
        sums[-1].backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
    return torch.stack(sums).detach()


def test_targets_follow_the_parameters(pair: Pair) -> None:
    rows = pair.rows.clone()
    ours = learn(pair.ours, FusedSoftUpdate(pair.ours, tau=0.1), rows)
    assert ours.diff().abs().min() > 1e-3
    torch.testing.assert_close(ours, learn(pair.theirs, SoftUpdate(pair.theirs, tau=0.1), rows), rtol=1e-3, atol=1e-4)


def targets(loss: Any) -> tuple[torch.nn.Module, ...]:
    """Returns the target networks, of DDPG actor and critic."""
    target = loss._cached_networks[1]
    return target if isinstance(target, tuple) else (target,)


def test_targets_move_with_the_loss(pair: Pair) -> None:
    moved = pair.ours.double()
    parameters = [moved.state_dict()[f"target_{name}"] for name in learned(moved)]
    held = [tensor for network in targets(moved) for tensor in network.state_dict().values()]
    assert {tensor.data_ptr() for tensor in held} == {tensor.data_ptr() for tensor in parameters}


MOVES: dict[str, Callable[[LossModule], LossModule]] = {
    "to a memory format": lambda loss: loss.to(memory_format=torch.contiguous_format),
    "all anew": lambda loss: loss._apply(torch.clone),
    "to another type": lambda loss: loss.double().float(),
}


@pytest.mark.parametrize("move", MOVES.values(), ids=MOVES)
def test_the_update_of_targets_follows_where_they_move(pair: Pair, move: Callable[[LossModule], LossModule]) -> None:
    updater = FusedSoftUpdate(pair.ours, tau=0.1)
    updater.step()
    move(pair.ours)
    state = pair.ours.state_dict()
    sources = {name: state[name] for name in learned(pair.ours)}
    before = {name: pair.ours.state_dict()[f"target_{name}"].clone() for name in sources}
    for value in sources.values():
        value.add_(1.0)
    updater.step()
    updater.eps = 1.0
    updater.step()
    for name, value in sources.items():
        torch.testing.assert_close(pair.ours.state_dict()[f"target_{name}"], before[name].lerp(value, 0.1))


COPIES: dict[str, Callable[[LossModule], LossModule]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda loss: pickle.loads(pickle.dumps(loss)),
}


@pytest.mark.parametrize("duplicate", COPIES.values(), ids=COPIES)
def test_a_copy_has_networks_of_its_own(pair: Pair, duplicate: Callable[[LossModule], LossModule]) -> None:
    before = pair.ours(pair.rows.clone())
    copied = duplicate(pair.ours)
    for name in learned(copied):
        for tensor in (copied.state_dict()[name], copied.state_dict()[f"target_{name}"]):
            tensor.add_(0.05 * torch.randn_like(tensor))
    pair.theirs.load_state_dict(copied.state_dict())
    for name, value in pair.theirs(pair.rows.clone()).items():
        torch.testing.assert_close(copied(pair.rows.clone())[name], value, rtol=1e-3, atol=1e-4, msg=name)
    for name, value in pair.ours(pair.rows.clone()).items():
        torch.testing.assert_close(before[name], value, msg=name)
    sum(value.sum() for name, value in copied(pair.rows).items() if name.startswith("loss")).backward()
    assert all(parameter.grad is not None for parameter in copied.parameters() if parameter.requires_grad)
    assert all(parameter.grad is None for parameter in pair.ours.parameters())


def test_rows_without_batch_dimensions_of_their_own_do_the_same(pair: Pair) -> None:
    if pair.ours.reduction == "none":
        pytest.skip("rows are not averaged")
    loose = TensorDict(pair.rows.to_dict(), batch_size=[])
    for name, value in pair.theirs(loose.clone()).items():
        torch.testing.assert_close(pair.ours(loose)[name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_rows_that_are_masked_do_not_count(pair: Pair) -> None:
    mask = torch.arange(pair.rows.numel()).reshape(pair.rows.shape) % 2 == 0
    assert_heeded(pair, pair.rows.clone().set(("collector", "mask"), mask))


def test_one_loss_alone_leaves_zeros_where_torchrl_leaves_nothing() -> None:
    torch.manual_seed(0)
    pair = ddpg()
    pair.ours.make_value_estimator(gamma=0.9)
    FusedSoftUpdate(pair.ours, tau=0.1)
    pair.ours(pair.rows)["loss_value"].backward()
    gradients = [value.grad for value in pair.ours.actor_network_params.values(True, True)]
    assert sum(gradient is not None for gradient in gradients) == 8
    assert not any(gradient.any() for gradient in gradients if gradient is not None)


def keep_plain() -> dict[str, LossModule]:
    """Returns losses whose networks a shared pass would not compute as they do."""
    exchanged, normalised = Actor(), Critic()
    exchanged.encoder.layers[1] = nn.ReLU()
    normalised.head.insert(1, nn.LayerNorm(32))
    large = {"image_shape": (84, 84, 3)}
    policy = deterministic_policy(Actor())
    judge = TensorDictModule(Critic(), ["pixels", "action"], ["state_action_value"])
    categorical = TensorDictModule(QNetwork(), ["pixels"], ["action_value"])
    return {
        "images that blocks do not divide": make_ddpg_loss(Actor(**large), Critic(**large)),
        "another activation": make_ddpg_loss(exchanged, Critic()),
        "a head that normalises": make_ddpg_loss(Actor(), normalised),
        "TorchRL's own DDPG": DDPGLoss(policy, judge, delay_actor=True, delay_value=True),
        "targets that do not lag": DQNLoss(greedy_policy(QNetwork()), delay_value=False, action_space="one_hot"),
        "another policy": DQNLoss(copy.deepcopy(categorical), delay_value=True, action_space="one_hot"),
    }


@pytest.mark.parametrize("case", keep_plain())
def test_what_a_shared_pass_would_not_compute_stays_plain(case: str) -> None:
    loss = keep_plain()[case]
    kind = type(loss)
    assert not share_passes(loss)
    assert type(loss) is kind


def test_networks_of_different_downsamplings_are_refused() -> None:
    loss = make_ddpg_loss(Actor(downsample="max_pool"), Critic())
    loss.make_value_estimator(gamma=0.9)
    share_passes(loss)
    FusedSoftUpdate(loss, tau=0.1)
    with pytest.raises(ValueError, match=r"one down-sampling, got \['max_pool', 'stride'\]"):
        loss(ddpg().rows)


def test_targets_are_clipped() -> None:
    torch.manual_seed(0)
    pair = ddpg()
    estimator = ClippedTD0Estimator(low=-0.1, high=0.1, gamma=0.9, value_network=pair.ours.actor_critic)
    pair.ours.make_value_estimator(estimator)
    FusedSoftUpdate(pair.ours, tau=0.1)
    assert pair.ours(pair.rows)["target_value"].abs().max() <= 0.1 + 1e-6


def test_parameters_that_are_replaced_count_at_once() -> None:
    torch.manual_seed(0)
    pair = ddpg()
    pair.ours.make_value_estimator(gamma=0.9)
    FusedSoftUpdate(pair.ours, tau=0.1)
    before = pair.ours(pair.rows)
    for parameter in pair.ours.value_network_params.values(True, True):
        parameter.data = 2 * parameter.data  # not in place
    after, of_a_copy = pair.ours(pair.rows), copy.deepcopy(pair.ours)(pair.rows)
    for name in ("loss_actor", "loss_value"):
        torch.testing.assert_close(after[name], of_a_copy[name])
        assert not torch.allclose(after[name], before[name])
