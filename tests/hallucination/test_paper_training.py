import dataclasses
from copy import deepcopy as copy_state
from typing import Any, Literal
from unittest import mock

import pytest
import torch
from torch import Tensor, nn

from halgan_rl.hallucination.generators.base import HallucinationGenerator
from halgan_rl.hallucination.generators.coordinates import CoordinateGenerator
from halgan_rl.hallucination.generators.paper import PaperGenerator
from halgan_rl.hallucination.training.paper import PaperTrainer, PaperTrainingConfig, scott_kernel
from halgan_rl.poses import PlanarPoses
from tests import synthetic

LAZY = PaperTrainingConfig(discriminator_stride=2, batch_size=4, critic_steps=1, average_decay=0.9, penalty_interval=2)
SMALL = PaperTrainingConfig(discriminator_stride=2, batch_size=4, critic_steps=1)


def make_trainer(
    kind: Literal["paper", "coordinates"],
    config: PaperTrainingConfig,
    seed: int = 0,
    *,
    mirror: bool = False,
    image_shape: tuple[int, int, int] = (64, 64, 3),
    frame_stack: int = 1,
) -> PaperTrainer:
    torch.manual_seed(0)
    shape: dict[str, Any] = {"image_shape": image_shape, "frame_stack": frame_stack}
    generator: HallucinationGenerator = (
        PaperGenerator(latent_size=16, **shape) if kind == "paper" else CoordinateGenerator(width=8, depth=1, **shape)
    )
    return PaperTrainer(
        generator,
        near_goal=synthetic.near_goal(16, **shape),
        failed=synthetic.failed(16, **shape),
        config=config,
        rng=torch.Generator().manual_seed(seed),
        mirror=mirror,
    )


def copy(network: nn.Module) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in network.named_parameters()}


@pytest.mark.parametrize(("kind", "config"), [("paper", SMALL), ("coordinates", LAZY)])
@pytest.mark.parametrize("shape", ["64x64x3", *synthetic.SHAPES])
def test_a_step_changes_every_parameter_of_both_networks_whatever_the_shape_of_images(
    kind: Literal["paper", "coordinates"], config: PaperTrainingConfig, shape: str
) -> None:
    image_shape, frame_stack = synthetic.SHAPES.get(shape, (synthetic.RGB, 1))
    trainer = make_trainer(kind, config, image_shape=image_shape, frame_stack=frame_stack)
    before = copy(trainer.generator), copy(trainer.discriminator)
    metrics = trainer.step()
    for old, network in zip(before, (trainer.generator, trainer.discriminator), strict=True):
        unchanged = [name for name, tensor in network.named_parameters() if torch.equal(tensor, old[name])]
        # The score's constant cancels in the distance; biases in front of BatchNorm do nothing.
        assert all("realism.bias" in name or (kind == "paper" and "bias" in name) for name in unchanged)
    assert all(value.isfinite() for value in metrics.values())


def test_equal_seeds_give_equal_weights_and_other_seeds_do_not() -> None:
    trainers = [make_trainer("coordinates", LAZY, seed, mirror=True) for seed in (0, 0, 1)]
    for trainer in trainers:
        for _ in range(3):
            trainer.step()
    one, same, other = ({**copy(trainer.average), **copy(trainer.discriminator)} for trainer in trainers)
    assert all(torch.equal(one[name], same[name]) for name in one if name != "realism.bias")
    assert not any(torch.equal(one[name], other[name]) for name in one if name != "realism.bias")


def test_the_average_lags_behind_the_generator_and_a_decay_of_0_keeps_the_last_weights() -> None:
    lagging, last = make_trainer("coordinates", LAZY), make_trainer("coordinates", SMALL)
    before = copy(lagging.generator)["paint.0.weight"]
    for trainer in (lagging, last):
        trainer.step()
        trainer.step()
    average, now = (copy(net)["paint.0.weight"] for net in (lagging.average, lagging.generator))
    assert 0 < (average - before).norm() < (now - before).norm()
    assert torch.equal(copy(last.average)["paint.0.weight"], copy(last.generator)["paint.0.weight"])


def test_a_lazy_penalty_counts_as_much_as_it_is_rarer() -> None:
    trainer = make_trainer("coordinates", LAZY)
    calls = []
    penalty = trainer._gradient_penalty
    trainer._gradient_penalty = lambda *args: calls.append(1) or penalty(*args)  # type: ignore[method-assign, func-returns-value]
    for _ in range(6):
        trainer.step()
    assert len(calls) == 3


def test_mirrored_images_come_with_mirrored_labels() -> None:
    """A bright left half goes with a goal to the left, also in the mirror."""
    trainer = make_trainer(
        "coordinates", PaperTrainingConfig(discriminator_stride=2, batch_size=32, label_noise=(0.0, 0.0)), mirror=True
    )
    trainer._real_pixels = torch.zeros(16, 64, 64, 3, dtype=torch.uint8)
    trainer._real_pixels[:, :, :32] = 255
    trainer._labels = torch.tensor([[1.0, 0.5, 0.2]]).expand(16, -1)
    images, features = trainer._draw_real()
    left_is_bright = images[:, 0, 0, 0] > 0
    assert 0 < left_is_bright.sum() < 32
    assert torch.equal(features[:, 1] > 0, left_is_bright)
    assert torch.equal(features[:, 2] > 0, left_is_bright)


def test_fakes_show_the_goal_that_is_pursued_in_their_failed_frame() -> None:
    """Failed frames with a red bar below have a flag of 1, and so have the configurations painted into them."""
    trainer = PaperTrainer(
        CoordinateGenerator(pose_size=4, opacity=1e-6),
        near_goal=synthetic.near_goal(16, flagged=True),
        failed=synthetic.failed(16, flagged=True),
        config=PaperTrainingConfig(discriminator_stride=2, batch_size=32),
        poses=PlanarPoses(flags=("held",)),
        rng=torch.Generator().manual_seed(0),
    )
    images, features, _ = trainer._draw_fake()
    red_below = images[:, 0, 60, 0] > images[:, 1, 60, 0] + 0.5
    assert 0 < red_below.sum() < 32
    assert torch.equal(features[:, 4], red_below.float())


def test_frames_of_another_shape_than_the_generators_are_refused_before_training() -> None:
    with pytest.raises(ValueError, match=r"near_goal\['pixels'\] is torch.uint8 \[16, 84, 84, 3\].*\[N, 64, 64, 3\]"):
        PaperTrainer(
            CoordinateGenerator(),
            near_goal=synthetic.near_goal(16, image_shape=(84, 84, 3)),
            failed=synthetic.failed(16),
            config=SMALL,
            rng=torch.Generator(),
        )


@pytest.mark.parametrize("changes", [{"batch_size": 0}, {"critic_steps": 0}, {"penalty_interval": 0}, {"steps": -1}])
def test_counts_that_cannot_work_are_refused(changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        PaperTrainingConfig(**changes)  # type: ignore[arg-type]


def test_the_critic_learns_the_configurations_of_fakes_and_sees_them_by_running_statistics() -> None:
    """As in the authors' code. A generator step after it finds BatchNorm in training mode again."""
    trainer = make_trainer("paper", dataclasses.replace(SMALL, auxiliary_weight=0.0))
    trainer._train_discriminator()
    statistics = [module for module in trainer.generator.modules() if isinstance(module, nn.BatchNorm2d)]
    assert all(int(module.num_batches_tracked) == 0 for module in statistics)
    trainer._train_generator()
    assert all(int(module.num_batches_tracked) == 1 for module in statistics)

    # The regressed fakes: with the real ones left out of the loss, the configuration's head still learns.
    trainer = make_trainer("paper", SMALL)
    mse_loss, targets = nn.functional.mse_loss, []
    with mock.patch.object(
        nn.functional, "mse_loss", lambda guess, target: targets.append(target) or mse_loss(guess, target)
    ):
        trainer._train_discriminator()
    assert len(targets) == 2
    assert not torch.equal(*targets)


def test_the_generator_is_charged_for_its_output() -> None:
    """The penalty is on H, not on what tanh(s + H) leaves of it: H falls also under black and white images."""
    sizes = []
    for weight in (0.0, 1000.0):
        trainer = make_trainer("paper", dataclasses.replace(SMALL, change_weight=weight))
        trainer._failed_pixels = torch.full_like(trainer._failed_pixels, 255)
        sizes.append([float(trainer._train_generator()["change"]) for _ in range(8)])
    assert sizes[1][-1] < 0.9 * sizes[0][-1]


@pytest.mark.parametrize("kind", ["paper", "coordinates"])
def test_a_trainer_goes_on_from_its_state_bit_for_bit(kind: Literal["paper", "coordinates"]) -> None:
    whole, first, second = (make_trainer(kind, LAZY, mirror=True) for _ in range(3))
    for _ in range(4):
        whole.step()
    for _ in range(2):
        first.step()
    second.rng.manual_seed(7)
    second.load_state_dict(copy_state(first.state_dict()))
    for _ in range(2):
        second.step()
    for one, other in ((whole.generator, second.generator), (whole.average, second.average)):
        assert all(
            torch.equal(*pair) for pair in zip(one.state_dict().values(), other.state_dict().values(), strict=True)
        )


def test_the_density_of_configurations_is_scotts() -> None:
    labels = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 0.1, 3.0])
    kernel = scott_kernel(labels)
    flagged = scott_kernel(torch.cat([labels, torch.arange(500)[:, None] % 2], 1), flags=1)
    torch.testing.assert_close(flagged, nn.functional.pad(kernel, (0, 1, 0, 1)))
    torch.testing.assert_close(kernel @ kernel.T, torch.cov(labels.T) * 500 ** (-2 / 7), rtol=1e-3, atol=1e-5)
